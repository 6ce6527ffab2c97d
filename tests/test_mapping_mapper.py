"""The mapper on a synthetic world of Gaussians whose truth is known."""

from __future__ import annotations

import time
from copy import deepcopy
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from mastd3r.camera.pinhole import Camera
from mastd3r.config import MapLossKind, MappingConfig
from mastd3r.errors import ConfigError, InputError
from mastd3r.mapping.gaussians import GaussianMap
from mastd3r.mapping.mapper import LEAST_SIGMA_PX, MOST_SIGMA_RATIO, Mapper
from mastd3r.mapping.seed import seed_gaussians
from mastd3r.types import StaticCloud, View

CAMERA = Camera.centred(80.0, 96, 72)
STEPS = 160


def wall(count: int, noise: float) -> StaticCloud:
    """Points of a wavy, textured wall 3 units away; texture is a function of the place."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-2.4, 2.4, count), rng.uniform(-1.9, 1.9, count)
    z = 3 + 0.3 * np.sin(2 * x) + noise * rng.standard_normal(count)
    rgb = np.stack([0.5 + 0.4 * np.sin(5 * x), 0.5 + 0.4 * np.cos(4 * y), 0.5 + 0.4 * np.sin(3 * (x + y))], 1)
    return StaticCloud(
        points_world=np.stack([x, y, z], 1).astype(np.float32),
        colors=(rgb * 255).astype(np.uint8),
        confidence=np.ones(count, np.float32),
        spacing=np.full(count, np.sqrt(4.8 * 3.8 / count), np.float32),
        kf_id=(np.arange(count) % 3).astype(np.int32),
    )


def pose(i: int) -> np.ndarray:
    world_from_cam = np.eye(4)
    world_from_cam[:3, 3] = [0.35 * np.cos(0.7 * i), 0.25 * np.sin(0.9 * i), 0.1 * np.sin(i)]
    return world_from_cam


def photograph(truth: GaussianMap, world_from_cam: np.ndarray) -> np.ndarray:
    with torch.no_grad():
        cam_from_world = torch.from_numpy(np.linalg.inv(world_from_cam))
        K = torch.from_numpy(CAMERA.matrix)
        return truth.draw(cam_from_world, K, CAMERA.width, CAMERA.height, 0.1)[0].clamp(0, 1).numpy()


@pytest.fixture(scope="module")
def truth() -> GaussianMap:
    gaussians = seed_gaussians(wall(6000, 0.0), 6000, 0)
    with torch.no_grad():
        gaussians.opacity_logits += 3
    return gaussians


def view(truth: GaussianMap, i: int, gain: float = 1.0, ghost: bool = False) -> View:
    """Photograph number i; with ``ghost`` a white block stands in most frames in one place of the world."""
    image, static = photograph(truth, pose(i)) * np.float32(gain), np.ones((72, 96), np.float32)
    if ghost and i % 4 != 0:
        centre = CAMERA.project((np.array([0.1, 0, 2.0]) - pose(i)[:3, 3])[None])[0].round().astype(int)
        block = (slice(centre[1] - 10, centre[1] + 10), slice(centre[0] - 8, centre[0] + 8))
        image[block], static[block] = 1.0, 0.03
    return View(float(i), np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8), static, pose(i), CAMERA, i % 3)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.square(a - b).mean()))


def trained(
    views: list[View], loss: MapLossKind = "full", steps: int = STEPS, refined: int | None = None, **options: object
) -> Mapper:
    """``refined``: of ``steps``, so many are done."""
    config = MappingConfig(iterations=steps, max_gaussians=5000, loss=loss, **options)  # type: ignore[arg-type]
    mapper = Mapper(config, wall(1500, 0.03), views, seed=0)
    mapper.refine(steps if refined is None else refined)
    return mapper


@pytest.fixture(scope="module")
def mapper(truth: GaussianMap) -> Mapper:
    return trained([view(truth, i) for i in range(12)])


def holdout_psnr(mapper: Mapper, truth: GaussianMap) -> float:
    return psnr(mapper.render(pose(100), CAMERA)[0], photograph(truth, pose(100)))


def test_training_improves_an_unseen_view_and_grows_within_bounds(truth: GaussianMap, mapper: Mapper) -> None:
    start = holdout_psnr(trained([view(truth, 0)], steps=0), truth)
    assert holdout_psnr(mapper, truth) > max(start + 4, 24)
    assert 900 < len(mapper.gaussians.means) <= 5000


def test_depth_is_in_map_units(mapper: Mapper) -> None:
    _, depth, alpha = mapper.render(pose(100), CAMERA)
    middle = depth[20:52, 30:66][alpha[20:52, 30:66] > 0.9]
    x = (np.arange(30, 66) - CAMERA.cx_px) / CAMERA.fx_px * 3 + pose(100)[0, 3]
    assert np.median(middle) == pytest.approx(3 + np.mean(0.3 * np.sin(2 * x)) - pose(100)[2, 3], abs=0.12)


def test_same_seed_same_map(truth: GaussianMap) -> None:
    views = [view(truth, i) for i in range(4)]
    a, b = trained(views, steps=60).gaussians, trained(views, steps=60).gaussians
    assert np.array_equal(a.means, b.means) and np.array_equal(a.colors, b.colors)


def test_a_moving_thing_leaves_no_ghost_under_the_mask_and_does_without(truth: GaussianMap) -> None:
    """Compared where the white block stood, from a frame in which it is absent."""
    views = [view(truth, i, ghost=True) for i in range(12)]
    block = (slice(26, 46), slice(40, 60))
    clean = photograph(truth, pose(0))[block]
    masked, plain = (psnr(trained(views, loss).render(pose(0), CAMERA)[0][block], clean) for loss in ("mask", "plain"))
    assert masked > 18 and masked > plain + 5


def test_the_file_has_the_colours_of_the_mean_exposure(truth: GaussianMap) -> None:
    """Half of the photographs are darker by a fifth: the views learn it, and the map stands between, once settled."""
    mapper = trained([view(truth, i, gain=0.8 if i < 6 else 1.0) for i in range(12)], steps=320, refined=240)
    mapper.settle()
    exposures = []
    for i in (2, 9):
        picture, _, alpha = (torch.from_numpy(p) for p in mapper.render(pose(i), CAMERA))
        exposures.append(float(mapper._view_parameters.exposed(picture, alpha, i).detach().mean() / picture.mean()))
    assert exposures[0] < 0.97 and exposures[1] > 1.03
    assert mapper.render(pose(100), CAMERA)[0].mean() == pytest.approx(
        0.9 * photograph(truth, pose(100)).mean(), rel=0.04
    )


def test_every_place_has_the_exposure_of_those_who_see_it(truth: GaussianMap) -> None:
    """The left half is seen by darker photographs: at the end so is the file there, which one mean cannot be."""
    views = []
    for i in range(12):
        seen = view(truth, i, gain=0.6 if i < 6 else 1.0)
        static = seen.static.copy()
        static[:, slice(48, None) if i < 6 else slice(0, 48)] = 0
        views.append(replace(seen, static=static))
    mapper = trained(views, steps=400)
    mapper.settle()
    drawn, photo = mapper.render(pose(3), CAMERA)[0], photograph(truth, pose(3))
    left, right = (drawn[:, part].mean() / photo[:, part].mean() for part in (slice(4, 36), slice(60, 92)))
    assert left == pytest.approx(0.6, rel=0.06) and right == pytest.approx(1.0, rel=0.06)


def test_settling_changes_no_picture_of_an_exposed_view(truth: GaussianMap) -> None:
    """Gain and bias move from the views to the map, together they stay what they were."""
    mapper = trained([view(truth, i, gain=0.8 if i < 6 else 1.0) for i in range(12)], steps=160, refined=120)

    def shown() -> torch.Tensor:
        color, _, alpha = (torch.from_numpy(p) for p in mapper.render(pose(2), CAMERA))
        return mapper._view_parameters.exposed(color, alpha, 2).detach()

    with torch.no_grad():  # as if all photographs were darker than the map
        for row in mapper._view_parameters._rows:
            row["log_gain"] -= 0.2
    before = shown()
    mapper.settle()
    log_gains = torch.stack([row["log_gain"].detach() for row in mapper._view_parameters._rows])
    assert log_gains.mean(0).abs().max() < 1e-6
    assert (shown() - before).abs().mean() < 0.002


def test_the_world_is_opaque_over_any_background(truth: GaussianMap, mapper: Mapper) -> None:
    """After 160 steps; a map that is trained over one colour has half of that."""
    _, _, alpha = mapper.render(pose(2), CAMERA)
    assert (alpha > 0.95).mean() > 0.92


def test_nothing_stands_right_before_a_camera(truth: GaussianMap) -> None:
    mapper = trained([view(truth, i) for i in range(6)], steps=20)
    with torch.no_grad():  # a floater that the camera of view 0 looks through
        mapper._map.means[5] = torch.from_numpy(pose(0)[:3, 3] + [0, 0, 0.3 * mapper._near]).float()
    floater = mapper.gaussians.means[5].copy()
    mapper.settle()
    assert np.linalg.norm(mapper.gaussians.means - floater, axis=1).min() > 0.1 * mapper._near


def test_no_gaussian_is_finer_than_the_views_can_tell(truth: GaussianMap) -> None:
    mapper = trained([view(truth, i) for i in range(6)], steps=20)
    with torch.no_grad():
        mapper._map.log_scales[:] = -12
    mapper.settle()
    smallest_px = mapper.gaussians.scales.min() * CAMERA.fx_px / 3
    assert smallest_px == pytest.approx(LEAST_SIGMA_PX, rel=0.3)


def test_what_lies_beside_a_camera_stays_small(truth: GaussianMap) -> None:
    """A large Gaussian below the camera: some viewers would draw it across the picture."""
    mapper = trained([view(truth, i) for i in range(6)], steps=20)
    with torch.no_grad():
        mapper._map.means[5] = torch.from_numpy(pose(0)[:3, 3] + [0, 1.0, 0.01]).float()
        mapper._map.log_scales[5] = 0.0
    mapper.settle()
    scales = mapper.gaussians.scales[np.abs(mapper.gaussians.means[:, 1] - pose(0)[1, 3] - 1.0).argmin()]
    assert scales.max() <= MOST_SIGMA_RATIO * 1.01


def test_what_the_cloud_leaves_open_is_seeded(truth: GaussianMap) -> None:
    """Points on the left half alone: before any training, every pixel has something behind it, as deep as the wall."""
    cloud = wall(1500, 0.03)
    left = cloud.points_world[:, 0] < -0.2
    half = StaticCloud(*(getattr(cloud, f.name)[left] for f in fields(cloud)))
    views = [view(truth, i) for i in range(6)]
    mapper = Mapper(MappingConfig(iterations=10, max_gaussians=8000), half, views, seed=0)
    _, depth, alpha = mapper.render(pose(0), CAMERA)
    assert (alpha > 0.5).mean() > 0.97
    assert np.median(depth[:, 70:]) == pytest.approx(3, rel=0.15)


def test_small_images_train_the_same_world(truth: GaussianMap, monkeypatch: pytest.MonkeyPatch) -> None:
    """Trained at a quarter and half of the width alone: at full width nothing is aside, not by half a pixel."""
    monkeypatch.setattr("mastd3r.mapping.schedule.SMALLEST_PX", 20)
    config = MappingConfig(iterations=600, max_gaussians=5000)
    mapper = Mapper(config, wall(1500, 0.03), [view(truth, i) for i in range(12)], seed=0)
    shrinks = {mapper._pace.shrink}
    mapper.refine(299, lambda _step, _loss: shrinks.add(mapper._pace.shrink))
    assert shrinks == {4, 2}
    drawn, photo = mapper.render(pose(2), CAMERA)[0], photograph(truth, pose(2))
    aside = [
        replace(CAMERA, cx_px=CAMERA.cx_px + x, cy_px=CAMERA.cy_px + y) for x, y in ((0.5, 0), (-0.5, 0), (0, 0.5))
    ]
    assert psnr(drawn, photo) > 22
    assert all(psnr(mapper.render(pose(2), camera)[0], photo) < psnr(drawn, photo) - 0.2 for camera in aside)


def test_a_training_in_seconds_ends_in_time(truth: GaussianMap) -> None:
    config = MappingConfig(iterations=100, max_gaussians=2000)
    mapper = Mapper(config, wall(1500, 0.03), [view(truth, i) for i in range(4)], seed=0)
    mapper.refine(2)
    steps: list[int] = []
    began = time.monotonic()
    mapper.refine_for(0.5, lambda step, _: steps.append(step))
    assert 0.4 < time.monotonic() - began < 5 and len(steps) >= 1


def test_pose_refinement_pulls_wrong_cameras_back(truth: GaussianMap) -> None:
    """In pixels of the wall's points: shift and turn can stand in for one another on a distant wall."""
    views = [view(truth, i) for i in range(8)]
    wrong = pose(3)
    wrong[:3, 3] += [0.08, 0, 0]
    views[3] = View(3.0, views[3].image, views[3].static, wrong, CAMERA, 0)
    mapper = trained(views, steps=300, refine_poses=True)
    points = wall(200, 0.0).points_world.astype(float)

    def error_px(cam_from_world: np.ndarray) -> float:
        pixels = [CAMERA.project(points @ t[:3, :3].T + t[:3, 3]) for t in (cam_from_world, np.linalg.inv(pose(3)))]
        return float(np.linalg.norm(pixels[0] - pixels[1], axis=1).mean())

    assert error_px(np.linalg.inv(wrong)) > 1.5
    assert error_px(mapper._view_parameters.cam_from_world(3).detach().numpy()) < 0.5


