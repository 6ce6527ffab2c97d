"""Calibrated cameras: the lens is OpenCV's, rectified pictures are where OpenCV says, and results come back."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from colmap_reader import read_binary
from mastd3r.camera.map_view import MapView
from mastd3r.camera.opencv_lens import OpenCvLens, lens_from_intrinsics
from mastd3r.camera.rectification import Rectifier, rectifier_for
from mastd3r.cli.main import main
from mastd3r.config import SourceConfig
from mastd3r.dynamics.data import DynamicMask, DynamicsInput
from mastd3r.dynamics.ours import LogOddsModel
from mastd3r.errors import ConfigError
from mastd3r.export.report import ReportData, report_html
from mastd3r.registry import DYNAMICS
from mastd3r.sources import open_source, synthetic
from mastd3r.sources.rectified import RectifiedSource, rectified
from mastd3r.types import Frame, Trajectory

Array = NDArray[Any]
BARREL = (229.3, 228.6, 183.6, 124.2, -0.283, 0.074, 0.0002, 0.00002)  # a wide industrial camera
CUSHION = (258.6, 258.2, 159.3, 127.6, 0.262, -0.953, -0.0054, 0.0026, 1.163)  # a depth camera's colour lens
RATIONAL = (300.0, 305.0, 160.0, 120.0, 5.2, 1.3, 1e-3, -5e-4, 0.03, 5.5, 2.9, 0.25)
RADIAL = (300.0, 300.0, 161.0, 118.0, -0.1)
OBLONG = (330.0, 300.0, 161.0, 118.0)
LENSES = {"barrel": (BARREL, (376, 240)), "cushion": (CUSHION, (320, 240)), "rational": (RATIONAL, (320, 240)),
          "radial": (RADIAL, (320, 240)), "oblong": (OBLONG, (320, 240))}  # fmt: skip
every_lens = pytest.mark.parametrize("name", LENSES)


def rectifier(name: str) -> Rectifier:
    found = rectifier_for(*LENSES[name])
    assert found is not None
    return found


def opencv(points_cam: Array, given: tuple[float, ...]) -> Array:
    """(n, 2) pixels of (n, 3) points, from OpenCV itself: the truth of this file."""
    matrix = np.array([[given[0], 0, given[2]], [0, given[1], given[3]], [0, 0, 1]])
    distortion = np.array([*given[4:], *(0.0,) * 3] if len(given) == 5 else given[4:] or (0.0,) * 4)
    px, _ = cv2.projectPoints(points_cam.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), matrix, distortion)
    return np.asarray(px[:, 0])


def spots(at: Array, size: tuple[int, int], sigma_px: float = 2.0) -> Array:
    """(h, w, 3) uint8 with a round spot at each place."""
    y, x = np.mgrid[0 : size[1], 0 : size[0]]
    image = sum(np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * sigma_px**2)) for u, v in at)
    return np.repeat(np.rint(250 * np.asarray(image)).astype(np.uint8)[..., None], 3, 2)


def centroid(image: Array, near: Array, radius_px: int = 9) -> Array:
    """Centre of the spot near a place, (2,)."""
    x0, y0 = (int(v) - radius_px for v in np.round(near))
    part = image[y0 : y0 + 2 * radius_px + 1, x0 : x0 + 2 * radius_px + 1, 0].astype(float)
    y, x = np.indices(part.shape)
    return np.array([(part * x).sum(), (part * y).sum()]) / part.sum() + [x0, y0]


def spread_rays(r: Rectifier, margin_px: float = 20.0) -> Array:
    """A 5 x 4 grid of points whose pinhole pixels have some room around them, depths 1 to 3."""
    x, y = np.linspace(margin_px, r.size[0] - margin_px, 5), np.linspace(margin_px, r.size[1] - margin_px, 4)
    rays = r.pinhole.rays(np.stack(np.meshgrid(x + 0.3, y - 0.2), -1).reshape(-1, 2))
    return np.asarray(rays * np.linspace(1, 3, len(rays))[:, None])


# -- the lens ----------------------------------------------------------------------------------------------------------


@every_lens
def test_the_lens_is_that_of_opencv(name: str) -> None:
    given, size = LENSES[name]
    lens = lens_from_intrinsics(given, size)
    px = lens.pixel_grid()[::8, ::8].reshape(-1, 2)
    rays = lens.rays(px)
    assert np.abs(opencv(rays, given) - px).max() < 1e-5
    np.testing.assert_allclose(lens.project(2.5 * rays), opencv(rays, given), atol=1e-5)
    half = lens.resized(size[0] // 2, size[1] // 2)
    np.testing.assert_allclose(half.project(rays), (px + 0.5) / 2 - 0.5, atol=1e-5)


def test_rays_that_the_lens_folds_back_are_not_in_the_picture() -> None:
    lens = OpenCvLens(200, 200, 159.5, 119.5, 320, 240, (-0.3, 0.0, 0.0, 0.0))
    turn = np.sqrt(1 / 0.9)  # d/dr (r - 0.3 r³) = 0
    seen, folded = lens.project(np.array([[0.98 * turn, 0, 1.0], [1.6 * turn, 0, 1.0]]))
    assert 250 < seen[0] < 320 and abs(folded[0]) > 1e5
    view = MapView(lens_from_intrinsics(BARREL, (376, 240)), 188, 2.0)
    straight = view.pinhole_image(np.full((240, 376, 3), 255, np.uint8))[1]
    edges = [straight[0, 0], straight[0, -1], straight[-1, 0], straight[-1, -1]]
    assert max(edges) == 0 and 0.6 < straight.mean() < 0.95


# -- rectified pictures ------------------------------------------------------------------------------------------------


@every_lens
def test_every_pixel_lands_where_opencv_puts_it(name: str) -> None:
    """Pictures of coordinates: pixel → rectified → OpenCV's projection agrees to 0.05 px, and the way back."""
    r, (given, size) = rectifier(name), LENSES[name]
    assert r.pinhole.fx_px == r.pinhole.fy_px == pytest.approx(np.sqrt(given[0] * given[1])) and not r.pinhole.distorted
    x, y = (r.semantic(a.astype(np.float32)) for a in np.indices(size[::-1])[::-1])
    truth = opencv(r.pinhole.rays(r.pinhole.pixel_grid()).reshape(-1, 3), given)
    assert x.shape == y.shape == r.size[::-1]
    assert np.abs(np.stack([x, y], -1).reshape(-1, 2) - truth).max() < 0.05
    x, y = (r.as_photograph(a.astype(np.float32)) for a in np.indices(r.size[::-1])[::-1])
    assert x.shape == y.shape == size[::-1]
    truth = opencv(r.pinhole.rays(np.stack([x, y], -1).reshape(-1, 2)), given).reshape(*x.shape, 2)
    inside = (x > 1) & (y > 1) & (x < r.size[0] - 2) & (y < r.size[1] - 2)
    wanted = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), -1)
    assert inside.mean() > 0.7 and np.abs(truth - wanted)[inside].max() < 0.05


