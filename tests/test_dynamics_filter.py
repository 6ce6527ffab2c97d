"""LogOddsFilter on a rendered scene with exact truth: a textured wall, and a thing that moves before it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mastd3r.camera.pinhole import Camera
from mastd3r.dynamics.appearance import AppearanceClassifier
from mastd3r.dynamics.causal import CausalMasks
from mastd3r.dynamics.config import DepthConfig, DynamicsConfig, MotionConfig, TemporalConfig
from mastd3r.dynamics.data import DynamicMask, DynamicsInput
from mastd3r.dynamics.filter import LogOddsFilter
from mastd3r.errors import InputError
from mastd3r.geometry.se3 import se3_exp
from mastd3r.protocols import DynamicsFilter, DynamicsModel, DynamicsSmoother
from mastd3r.registry import DYNAMICS

W, H = 320, 240
CAMERA = Camera.centred(260.0, W, H)
WALL = 0.5  # inverse depth of the wall


def texture(seed: int, h: int, w: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    layers = [cv2.resize(rng.uniform(0, 255, (h // s, w // s)).astype(np.float32), (w, h)) for s in (4, 12, 40)]
    return np.clip(sum(layers) / 3 * 1.6 - 60, 0, 255).astype(np.uint8)


WALL_IMAGE = texture(5, 480, 640)
THING = texture(9, 90, 60)


def frame(i: int, speed_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(gray, world_from_cam, moving) of frame i: the camera pans and shifts, the thing walks at speed_px."""
    world_from_cam = se3_exp(np.array([0.01 * i, 0.004 * i, 0.0, 0.0, 0.002 * i, 0.001 * i]))
    cam_from_world = np.linalg.inv(world_from_cam)
    # the wall is z = 2: its homography from wall pixels (a camera of the same focal length at the origin)
    k = CAMERA.matrix
    wall_camera = np.array([[260.0, 0, 319.5], [0, 260.0, 239.5], [0, 0, 1]])
    homography = (
        k @ (cam_from_world[:3, :3] + np.outer(cam_from_world[:3, 3], [0, 0, WALL])) @ np.linalg.inv(wall_camera)
    )
    gray = cv2.warpPerspective(WALL_IMAGE, homography, (W, H))
    shift = np.float32([[1, 0, 60 + speed_px * i], [0, 1, 70]])
    moving = cv2.warpAffine(np.full(THING.shape, 255, np.uint8), shift, (W, H)) > 127
    gray = np.where(moving, cv2.warpAffine(THING, shift, (W, H)), gray)
    return gray, world_from_cam, moving


def input_of(i: int, gray: np.ndarray, pose: np.ndarray, **more: object) -> DynamicsInput:
    inv_depth = np.full((H, W), WALL, np.float32)
    base = DynamicsInput(i, i / 30, gray, CAMERA, pose, inv_depth, np.full((H, W), 0.02, np.float32))
    return replace(base, **more)  # type: ignore[arg-type]


def play(config: DynamicsConfig, n: int = 10, speed_px: float = 3.0, thing: bool = True, **more: object) -> list:
    """[(mask, truth)] of a short run. ``thing`` False: the empty room."""
    mask_filter, out = DYNAMICS.create(config.variant, config).filter(W, H), []
    for i in range(n):
        gray, pose, moving = frame(i, speed_px if thing else 1e6)
        semantic = more.get("semantic")
        mask_filter.prior(gray, semantic if isinstance(semantic, np.ndarray) else None)
        out.append((mask_filter.update(input_of(i, gray, pose, **more)), moving))
    return out


def iou(mask: DynamicMask, truth: np.ndarray) -> float:
    return float((mask.moving & truth).sum() / (mask.moving | truth).sum())


def test_a_moving_thing_is_found_and_the_wall_is_not() -> None:
    run = play(DynamicsConfig())
    assert np.mean([iou(m, t) for m, t in run[3:]]) > 0.7
    assert np.mean([(m.moving & ~t).mean() for m, t in run]) < 0.03


def test_an_empty_room_stays_static() -> None:
    assert np.mean([m.moving.mean() for m, _ in play(DynamicsConfig(), thing=False)]) < 0.005


def test_unknown_depth_degrades_gracefully() -> None:
    unknown = np.full((H, W), np.inf, np.float32)
    still = play(DynamicsConfig(), thing=False, inv_depth_sigma=unknown)
    assert np.mean([m.moving.mean() for m, _ in still]) < 0.01
    for mask, _ in play(DynamicsConfig(), inv_depth_sigma=unknown, inv_depth=np.zeros((H, W), np.float32)):
        assert np.isfinite(mask.probability).all()


def test_first_frame_is_the_base_rate() -> None:
    gray, pose, _ = frame(0, 3.0)
    mask_filter = LogOddsFilter(DynamicsConfig(), W, H)
    np.testing.assert_allclose(mask_filter.prior(gray, None), 0.1, atol=1e-5)
    mask = mask_filter.update(input_of(0, gray, pose))
    np.testing.assert_allclose(mask.probability, 0.1, atol=1e-5)
    assert not mask.moving.any()


