"""What image motion lets be known: a tripod, a turn, a plane and parallax told apart, and how sure the lens is."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mastd3r.cli.main import main
from mastd3r.config import CameraConfig, Config, GraphConfig
from mastd3r.errors import InputError
from mastd3r.export.read_run import read_run
from mastd3r.export.report import ReportData, report_html
from mastd3r.geometry.se3 import inverse, se3_exp, so3_exp, so3_log, transform
from mastd3r.graph.focal_sigma import SYSTEMATIC, focal_knowledge
from mastd3r.graph.initialisation import bootstrap, first_pairs
from mastd3r.graph.intrinsics import PRIOR_FOCAL_SIGMA, intrinsics_for
from mastd3r.graph.keyframe_graph import KeyframeGraph
from mastd3r.graph.observability import PairMotion, explained_by_turn, noise_of, observability
from mastd3r.graph.turning import observed, put_at_infinity
from mastd3r.offline.final_solve import finish_graph
from mastd3r.types import Matches, Trajectory

Array = NDArray[Any]
CASES = Path(__file__).resolve().parents[2] / "shared" / "cases"
VIEWS = 5
LOW_PX, HIGH_PX = 0.1, 0.8  # noise of a match


def turning(scene: Any, step_rad: float = 0.06) -> Any:
    """The same wall from one place: every view turned a little further."""
    axis = np.array([0.15, 1.0, 0.05])
    poses = [np.eye(4) for _ in scene.cam_from_world]
    for k, pose in enumerate(poses):
        pose[:3, :3] = so3_exp(step_rad * (axis * k + [np.sin(2.0 * k) / 3, 0, np.cos(3.0 * k) / 2]))
    return replace(scene, cam_from_world=tuple(poses))


def graph_of(
    scene: Any,
    noise_px: float,
    *,
    moves: tuple[Array, Array] | None = None,
    plane: tuple[float, float] | None = None,
    camera: CameraConfig | None = None,
    solved: bool = False,
) -> KeyframeGraph:
    """Matches between all views. ``moves``: which points (p,) move by themselves, and their step (2,) a view.

    ``plane``: slopes of a flat wall, which is seen instead of the scene's. ``solved``: true poses, depths and lens.
    """
    size = (scene.width, scene.height)
    graph = KeyframeGraph(GraphConfig(), intrinsics_for(camera or CameraConfig(), *size, size))
    p, views = len(scene.px), len(scene.cam_from_world)
    for k in range(views):
        still = np.zeros((scene.height, scene.width))
        pose = scene.cam_from_world[k] @ inverse(scene.cam_from_world[0]) if solved else np.eye(4)
        inv_depth = 1 / scene.depth(k) if solved else np.ones(p)
        graph.add_keyframe(scene.work_frame(k), np.ones(p), still, pose, inv_depth, np.full(p, 1e-2))
        graph.record(scene.work_frame(k), k, np.eye(4), "tracked", None, np.zeros(0))
        graph.replace_last_by_keyframe(graph.latest)
    for i in range(views):
        for j in range(views):
            if i == j or abs(i - j) > 3:
                continue
            m = scene.matches(i, j, noise_px) if plane is None else on_plane(scene, i, j, plane, noise_px)
            target = m.new_px if moves is None else m.new_px + moves[0][:, None] * moves[1] * (j - i)
            graph.connect(i, j, Matches(m.ref_px, target, m.weight), np.ones(p))
    if solved:
        graph.intrinsics.values = scene.lens.copy()
        graph.started.add(0)
    return graph


def on_plane(scene: Any, i: int, j: int, slopes: tuple[float, float], noise_px: float) -> Matches:
    """Matches of the wall z = 3 + a x + b y."""
    world_from_cam = inverse(scene.cam_from_world[i])
    normal = np.array([-slopes[0], -slopes[1], 1.0])
    rays = scene.rays(scene.px)
    depth = (3.0 - normal @ world_from_cam[:3, 3]) / (rays @ world_from_cam[:3, :3].T @ normal)
    new = transform(scene.j_from_i(i, j), rays * depth[:, None])
    target = scene.pixels(new)
    inside = (target > 0).all(1) & (target < [scene.width - 1, scene.height - 1]).all(1) & (depth > 0)
    noise = np.random.default_rng((7, i, j)).normal(0, noise_px, target.shape)
    return Matches(scene.px, target + noise, inside.astype(float))


def standing(scene: Any) -> Any:
    return replace(scene, cam_from_world=(np.eye(4),) * VIEWS)


def box(scene: Any, centre: tuple[float, float], half: tuple[float, float]) -> Array:
    return np.asarray((np.abs(scene.px - centre) < half).all(1))


@pytest.fixture(scope="module")
def scene(exact_scene: Callable[..., Any]) -> Any:
    return exact_scene(VIEWS, step=0.15, focal_px=280.0, cell_px=14)


def kind_of(graph: KeyframeGraph) -> str:
    return observed(graph, graph.members())[0].kind


# -- what is refused and what is not ---------------------------------------------------------------------------------


@pytest.mark.parametrize("noise_px", [LOW_PX, HIGH_PX])
@pytest.mark.parametrize("half", [(40, 40), (110, 90)], ids=["a car", "a bus that fills half of the picture"])
def test_traffic_before_a_tripod_is_no_parallax(scene: Any, noise_px: float, half: tuple[float, float]) -> None:
    still = standing(scene)
    graph = graph_of(still, noise_px, moves=(box(still, (150, 120), half), np.array([9.0, 3.0])))
    assert kind_of(graph) == "none"
    assert not bootstrap(graph).started and not graph.started
    with pytest.raises(
        InputError, match=r"^the camera never moves: expected .*, got \d\d% of the matches, .* 5 frames"
    ):
        finish_graph(graph, Config())


@pytest.mark.parametrize("noise_px", [LOW_PX, HIGH_PX])
@pytest.mark.parametrize("with_car", [False, True])
@pytest.mark.parametrize("focal_px", [220.0, 330.0])
def test_a_camera_that_only_turns(
    exact_scene: Callable[..., Any], noise_px: float, with_car: bool, focal_px: float
) -> None:
    """Rotations and the focal length come out, no place changes and no point has a depth."""
    scene = turning(exact_scene(VIEWS, focal_px=focal_px, cell_px=10))
    car = box(scene, (160, 150), (50, 40)), np.array([4.0, -9.0])
    graph = graph_of(scene, noise_px, moves=car if with_car else None)
    assert kind_of(graph) == "rotation" and not bootstrap(graph).started
    seen = finish_graph(graph, Config())
    assert seen is not None and seen.kind == "rotation" and graph.started == {0}
    for k in range(VIEWS):
        assert np.linalg.norm(graph.world_from_cam(k)[:3, 3]) < 1e-12
        off = graph.world_from_cam(k)[:3, :3].T @ (scene.cam_from_world[0] @ inverse(scene.cam_from_world[k]))[:3, :3]
        assert np.linalg.norm(so3_log(off)) < 0.003 + 0.04 * noise_px * (0.06 * k)
        assert not graph.variables[k].inv_depth.any()
    known = focal_knowledge(graph)
    assert known is not None and not known.assumed
    assert abs(np.log(np.exp(graph.intrinsics.values[0]) / focal_px)) < 2 * known.sigma_ratio


@pytest.mark.parametrize("noise_px", [LOW_PX, HIGH_PX])
def test_real_parallax_is_accepted(scene: Any, noise_px: float) -> None:
    graph = graph_of(scene, noise_px)
    seen, _ = observed(graph, graph.members())
    assert seen.kind == "parallax" and seen.supports > 0.5 * seen.cells and seen.turn_ratio < 0.5
    assert bootstrap(graph).started
    assert (found := finish_graph(graph, Config())) is not None and found.kind == "parallax"


@pytest.mark.parametrize("noise_px", [LOW_PX, HIGH_PX])
@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.5, -0.2)])
def test_a_plane_that_a_camera_passes_is_not_refused(scene: Any, noise_px: float, slopes: tuple[float, float]) -> None:
    graph = graph_of(scene, noise_px, plane=slopes)
    assert kind_of(graph) == "plane"
    assert bootstrap(graph).started


def test_a_shift_along_a_wall_is_no_turn(scene: Any) -> None:
    """Under a focal length that no camera has a turn would look the same."""
    aside = tuple(se3_exp(np.array([-0.25 * k, 0, 0, 0, 0, 0])) for k in range(VIEWS))
    graph = graph_of(replace(scene, cam_from_world=aside), LOW_PX, plane=(0.0, 0.0))
    assert kind_of(graph) == "plane"


def test_a_bonnet_before_a_moving_camera_is_no_tripod(scene: Any) -> None:
    graph = graph_of(scene, LOW_PX)
    bonnet = scene.px[:, 1] > 190
    for e in graph.edges:
        e.target = np.where(bonnet[:, None], scene.px, e.target)
    assert 0.15 < bonnet.mean() < 0.25
    assert kind_of(graph) == "parallax"


def test_a_turn_followed_by_a_walk_starts_with_the_walk(scene: Any) -> None:
    """Three views from one place, then three that leave it: depth is there, and not from the turn."""
    turned = turning(scene).cam_from_world[:3]
    walked = [pose @ turned[-1] for pose in (scene.j_from_i(0, k) for k in (1, 2, 3))]
    mixed = replace(scene, cam_from_world=(*turned, *walked))
    graph = graph_of(mixed, LOW_PX)
    seen, pairs = observed(graph, graph.members())
    assert seen.kind == "parallax"
    turns = {(p.ref, p.new) for p in pairs if explained_by_turn(p, seen.noise_px, graph.size)}
    assert {(i, j) for i, j in turns if i < j} == {(0, 1), (0, 2), (1, 2)}
    assert not turns & {(e.i, e.j) for e in first_pairs(graph, turns)}
    assert bootstrap(graph).started
    seen = finish_graph(graph, Config())
    assert seen is not None and seen.kind == "parallax"
    assert np.linalg.norm(graph.world_from_cam(5)[:3, 3]) > 5 * np.linalg.norm(graph.world_from_cam(2)[:3, 3])


def test_a_part_that_only_turns_changes_nothing_for_the_rest(scene: Any) -> None:
    """The second of two submaps turns: it is solved as ever."""
    graph = graph_of(scene, LOW_PX)
    assert bootstrap(graph).started
    graph.start_submap()
    second = graph_of(turning(scene), LOW_PX)
    for kf in second.keyframes:
        p = len(scene.px)
        graph.add_keyframe(kf.work, np.ones(p), kf.moving / 255, np.eye(4), np.ones(p), np.full(p, 1e-2))
    for e in second.edges:
        graph.connect(e.i + VIEWS, e.j + VIEWS, Matches(scene.px, e.target, e.weight), np.ones(len(e.weight)))
    assert len(graph.roots()) == 2 and kind_of(graph) == "rotation"
    before = len(graph.started)
    bootstrap(graph)
    assert len(graph.started) >= before and 0 in graph.started


# -- the statistics --------------------------------------------------------------------------------------------------


def random_pairs(
    noise_px: float, seed: int = 0, count: int = 400, size: tuple[int, int] = (320, 240)
) -> list[PairMotion]:
    """Two views both ways whose matches differ from the prediction by noise alone; the image moves by 10 px."""
    rng = np.random.default_rng(seed)
    px = rng.uniform([15, 15], [size[0] - 15, size[1] - 15], (count, 2))
    shift = np.array([10.0, 0.0])
    there, back = rng.normal(0, noise_px, (2, count, 2))
    return [PairMotion(0, 1, px, px + shift + there, there), PairMotion(1, 0, px + shift, px + back, back)]


@pytest.mark.parametrize("noise_px", [0.05, 0.2, 0.6])
def test_noise_is_measured_there_and_back(noise_px: float) -> None:
    pairs = random_pairs(noise_px)
    assert noise_of(pairs, [p.off_turn_px for p in pairs], (320, 240)) == pytest.approx(noise_px, rel=0.15)


def test_noise_leaves_out_parallax() -> None:
    """Parallax there is the negative of parallax back."""
    pairs = random_pairs(0.1)
    parallax = np.outer(np.sin(pairs[0].ref_px[:, 0] / 40), [1.5, 0.0])
    off = [pairs[0].off_turn_px + parallax, pairs[1].off_turn_px - parallax]
    assert noise_of(pairs, off, (320, 240)) == pytest.approx(0.1, rel=0.15)


def test_one_way_says_nothing_of_noise() -> None:
    pairs = random_pairs(0.3)[:1]
    assert noise_of(pairs, [pairs[0].off_turn_px], (320, 240)) == 0.0


@pytest.mark.parametrize("noise_px", [0.05, 0.6])
@pytest.mark.parametrize("seed", range(5))
def test_the_decision_does_not_depend_on_order_size_or_side(noise_px: float, seed: int) -> None:
    """A permutation of the matches, a picture twice as large, and its mirror image are decided alike."""
    rng, size = np.random.default_rng(seed), (320, 240)
    pairs = random_pairs(noise_px, seed)
    share = rng.uniform(0, 1)
    moving = rng.uniform(0, 1, 400) < share
    parallax = rng.uniform(4, 20, (400, 2)) * moving[:, None]
    a, b = pairs
    pairs = [
        PairMotion(0, 1, a.ref_px, a.new_px + parallax, a.off_turn_px + parallax),
        PairMotion(1, 0, b.ref_px + parallax, b.new_px, b.off_turn_px - parallax),
    ]
    found = observability(pairs, size)
    assert found.kind == ("rotation" if share < 0.25 else found.kind)
    assert found.kind == ("parallax" if share > 0.55 else found.kind)
    order = rng.permutation(400)
    shuffled = [PairMotion(p.ref, p.new, p.ref_px[order], p.new_px[order], p.off_turn_px[order]) for p in pairs]
    twice = [PairMotion(p.ref, p.new, 2 * p.ref_px + 0.5, 2 * p.new_px + 0.5, 2 * p.off_turn_px) for p in pairs]
    flip = np.array([-1.0, 1.0])
    mirrored = [
        PairMotion(p.ref, p.new, p.ref_px * flip + [319, 0], p.new_px * flip + [319, 0], p.off_turn_px * flip)
        for p in pairs
    ]
    assert observability(shuffled, size) == replace(found, plane_ratio=observability(shuffled, size).plane_ratio)
    assert observability(twice, (640, 480)).kind == observability(mirrored, size).kind == found.kind


def test_without_pairs_nothing_speaks_against_parallax() -> None:
    found = observability([], (320, 240))
    assert found.kind == "parallax" and found.pairs == found.supports == 0


# -- the focal length ------------------------------------------------------------------------------------------------


def test_a_larger_turn_tells_more_of_the_focal_length(scene: Any) -> None:
    sigmas = []
    for step_rad in (0.01, 0.03, 0.09):
        graph = graph_of(turning(scene, step_rad), 0.2)
        put_at_infinity(graph)
        graph.solve_all(20, 0.5)
        known = focal_knowledge(graph)
        assert known is not None
        sigmas.append(known.sigma_ratio)
    assert sigmas[0] > sigmas[1] > sigmas[2] >= 0.9 * SYSTEMATIC


def test_a_turn_of_next_to_nothing_leaves_the_focal_length_assumed(scene: Any) -> None:
    graph = graph_of(turning(replace(scene, cam_from_world=scene.cam_from_world[:2]), 0.004), 0.3)
    put_at_infinity(graph)
    graph.solve_all(20, 0.5)
    known = focal_knowledge(graph)
    assert known is not None and known.assumed and known.sigma_ratio <= PRIOR_FOCAL_SIGMA
    assert np.exp(graph.intrinsics.values[0]) == pytest.approx(np.sqrt(320 * 240), rel=0.15)


def test_noise_makes_the_focal_length_less_sure(scene: Any) -> None:
    sigmas = []
    for noise_px in (0.05, 0.3, 1.0):
        graph = graph_of(scene, noise_px, solved=True)
        graph.solve_all(20, 0.5)
        known = focal_knowledge(graph)
        assert known is not None
        sigmas.append(known.sigma_ratio)
    assert sigmas == sorted(sigmas) and sigmas[2] > 1.5 * sigmas[0]


def test_a_given_focal_length_has_no_sigma(scene: Any) -> None:
    graph = graph_of(scene, LOW_PX, camera=CameraConfig(intrinsics=(280.0, 280.0, 159.5, 119.5)))
    assert bootstrap(graph).started
    graph.solve_all(5, 0.5)
    assert focal_knowledge(graph) is None


# -- whole runs ------------------------------------------------------------------------------------------------------


def test_the_report_says_first_what_is_missing() -> None:
    empty = Trajectory(np.zeros(0), np.zeros((0, 4, 4)), (), np.zeros(0, bool))
    record = {"observability": {"kind": "rotation", "said": "the camera only <turns>"}}
    page = report_html(ReportData("a run", empty, np.zeros((0, 3)), None, "m", (), (), {}, record, ""))
    assert page.index('<p class="banner">the camera only &lt;turns&gt;</p>') < page.index("<section>")
    assert "banner" not in page_body(
        report_html(ReportData("a run", empty, np.zeros((0, 3)), None, "m", (), (), {}, {}, ""))
    )


def page_body(page: str) -> str:
    return page[page.index("<body") :]


def case(name: str) -> Path:
    path = CASES / name
    if not path.exists():
        pytest.skip(f"{path}: not there")
    return path


def test_traffic_seen_from_a_real_tripod_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clip = case("static_tripod_traffic/traffic_small.mp4")
    assert main(["run", str(clip), "--no-map", "--quiet", "--out", str(tmp_path / "out")]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and "the camera never moves: expected" in lines[0] and "60 frames" in lines[0]
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["status"] == "incomplete" and record["reason"].startswith("the camera never moves")
    invented = ("trajectory.txt", "keyframes.txt", "camera.json", "cloud.ply", "metrics.json", "report.html")
    assert not [name for name in invented if (tmp_path / "out" / name).exists()] and "camera" not in record


def test_a_clip_that_only_turns_gives_rotations_and_lens(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """280 px and 11.5 degrees are true; a map was asked for, and none is made."""
    clip, out = case("pure_rotation/purerot.mp4"), tmp_path / "out"
    assert main(["run", str(clip), "--quiet", "--out", str(out)]) == 0
    said = "the camera only turns: rotations and the lens are found, no depth, no translation, no map"
    assert capsys.readouterr().out.startswith(said)
    run = read_run(out)
    poses = run.trajectory.world_from_cam
    assert len(poses) == 24 and not poses[:, :3, 3].any()
    assert np.degrees(np.linalg.norm(so3_log(poses[0, :3, :3].T @ poses[-1, :3, :3]))) == pytest.approx(11.5, abs=0.2)
    assert run.record["observability"]["kind"] == "rotation" and run.record["observability"]["said"] == said
    assert run.record["camera"]["found"] == "from the video" and said in run.record["choices"]
    assert run.metrics["focal_px"] == pytest.approx(280, rel=0.01)
    assert json.loads((out / "camera.json").read_text())["focal_sigma_ratio"] == run.metrics["focal_sigma_ratio"] < 0.05
    assert not [name for name in ("cloud.ply", "gaussians.ply", "flight.mp4") if (out / name).exists()]
    assert not {"cloud_mib", "ate_rmse_all", "psnr_holdout", "gaussians"} & set(run.metrics)
    assert len(list((out / "masks").glob("*.png"))) == 24 and said in (out / "report.html").read_text()