def test_a_graph_correction_keeps_the_picture(truth: GaussianMap) -> None:
    """All keyframes shift by 5 cm, as after a loop closure: the equally shifted camera sees the same."""
    mapper = trained([view(truth, i) for i in range(6)], steps=60)
    before = mapper.render(pose(100), CAMERA)[0]
    shift = np.eye(4)
    shift[:3, 3] = [0.05, 0, 0]
    old = {k: np.eye(4) for k in range(3)}
    mapper.move_keyframes(old, dict.fromkeys(range(3), shift))
    assert np.abs(mapper.render(shift @ pose(100), CAMERA)[0] - before).max() < 1e-3
    losses: list[float] = []
    mapper.refine(6, lambda _, loss: losses.append(loss))
    assert len(losses) == 6 and max(losses) < 0.2


class Bent:
    """The wall, trained while its three keyframes had drifted apart: keyframe k by ``first + k * step`` along x."""

    def __init__(self, truth: GaussianMap, first: float, step: float) -> None:
        self.truth, self.straight = truth, {k: np.eye(4) for k in range(3)}
        self.drift = {k: np.eye(4) for k in range(3)}
        for k, moved in self.drift.items():
            moved[0, 3] = first + k * step
        straight, cloud = [view(truth, i) for i in range(12)], wall(1500, 0.03)
        drifted = [replace(v, world_from_cam=self.drift[v.kf_id] @ v.world_from_cam) for v in straight]
        shift = np.stack([self.drift[k][:3, 3] for k in cloud.kf_id])
        apart = replace(cloud, points_world=(cloud.points_world + shift).astype(np.float32))
        config = MappingConfig(iterations=STEPS, max_gaussians=3000, loss="plain", refine_poses=True)
        self.mapper = Mapper(config, apart, drifted, seed=0)
        self.mapper.refine(STEPS)

    def quality(self, world_from_kf: dict[int, np.ndarray]) -> float:
        """Of unseen frames that hang on the three keyframes, wherever those are."""
        seen = [(photograph(self.truth, pose(i)), world_from_kf[i % 3] @ pose(i)) for i in (99, 100, 101)]
        return float(np.mean([psnr(self.mapper.render(at, CAMERA)[0], photo) for photo, at in seen]))


