"""The report: one self-contained page, whatever the run is like."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from mastd3r.export.metric_names import described, in_order, shown, summary_line
from mastd3r.export.pictures import MOVING_COLOUR, data_uri, difference, fitted, mask_overlay, tinted
from mastd3r.export.plots import ground_axes, number, over_time, ticks, timing_bars, top_view
from mastd3r.export.read_run import read_run
from mastd3r.export.report import ReportData, report_html, write_report
from mastd3r.export.report_data import gather_report_data, pick_renders, spread
from mastd3r.export.run_folder import RunFolder
from mastd3r.types import Frame, State, Trajectory

VOID = {"meta", "img", "link", "br", "hr", "input"}


class Tags(HTMLParser):
    """Holds that every tag closes and collects where the page points to."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.targets: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.targets += [v or "" for k, v in attrs if k in ("src", "href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def parsed(page: str) -> Tags:
    tags = Tags()
    tags.feed(page)
    assert tags.open == []
    return tags


def walk(n: int = 60) -> Trajectory:
    """A half circle on the ground, the camera upright and looking along the path."""
    angle = np.linspace(0, np.pi, n)
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, 3] = np.stack([2 * np.cos(angle), 0 * angle, 2 * np.sin(angle)], 1)
    for i, a in enumerate(angle):
        forward = np.array([-np.sin(a), 0, np.cos(a)])
        poses[i, :3, :3] = np.stack([np.cross([0, 1, 0], forward), [0, 1, 0], forward], 1)
    states: list[State] = ["tracked"] * n
    states[10:14] = ["interpolated"] * 4
    states[30:32] = ["lost"] * 2
    return Trajectory(np.arange(n) / 30, poses, tuple(states), np.arange(n) % 10 == 0)


def bare(trajectory: Trajectory, truth: np.ndarray | None = None, unit: str = "map units") -> ReportData:
    positions = trajectory.world_from_cam[:, :3, 3]
    return ReportData("a run", trajectory, positions, truth, unit, (), (), {}, {}, "")