def test_prior_of_the_next_frame_follows_the_thing() -> None:
    mask_filter = LogOddsFilter(DynamicsConfig(), W, H)
    for i in range(8):
        gray, pose, moving = frame(i, 3.0)
        before = mask_filter.prior(gray, None)
        mask_filter.update(input_of(i, gray, pose))
    assert before[moving].mean() > 0.6
    assert before[~moving].mean() < 0.15


def test_motion_raises_a_likely_thing_and_lowers_a_parked_one() -> None:
    truth = frame(9, 3.0)[2]
    unsure = np.full((H, W), 0.1, np.float32)
    parked = np.zeros((H, W), bool)
    parked[150:220, 230:300] = True
    unsure[truth | parked] = 0.6
    mask = play(DynamicsConfig(), semantic=unsure)[-1][0]
    assert mask.probability[truth].mean() > 0.75
    assert mask.probability[parked].mean() < 0.5


def test_own_depth_finds_what_stands_still() -> None:
    """A thing that came while nobody looked: no motion, but nearer than the map says."""
    gray, _, truth = frame(0, 0.0)
    own = np.where(truth, 1.0, WALL).astype(np.float32)
    for enabled in (True, False):
        mask_filter = LogOddsFilter(DynamicsConfig(depth=DepthConfig(enabled=enabled)), W, H)
        for i in range(6):
            mask = mask_filter.update(input_of(i, gray, np.eye(4), own_inv_depth=own))
        found = float((mask.moving & truth).sum() / truth.sum())
        assert (found > 0.8 and (mask.moving & ~truth).mean() < 0.02) if enabled else found == 0


def test_without_motion_nothing_is_found() -> None:
    assert not play(DynamicsConfig(motion=MotionConfig(enabled=False)))[-1][0].moving.any()


def test_the_filter_remembers_a_thing_that_stops() -> None:
    """The frames before it stopped are beyond the only gap: with time switched off nothing is left of them."""
    shown = []
    for enabled in (True, False):
        mask_filter = LogOddsFilter(DynamicsConfig(temporal=TemporalConfig(enabled=enabled, filter_gaps=(1,))), W, H)
        for i in range(9):
            gray, pose, moving = frame(i, 3.0)
            if i == 8:  # the thing stands where it stood
                gray, pose, moving = frame(7, 3.0)
            mask = mask_filter.update(input_of(i, gray, pose))
        shown.append(float(mask.probability[moving].mean()))
    assert shown[0] > shown[1] + 0.2


def test_static_camera_needs_no_parallax() -> None:
    mask_filter = LogOddsFilter(DynamicsConfig(), W, H)
    for i in range(8):
        gray, _, moving = frame(0, 0.0)
        shift = np.float32([[1, 0, 60 + 3 * i], [0, 1, 70]])
        moving = cv2.warpAffine(np.full(THING.shape, 255, np.uint8), shift, (W, H)) > 127
        empty = frame(0, 1e6)[0]
        gray = np.where(moving, cv2.warpAffine(THING, shift, (W, H)), empty)
        mask = mask_filter.update(input_of(i, gray, np.eye(4)))
    assert iou(mask, moving) > 0.6


def test_same_input_gives_the_same_bits() -> None:
    a, b = play(DynamicsConfig(), 6)[-1][0], play(DynamicsConfig(), 6)[-1][0]
    np.testing.assert_array_equal(a.probability, b.probability)


def test_variants() -> None:
    nothing = play(DynamicsConfig(variant="none"), 3)[-1][0]
    assert not nothing.moving.any() and (nothing.probability == 0).all()
    own = np.full((H, W), WALL, np.float32)
    own[60:160, 100:180] = 5.0
    semantic = np.where(own > WALL, 0.8, 0.1).astype(np.float32)
    paper = play(DynamicsConfig(variant="paper"), 1, thing=False, own_inv_depth=own, semantic=semantic)[0][0]
    assert paper.moving[100:120, 130:150].all()
    assert not paper.moving[:50].any()
    np.testing.assert_array_equal(paper.moving, paper.probability > 0.5)


@pytest.mark.parametrize("variant", ["ours", "paper", "none"])
def test_every_variant_is_a_model_with_a_filter_and_a_smoother(variant: str) -> None:
    model: DynamicsModel = DYNAMICS.create(variant, DynamicsConfig(variant=variant))
    assert model.needs_features == (variant == "ours")
    gray, pose, _ = frame(0, 3.0)
    mask_filter: DynamicsFilter = model.filter(W, H)
    smoother: DynamicsSmoother = model.smoother(W, H, mask_filter.appearance)
    assert mask_filter.prior(gray).shape == (H, W) == mask_filter.update(input_of(0, gray, pose)).moving.shape
    pairs = [(input_of(i, *frame(i, 3.0)[:2]), i) for i in range(3)]
    assert [(mask.probability.shape, beside) for mask, beside in smoother.masks(pairs)] == [
        ((H, W), i) for i in (0, 1, 2)
    ]
    wrong = np.zeros((10, 10), np.uint8)
    with pytest.raises(InputError, match="expected gray of 320x240"):
        mask_filter.prior(wrong)
    with pytest.raises(InputError, match="expected gray of 320x240"):
        list(smoother.masks([(replace(pairs[0][0], gray=wrong), 0)]))