def test_a_loop_correction_of_5_cm_costs_under_half_a_decibel(truth: GaussianMap) -> None:
    """Trained while the keyframes had drifted by 4, 5 and 6 cm; the correction puts them right, nothing restarts."""
    distorted = Bent(truth, 0.04, 0.01)
    before = distorted.quality(distorted.drift)
    distorted.mapper.move_keyframes(distorted.drift, distorted.straight)
    assert distorted.quality(distorted.straight) > before - 0.5
    distorted.mapper.refine(20)
    assert distorted.quality(distorted.straight) > before - 0.5


def test_a_room_that_was_bent_by_5_cm_is_straight_again(truth: GaussianMap, monkeypatch: pytest.MonkeyPatch) -> None:
    """Drifted by 0, 5 and 10 cm. Gaussians that all three see have settled between: anchors alone tear them apart."""
    distorted = Bent(truth, 0.0, 0.05)
    before, trained_map, poses = (
        distorted.quality(distorted.drift),
        distorted.mapper._map,
        distorted.mapper._view_parameters,
    )
    monkeypatch.setattr(distorted.mapper, "_view_parameters", deepcopy(poses))
    distorted.mapper.move_keyframes(distorted.drift, distorted.straight)
    after = distorted.quality(distorted.straight)
    distorted.mapper._map, distorted.mapper._view_parameters = trained_map, poses
    monkeypatch.setattr("mastd3r.mapping.mapper.DEFORMATION_RATIO", np.inf)
    distorted.mapper.move_keyframes(distorted.drift, distorted.straight)
    by_anchors = distorted.quality(distorted.straight)
    assert after > before - 0.5 and after > by_anchors + 1