@every_lens
def test_things_in_a_photograph_are_where_the_pinhole_sees_them(name: str) -> None:
    """The whole way in colours; a spot's centre is itself moved by up to 0.1 px where the lens bends most."""
    r, (given, size) = rectifier(name), LENSES[name]
    points = spread_rays(r)
    in_photograph, in_pinhole = opencv(points, given), r.pinhole.project(points)
    straight = r.image(spots(in_photograph, size))
    assert straight.shape == (r.size[1], r.size[0], 3)
    away = [np.abs(centroid(straight, wanted) - wanted).max() for wanted in in_pinhole]
    assert max(away) < 0.15 and np.median(away) < 0.05
    back = r.as_photograph(spots(in_pinhole, r.size))
    assert max(np.abs(centroid(back, wanted) - wanted).max() for wanted in in_photograph) < 0.05


@every_lens
def test_no_pixel_of_the_pinhole_image_is_without_data(name: str) -> None:
    r, (given, size) = rectifier(name), LENSES[name]
    at = opencv(r.pinhole.rays(r.pinhole.pixel_grid()).reshape(-1, 3), given)
    assert at.min() > -0.01 and (at < np.array(size) - 0.99).all()
    assert np.abs(at.max(0) - at.min(0) - np.array(size) + 1).min() < 30  # and little is given away