@pytest.fixture
def run_path(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    folder = RunFolder(tmp_path / "run", ["mastd3r", "run", "it's <me>.mp4"])
    trajectory = walk()
    folder.write_trajectory(trajectory)
    for i, t in enumerate(trajectory.timestamps_s):
        folder.write_mask(float(t), rng.random((24, 32)))
        if i % 8 == 0:
            folder.write_render(float(t), rng.random((24, 32, 3)))
    folder.write_config("seed: 0\n")
    folder.note("semantics: none <b>")
    folder.write_metrics({"frames": 60, "frames_posed": 60, "ate_rmse_all": 0.0312, "odd_key": 3.25})
    folder.update(timings_s={"tracking": 12.0, "Gaussian map": 30.0})
    folder.finish("incomplete", "stopped with Ctrl-C & all")
    return folder.path


def frames() -> list[Frame]:
    rng = np.random.default_rng(1)
    times = walk().timestamps_s
    return [Frame(i, float(t), rng.integers(0, 256, (48, 64, 3), np.uint8)) for i, t in enumerate(times)]


def test_the_page_of_a_run(run_path: Path) -> None:
    run = read_run(run_path)
    truth = run.trajectory.world_from_cam[:, :3, 3] + 0.01
    psnr = {float(t): 15 + i for i, t in enumerate(run.render_times_s())}
    data = gather_report_data(run, frames(), psnr, truth, metres_per_unit=1.7)
    assert [r.label for r in data.renders] == ["best", "median", "worst"]
    assert [r.psnr_db for r in data.renders] == [22, 18, 15]
    assert len(data.masks) == 6
    assert data.unit == "m"
    assert np.allclose(data.positions, 1.7 * run.trajectory.world_from_cam[:, :3, 3])
    page = write_report(run_path, data).read_text()
    tags = parsed(page)
    text = " ".join(tags.text)
    pictures = [target for target in tags.targets if target.startswith("data:image/jpeg;base64,")]
    assert len(pictures) == 15
    written = {p.name for p in run_path.iterdir() if not p.name.startswith(".")} - {"report.html", "alpha", "depth"}
    assert {target.rstrip("/") for target in tags.targets} - set(pictures) == written  # alpha, depth: empty
    assert not re.search(r"https?://|<script|@import|url\(", page)
    for words in (
        "stopped with Ctrl-C & all",
        "semantics: none <b>",
        "0.0312 m",
        "odd key",
        "3.25",
        "60 of 60",
    ):
        assert words in text
    assert "mastd3r run 'it'\"'\"'s <me>.mp4'" in text
    order = [page.index(h) for h in ("Photograph, splat", "What moves", "<h2>Trajectory", "<h2>Figures", "<h2>Time")]
    assert order == sorted(order)


def test_videos_play_first_and_every_file_is_linked(run_path: Path) -> None:
    for name in ("flight.mp4", "masks.mp4", "my <mesh> #2.glb", "gaussians.ply.part"):
        (run_path / name).write_bytes(bytes(3 * 2**19))
    page = report_html(gather_report_data(read_run(run_path), frames(), {0.0: 20.0}))
    videos = re.findall(r'<video src="([^"]+)"([^>]*)>', page)
    assert [name for name, _ in videos] == ["flight.mp4", "masks.mp4"]
    assert all("controls muted playsinline" in how and 'poster="data:image/jpeg' in how for _, how in videos)
    assert page.index("<video") < page.index("Photograph, splat")
    assert "my%20%3Cmesh%3E%20%232.glb" in parsed(page).targets
    assert "my &lt;mesh&gt; #2.glb" in page and "1.5 MiB" in page and "60 files" in page
    assert "gaussians.ply.part" not in page and ".reserve" not in page


def test_the_same_run_gives_the_same_page(run_path: Path) -> None:
    pages = [report_html(gather_report_data(read_run(run_path), frames(), {0.0: 20.0})) for _ in range(2)]
    assert pages[0] == pages[1]


def test_a_run_with_nothing_in_it_has_a_page() -> None:
    empty = Trajectory(np.zeros(0), np.zeros((0, 4, 4)), (), np.zeros(0, bool))
    tags = parsed(report_html(bare(empty)))
    assert "No frame has a pose." in tags.text


@pytest.mark.parametrize("n", [1, 2, 5000])
@pytest.mark.parametrize("still", [False, True])
def test_plots_of_hard_paths_are_finite(n: int, still: bool) -> None:
    trajectory = walk(n)
    if still:
        trajectory = replace(trajectory, world_from_cam=np.tile(np.eye(4), (n, 1, 1)))
    truth = trajectory.world_from_cam[:, :3, 3].copy()
    truth[: n // 2] = np.nan
    for data in (bare(trajectory), bare(trajectory, truth, "m"), bare(trajectory, truth * np.nan, "m")):
        page = report_html(data)
        parsed(page)
        assert "nan" not in page.lower().replace("nance", "")
        assert "inf" not in re.sub(r"<style>.*</style>", "", page, flags=re.S).replace("information", "")
        assert len(page) < 600_000


def test_plots_are_well_formed_and_show_the_states() -> None:
    trajectory = walk()
    positions = trajectory.world_from_cam[:, :3, 3]
    for svg in (
        top_view(trajectory, positions, None, "map units", None),
        over_time(trajectory, positions, None, "map units", None),
    ):
        root = ElementTree.fromstring(svg)
        lines = [e.get("class") for e in root.iter("polyline")]
        assert {"path tracked", "path interpolated", "path lost"} <= set(lines)
        assert "path truth" not in lines
        dots = [e for e in root.iter("circle") if e.get("class") == "keyframe"]
        assert len(dots) % trajectory.is_keyframe.sum() == 0
    positions_m = positions + 0.1
    svg = over_time(trajectory, positions, positions_m, "m", np.linalg.norm(positions - positions_m, axis=1))
    lines = [e.get("class") for e in ElementTree.fromstring(svg).iter("polyline")]
    assert lines.count("path truth") == 3
    assert lines.count("path error") == 1


def test_seen_from_above_a_circle_is_a_circle_and_not_a_mirror() -> None:
    """Axes of the plane: equal lengths, ground only, and right-handed as seen from the sky."""
    trajectory = walk()
    plane = ground_axes(trajectory, trajectory.world_from_cam[:, :3, 3])
    assert np.allclose(plane @ plane.T, np.eye(2))
    assert np.allclose(plane @ [0, 1, 0], 0)
    assert np.allclose(np.cross(plane[0], plane[1]), [0, -1, 0])  # towards the viewer is up


def test_a_rolling_camera_is_seen_along_its_least_extent() -> None:
    trajectory = walk(60)
    poses = trajectory.world_from_cam.copy()
    poses[::2, :3, :3] = poses[::2, :3, :3] @ np.diag([-1, -1, 1])
    plane = ground_axes(replace(trajectory, world_from_cam=poses), poses[:, :3, 3])
    assert np.allclose(np.abs(np.cross(plane[0], plane[1])), [0, 1, 0])


@pytest.mark.parametrize(("low", "high"), [(0, 1), (-3.2, 8.8), (1e-7, 2e-6), (0, 57.3), (1e4, 1e4 + 3)])
def test_ticks_are_round_and_inside(low: float, high: float) -> None:
    found = ticks(low, high, 6)
    assert 2 <= len(found) <= 8
    assert all(low - 1e-9 * high <= t <= high * (1 + 1e-9) for t in found)
    labels = [number(t, high - low) for t in found]
    assert len(set(labels)) == len(labels)


def test_timing_bars_share_out_the_whole() -> None:
    svg = timing_bars({"a": 1.0, "b": 3.0})
    assert "25 %" in svg
    assert "75 %" in svg
    assert timing_bars({}) == timing_bars({"a": 0.0}) == ""


def test_pictures() -> None:
    photograph = np.full((48, 64, 3), 100, np.uint8)
    p = np.zeros((24, 32), np.uint8)
    p[:, 16:] = 255
    overlay = mask_overlay(photograph, p)
    assert (overlay[:, :28] == 100).all()
    assert overlay[24, 60, 0] > 180 > overlay[24, 60, 2]
    assert (difference(photograph, photograph) < 10).all()
    assert difference(photograph, photograph + 100).min(axis=(0, 1)).sum() > 600
    assert fitted(photograph, 32).shape == (24, 32, 3)
    assert fitted(photograph, 100) is photograph
    assert data_uri(photograph).startswith("data:image/jpeg;base64,/9j/")


def test_samples_are_spread_and_ranked() -> None:
    assert spread(np.arange(100.0), 4).tolist() == [12, 37, 62, 87]
    assert spread(np.arange(3.0), 6).tolist() == [0, 1, 2]
    assert pick_renders({}) == []
    assert pick_renders({1.0: 20.0}) == [(1.0, "best")]
    assert pick_renders({1.0: 20.0, 2.0: 30.0}) == [(2.0, "best"), (1.0, "worst")]
    assert pick_renders({1.0: 20.0, 2.0: 30.0, 3.0: 25.0, 4.0: 9.0}) == [
        (2.0, "best"), (1.0, "median"), (4.0, "worst"),
    ]  # fmt: skip


def test_figures_read_well() -> None:
    assert shown("psnr_holdout", 18.456) == "18.46 dB"
    assert shown("gaussians", 41234.0) == "41,234"
    assert shown("mask_false_positive_ratio", 0.0123) == "1.23%"
    assert shown("mask_iou", None) == "–"
    assert described("ate_rmse_all_note").startswith("Why no ATE")
    assert summary_line({"frames": 3, "frames_posed": 2, "fps_total": 1.5}) == "2 of 3 frames posed · 1.50 frames/s"
    counted = {"frames": 9, "frames_posed": 8, "frames_tracked": 5, "frames_interpolated": 3, "frames_lost": 1}
    assert summary_line(counted) == "5 of 9 frames tracked (3 interpolated, 1 lost)"
    assert summary_line({**counted, "frames_interpolated": 0, "frames_lost": 0}) == "5 of 9 frames tracked"
    over_all = {"psnr_holdout": 14.02, "psnr_holdout_static": None}
    assert summary_line(over_all) == "PSNR 14.02 dB"  # nobody has said what moves
    assert summary_line({**over_all, "psnr_holdout_static": 29.9}) == "PSNR of what is static 29.90 dB"
    given = {"odd": 1, "gaussians": 2, "ate_rmse_all": None, "ate_rmse_all_note": "still", "frames": 3}
    assert [k for k, _ in in_order(given)] == [
        "frames",
        "ate_rmse_all",
        "ate_rmse_all_note",
        "gaussians",
        "odd",
    ]


def test_the_tint_is_its_plain_twin_but_for_rounding() -> None:
    rng = np.random.default_rng(2)
    image, level = rng.integers(0, 256, (37, 53, 3)).astype(np.uint8), rng.integers(0, 256, (37, 53)).astype(np.uint8)
    share = (0.6 / 255 * level)[..., None]
    plain = (0.75 * image + 0.25 * image.mean(2, keepdims=True)) * (1 - share) + np.array(MOVING_COLOUR) * share
    assert np.abs(tinted(image, level, MOVING_COLOUR).astype(float) - plain).max() <= 1.5