def test_a_correction_counts_from_the_cameras_that_the_map_was_trained_with(truth: GaussianMap) -> None:
    """Pose refinement has put the drifted cameras right already: the Gaussians are where they belong and stay there."""
    distorted = Bent(truth, 0.0, 0.05)
    before, poses = distorted.mapper.gaussians.means.copy(), distorted.mapper._view_parameters
    for n in range(12):
        back = pose(n)[:3, :3].T @ distorted.drift[n % 3][:3, 3]
        poses.correct(n, back / distorted.mapper._depth, np.zeros(3))
    distorted.mapper.move_keyframes(distorted.drift, distorted.straight)
    moved = np.linalg.norm(distorted.mapper.gaussians.means - before, axis=1)
    assert np.median(moved) < 0.005


def test_paper_loss_trains_too(truth: GaussianMap) -> None:
    mapper = trained([view(truth, i) for i in range(12)], paper_loss=True, hard_weight=True)
    assert holdout_psnr(mapper, truth) > 22


def test_harmonics_learn_a_colour_that_changes_with_the_side(truth: GaussianMap) -> None:
    """A wall that is brighter from the left: degree 1 draws an unseen view better than degree 0 can."""
    shiny = GaussianMap(**truth.parameters(), kf_id=truth.kf_id)
    shiny.sh_rest = torch.zeros(len(truth), 3, 3)
    shiny.sh_rest[:, 2] = 3.0  # the band along x
    views = [view(shiny, i) for i in range(12)]
    plain, harmonic = (holdout_psnr(trained(views, steps=240, exposure=False, sh_degree=d), shiny) for d in (0, 1))
    assert harmonic > plain + 0.2


def test_options_outside_their_range_are_refused(truth: GaussianMap) -> None:
    for wrong in ({"sh_degree": 4}, {"sh_degree": -1}, {"ssim_share": 1.5}):
        with pytest.raises(ConfigError, match="expected 0 to"):
            trained([view(truth, 0)], steps=0, **wrong)


def test_pixels_without_data_do_not_count(truth: GaussianMap) -> None:
    views = [view(truth, i) for i in range(6)]
    for v in views:
        v.image[:, :20], v.static[:, :20] = 0, 0
    mapper = trained(views, loss="plain", steps=60)
    assert mapper.render(pose(0), CAMERA)[0][:, :20].mean() > 0.3


def test_bad_views_are_refused(truth: GaussianMap) -> None:
    with pytest.raises(InputError, match="at least one"):
        trained([])
    good = view(truth, 0)
    with pytest.raises(InputError, match="expected image"):
        trained([View(0.0, good.image[1:], good.static, good.world_from_cam, CAMERA, 0)])
    away = pose(0)
    away[:3, :3] = np.diag([-1, 1, -1])
    with pytest.raises(InputError, match="in front"):
        trained([View(0.0, good.image, good.static, away, CAMERA, 0)])