def test_smaller_pictures_go_back_at_their_scale() -> None:
    r, (given, size) = rectifier("barrel"), LENSES["barrel"]
    points = spread_rays(r, 40.0)
    wanted = (opencv(points, given) + 0.5) / 2 - 0.5
    working = (r.size[0] // 2, r.size[1] // 2)
    pinhole = r.pinhole.resized(*working)
    back = r.as_photograph(spots(pinhole.project(points), working))
    assert abs(back.shape[1] - size[0] / 2) < 1 and abs(back.shape[0] - size[1] / 2) < 1
    for place in wanted:
        assert np.abs(centroid(back, place) - place).max() < 0.3  # half a pixel of size is rounded


def test_depth_is_never_mixed_and_maps_keep_their_scale() -> None:
    r, (_, size) = rectifier("cushion"), LENSES["cushion"]
    depth = np.where(np.indices(size[::-1])[1] % 14 < 7, 1.0, 3.0).astype(np.float32)
    photograph = Frame(3, 0.5, np.zeros((*size[::-1], 3), np.uint8), depth, np.full((120, 160), 0.25, np.float32))
    frame = rectified(photograph, r)
    assert frame.as_taken is photograph
    assert frame.depth_m is not None and frame.semantic is not None and (frame.index, frame.timestamp_s) == (3, 0.5)
    assert set(np.unique(frame.depth_m)) == {1.0, 3.0} and frame.depth_m.shape == frame.image.shape[:2] == r.size[::-1]
    assert np.abs(np.array(frame.semantic.shape) - np.array(r.size[::-1]) / 2).max() <= 1
    np.testing.assert_allclose(frame.semantic, 0.25)


def test_nothing_is_touched_where_the_camera_is_a_pinhole_already() -> None:
    assert rectifier_for((), (320, 240)) is None
    assert rectifier_for((300.0, 300.0, 160.0, 120.0), (320, 240)) is None
    assert rectifier_for((300.0, 300.0, 160.0, 120.0, 0.0), (320, 240)) is None
    assert rectifier_for((300.0, 301.0, 160.0, 120.0), (320, 240)) is not None


def test_a_source_is_rectified_but_for_its_truth(room_clip: Path) -> None:
    source = open_source(room_clip, SourceConfig(), want_depth=True)
    r = rectifier_for((150.0, 147.0, 82.0, 58.0, -0.2), source.size)
    assert r is not None
    straight = RectifiedSource(source, r)
    assert straight.size == r.size != source.size and straight.length == source.length and straight.has_depth
    frame, photograph = next(straight.frames()), next(source.frames())
    np.testing.assert_array_equal(frame.image, r.image(photograph.image))
    assert len(list(straight.frames())) == 24  # again from the beginning
    truth, passed = source.truth(), straight.truth()
    assert truth is not None and passed is not None and passed.moving_files == truth.moving_files != {}


@pytest.mark.parametrize("name", ["barrel", "cushion"])
def test_a_photograph_survives_the_map_s_pinhole(name: str) -> None:
    given, size = LENSES[name]
    view = MapView(lens_from_intrinsics(given, size), size[0] // 2, 2.0)
    y, x = np.mgrid[0 : size[1], 0 : size[0]]
    photograph = np.rint(127 + 60 * np.stack([np.sin(x / 9), np.cos(y / 7), np.sin((x + y) / 11)], -1)).astype(np.uint8)
    small = cv2.resize(photograph, (view.camera.width, view.camera.height), interpolation=cv2.INTER_AREA) / 255
    back = view.as_photograph(view.pinhole_image(photograph)[0]) / 255
    assert np.abs(back - small)[4:-4, 4:-4].max() < 0.03


# -- values that are refused -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("150,150,80,60,0.1,0", ["expected fx,fy,cx,cy[,k1", "4, 5, 8, 9 or 12 numbers", "got 6 numbers"]),
        ("150,150,80,60,0,0,0,0,0,0,0,0,0", ["got 13 numbers"]),
        ("150,150,80,60,0,nan,0,0", ["expected finite numbers"]),
        ("150,0,80,60,-0.1", ["fx, fy > 0"]),
        ("150,150,80,60,-1.2", ["one-to-one over the 160x120 image", "got -1.2, which folds inside it"]),
        ("150,150,80,60,0.5,-4,0,0", ["folds inside"]),
        ("150,150,80,60,0,0,0.8,0.8", ["folds inside"]),
        ("150,150,80,60,0,0,0,0,0,3,0,0", ["folds inside"]),
        ("1e308,100,100,100,100,1e308,50,1e308", ["folds inside"]),
        ("150,150,9000,60,0.00001", ["--intrinsics"]),
        ("150,150,80,60,a", ["expected fx,fy,cx,cy", "'150,150,80,60,a'"]),
    ],
)
def test_bad_values_are_one_line(
    room_clip: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], text: str, said: list[str]
) -> None:
    code = main(["run", str(room_clip), "--out", str(tmp_path / "out"), "--quiet", f"--intrinsics={text}"])
    lines = capfd.readouterr().err.splitlines()
    assert code == 2 and len(lines) == 1 and not (tmp_path / "out").exists(), lines
    for words in ("mastd3r: --intrinsics: expected", *said):
        assert words in lines[0]