def test_the_paper_s_masks_after_tracking_take_a_map_that_shows_nothing_for_less() -> None:
    gray, pose, _ = frame(0, 3.0)
    own = np.full((H, W), WALL, np.float32)
    own[60:160, 100:180] = 5.0
    one = input_of(0, gray, pose, own_inv_depth=own, semantic=np.zeros((H, W), np.float32))
    model: DynamicsModel = DYNAMICS.create("paper", DynamicsConfig(variant="paper"))
    [(smoothed, _)] = model.smoother(W, H).masks([(one, None)])
    marked = smoothed.evidence["anomaly"] > 0
    assert marked.any()
    assert (smoothed.probability[marked] > model.filter(W, H).update(one).probability[marked]).all()


def test_tracking_believes_a_map_that_shows_nothing() -> None:
    """Only the smoothing pass may overrule it: whatever is called moving here is lost to the pose."""
    config, nothing = DynamicsConfig(), np.zeros((H, W), np.float32)
    assert config.semantic.missed > config.semantic.floor
    surest = (config.semantic.floor / (1 - config.semantic.floor)) ** config.semantic.gain
    prior = LogOddsFilter(config, W, H).prior(frame(0, 3.0)[0], nothing)
    np.testing.assert_allclose(prior, surest / (1 + surest), rtol=1e-4)


def test_wrong_size_is_one_clear_line() -> None:
    mask_filter = LogOddsFilter(DynamicsConfig(), W, H)
    with pytest.raises(InputError, match="expected gray of 320x240"):
        mask_filter.prior(np.zeros((10, 10), np.uint8), None)
    gray, pose, _ = frame(0, 3.0)
    with pytest.raises(InputError, match="own_inv_depth"):
        mask_filter.update(input_of(0, gray, pose, own_inv_depth=np.zeros((4, 4), np.float32)))


def test_causal_masks_are_those_of_the_filter_and_never_see_what_follows() -> None:
    model: DynamicsModel = DYNAMICS.create("ours", DynamicsConfig())
    views = [frame(i, 3.0) for i in range(5)]
    inputs = [(input_of(i, gray, pose), i) for i, (gray, pose, _) in enumerate(views)]
    inputs[2] = (replace(inputs[2][0], pose_known=False), 2)
    whole = list(CausalMasks(model.filter(W, H)).masks(inputs))
    part = list(CausalMasks(model.filter(W, H)).masks(inputs[:4]))
    assert [beside for _, beside in whole] == [0, 1, 2, 3, 4]
    for (mask, _), (same, _) in zip(whole[:4], part, strict=True):
        np.testing.assert_array_equal(mask.probability, same.probability)
    alone, expected = model.filter(W, H), []
    for one, _ in inputs:
        prior = alone.prior(one.gray)
        expected.append(alone.update(one).probability if one.pose_known else prior)
    for (mask, _), probability in zip(whole, expected, strict=True):
        np.testing.assert_array_equal(mask.probability, probability)
    assert whole[2][0].evidence == {} and iou(whole[4][0], views[4][2]) > 0.5
    learned = AppearanceClassifier(DynamicsConfig())
    begun = model.filter(W, H)
    CausalMasks(begun, learned)
    assert begun.appearance is learned  # type: ignore[attr-defined]


@pytest.mark.parametrize("away", [5e3, 1e8])
def test_a_pose_gone_far_astray_leaves_every_number_finite(away: float) -> None:
    """A lens' law at what lies behind such a camera leaves float32; one NaN would stay in every later mask."""
    lens = replace(CAMERA, k1=0.024, k2=-0.082, k3=0.055)
    filter_, looks = LogOddsFilter(DynamicsConfig(), W, H), np.random.default_rng(0).normal(size=(60, 80, 11))
    for i in range(8):
        gray, pose, _ = frame(i, 3.0)
        if i == 4:
            pose = pose @ se3_exp(np.array([-0.7 * away, 0.0, -away, 0.0, 0.7, 0.0]))
        given = input_of(i, gray, pose, camera=lens, features=looks.astype(np.float32))
        filter_.prior(gray, features=given.features)
        mask = filter_.update(given)
        assert np.isfinite(mask.probability).all()
        assert all(np.isfinite(term).all() for term in mask.evidence.values())
    assert np.isfinite(filter_.appearance._weights).all()