def test_a_lens_that_leaves_no_picture_is_refused() -> None:
    with pytest.raises(ConfigError, match="leaves a straight image"):
        rectifier_for((300.0, 300.0, 5000.0, 119.5, 0.1), (320, 240))


# -- whole runs on a room seen through a bent lens ---------------------------------------------------------------------

ROOM = (225.0, 220.5, 123.0, 87.0, -0.28, 0.09, 0.003, -0.002)  # 240 x 180
ROOM_SIZE = (240, 180)


@dataclass(frozen=True)
class BentCamera:
    """What the room's ray caster asks of a camera, from OpenCV's own undistortion."""

    given: tuple[float, ...]
    width: int
    height: int

    @property
    def fx_px(self) -> float:
        return self.given[0]

    def resized(self, width: int, height: int) -> BentCamera:
        x, y = width / self.width, height / self.height
        fx, fy, cx, cy, *rest = self.given
        return BentCamera((fx * x, fy * y, (cx + 0.5) * x - 0.5, (cy + 0.5) * y - 0.5, *rest), width, height)

    def pixel_grid(self) -> Array:
        return np.stack(np.meshgrid(np.arange(float(self.width)), np.arange(float(self.height))), -1)

    def rays(self, px: Array) -> Array:
        fx, fy, cx, cy = self.given[:4]
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        flat, stop = px.reshape(-1, 1, 2), (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
        xy = cv2.undistortPoints(flat, matrix, np.array(self.given[4:]), criteria=stop).reshape(-1, 2)
        rays = np.concatenate([xy, np.ones((len(xy), 1))], 1)
        assert np.abs(opencv(rays, self.given) - flat[:, 0]).max() < 1e-3
        return np.asarray(rays.reshape(*px.shape[:-1], 3))

    def project(self, points_cam: Array) -> Array:
        """The room asks for the window that a box lies in: all of it, as its edges are not straight here."""
        return np.array([[0.0, 0.0], [self.width, self.height]])


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """24 frames of the room at 240x180 and 15 frames a second: through a pinhole, and through a bent lens."""
    folder, made = tmp_path_factory.mktemp("lens"), {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "CLIP_FPS", 15.0)
        made["straight"] = synthetic.make_room_clip(folder / "straight", 24, *ROOM_SIZE)
        patch.setattr(synthetic, "room_camera", lambda width, height: BentCamera(ROOM, *ROOM_SIZE))
        patch.setattr(synthetic, "_info", lambda *_: {"depth_scale": synthetic.DEPTH_SCALE})
        made["bent"] = synthetic.make_room_clip(folder / "bent", 24, *ROOM_SIZE)
    return made


@pytest.fixture(scope="module")
def track(clips: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    def call(clip: str, intrinsics: tuple[float, ...], *words: str) -> Path:
        out = tmp_path_factory.mktemp("runs") / clip
        given = ",".join(map(str, intrinsics))
        assert main(["run", str(clips[clip]), "--out", str(out), "--quiet", "--intrinsics", given, *words]) == 0
        return out

    return call


def figures(run: Path) -> dict[str, Any]:
    data: dict[str, Any] = json.loads((run / "metrics.json").read_text())
    return data


def test_a_calibrated_bent_lens_is_as_good_as_a_straight_one(track: Callable[..., Path]) -> None:
    """ATE within 1.5 times that of the pinhole, and far below that of the same lens without its distortion."""
    straight = figures(track("straight", (225, 225, 119.5, 89.5), "--no-map"))
    run = track("bent", ROOM, "--no-map")
    distorted, ignored = figures(run), figures(track("bent", ROOM[:4], "--no-map"))
    assert distorted["frames_posed"] == 24
    assert distorted["ate_rmse_all"] < 1.5 * straight["ate_rmse_all"]
    assert distorted["ate_rmse_all"] < 0.3 * ignored["ate_rmse_all"]
    camera, record = json.loads((run / "camera.json").read_text()), json.loads((run / "run.json").read_text())
    assert [camera[k] for k in ("fx_px", "fy_px", "cx_px", "cy_px", "width", "height")] == [*ROOM[:4], *ROOM_SIZE]
    assert (camera["k1"], camera["k2"], camera["k3"]) == (-0.28, 0.09, 0.0)
    assert camera["distortion"] == list(ROOM[4:])
    assert main(["export", str(run), "--to", "colmap", "--out", str(run / "colmap"), "--no-undistort"]) == 0
    words = (run / "colmap" / "sparse" / "0" / "cameras.txt").read_text().splitlines()[1].split()
    assert words[1] == "OPENCV" and [float(w) for w in words[4:]] == [225, 220.5, 123.5, 87.5, *ROOM[4:]]
    errors_px = read_binary(run / "colmap" / "sparse" / "0").errors_px()  # tracks come back through the lens
    assert len(errors_px) > 1000 and 0 < errors_px.mean() < 1
    assert record["camera"]["distortion"] == list(ROOM[4:]) and record["camera"]["found"] == "given"
    assert distorted["focal_px"] == record["camera"]["focal_px"] == pytest.approx(np.sqrt(ROOM[0] * ROOM[1]))
    assert any(c.startswith("lens: photographs rectified to a pinhole of 222.7 px") for c in record["choices"])
    assert "225.0\n  - 220.5" in (run / "config.yaml").read_text()  # what was given, not what was made of it


def test_masks_come_back_in_pixels_of_the_photograph(track: Callable[..., Path]) -> None:
    """The ball is found as well as through the pinhole; a mask that is known lands where OpenCV says."""
    run = track("bent", ROOM, "--no-map", "--pointmaps", "depth")
    straight = figures(track("straight", (225, 225, 119.5, 89.5), "--no-map", "--pointmaps", "depth"))
    assert figures(run)["mask_iou"] > 0.8 * straight["mask_iou"]
    r = rectifier_for(ROOM, ROOM_SIZE)
    assert r is not None
    points = spread_rays(r, 12.0)[[0, 7, 19]]  # two near corners, one within
    known = spots(r.pinhole.project(points), r.size)[..., 0].astype(np.float32) / 255

    class Known(LogOddsModel):
        """A smoother that says the same of every frame."""

        def smoother(self, *_: Any) -> Any:
            return self

        def masks(self, inputs: Iterator[tuple[DynamicsInput, Any]]) -> Iterator[tuple[DynamicMask, Any]]:
            for frame, beside in inputs:
                assert frame.gray.shape == known.shape  # this clip is small: tracking shrinks nothing
                yield DynamicMask(known, known > 0.5, {}), beside

    with DYNAMICS.registered("known", Known):
        run = track("bent", ROOM, "--no-map", "--set", "dynamics.variant=known")
    files = sorted((run / "masks").iterdir())
    assert len(files) == 24
    mask = cv2.imread(str(files[5]), cv2.IMREAD_UNCHANGED)
    assert mask is not None and mask.shape == ROOM_SIZE[::-1]
    for wanted in opencv(points, ROOM):
        assert np.abs(centroid(mask[..., None], wanted, 7) - wanted).max() < 0.1


@pytest.mark.usefixtures("short_flight")
def test_renders_are_photographs_of_the_bent_lens(track: Callable[..., Path], clips: dict[str, Path]) -> None:
    words = ["mapping.iterations=150", "mapping.width_px=120", "tracking.cell_px=5"]
    run = track("bent", ROOM, *(w for word in words for w in ("--set", word)))
    files = sorted((run / "renders").iterdir())
    assert len(files) == 3 and figures(run)["psnr_holdout"] > 17
    r = rectifier_for(ROOM, ROOM_SIZE)
    assert r is not None
    for file in files:
        render, photograph = cv2.imread(str(file)), cv2.imread(str(clips["bent"] / "rgb" / file.name))
        assert render is not None and photograph is not None and render.shape == (90, 120, 3)
        straight = cv2.resize(r.image(photograph), (120, 90), interpolation=cv2.INTER_AREA)
        distorted = cv2.resize(photograph, (120, 90), interpolation=cv2.INTER_AREA)
        assert cv2.PSNR(render, distorted) > cv2.PSNR(render, straight) + 1


# -- what the report says ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("camera", "said"),
    [
        ({"found": "from the video", "focal_sigma_ratio": 0.004}, ["527.9 px ± 0.4 %", "width, from the video (1σ)"]),
        ({"found": "from the video", "focal_sigma_ratio": 0.123}, ["527.9 px ± 12 %"]),
        ({"found": "assumed", "focal_sigma_ratio": 0.25}, ["527.9 px ± 25 %", "width, assumed (1σ of most cameras)"]),
        ({"found": "from the video", "focal_sigma_ratio": 1e-6}, ["527.9 px ± under 0.01 %"]),
        ({"found": "from the video", "focal_sigma_ratio": None}, ["527.9 px<"]),
        ({"found": "given", "focal_sigma_ratio": None}, ["527.9 px<", "Focal length at full width, given"]),
        (None, ["527.9 px<"]),
    ],
)
def test_the_report_says_how_sure_the_focal_length_is(camera: dict[str, Any] | None, said: list[str]) -> None:
    empty = Trajectory(np.zeros(0), np.zeros((0, 4, 4)), (), np.zeros(0, bool))
    record = {} if camera is None else {"camera": camera}
    metrics = {"frames": 3, "focal_px": 527.94}
    page = report_html(ReportData("a run", empty, np.zeros((0, 3)), None, "m", (), (), metrics, record, ""))
    for words in said:
        assert words in page
    assert ("±" in page) == ("±" in said[0])
