"""The mask with all poses known: the forward-backward smoother, the appearance classifier, votes for points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from mastd3r.dynamics.appearance import AppearanceClassifier, plain_descriptors
from mastd3r.dynamics.config import AppearanceConfig, DynamicsConfig, TemporalConfig
from mastd3r.dynamics.data import DynamicMask, DynamicsInput
from mastd3r.dynamics.filter import LogOddsFilter
from mastd3r.dynamics.flow import HalfFlow
from mastd3r.dynamics.motion import texture_information
from mastd3r.dynamics.motion_test import MotionTest, Past
from mastd3r.dynamics.smoother import ForwardBackwardSmoother
from mastd3r.offline.point_votes import PointVotes
from test_dynamics_filter import CAMERA, THING, H, W, frame, input_of, iou

COLOURS = np.array([[90, 160, 90], [200, 60, 40]], np.uint8)  # wall, thing


def inputs(n: int, **more: object) -> tuple[list[DynamicsInput], list[np.ndarray]]:
    frames = [frame(i, 3.0) for i in range(n)]
    return [input_of(i, gray, pose, **more) for i, (gray, pose, _) in enumerate(frames)], [m for *_, m in frames]


def smoothed(
    frames: list[DynamicsInput], config: DynamicsConfig | None = None, appearance: AppearanceClassifier | None = None
) -> list[DynamicMask]:
    """All masks of a video."""
    smoother = ForwardBackwardSmoother(config or DynamicsConfig(), W, H, appearance)
    return [mask for mask, _ in smoother.masks((one, None) for one in frames)]


def test_one_mask_a_frame_in_order_whatever_the_length() -> None:
    config = DynamicsConfig(temporal=TemporalConfig(smoother_gaps=(1, 4)))
    for n in (0, 1, 3, 5, 9):
        taken: list[int] = []

        def pairs(count: int = n, taken: list[int] = taken) -> Iterator[tuple[DynamicsInput, str]]:
            for one in inputs(count)[0]:
                taken.append(one.index)
                yield one, f"beside {one.index}"

        beside = []
        for i, (mask, extra) in enumerate(ForwardBackwardSmoother(config, W, H).masks(pairs())):
            assert mask.probability.shape == (H, W) and len(taken) == min(i + 5, n)
            beside.append(extra)
        assert taken == list(range(n)) and beside == [f"beside {i}" for i in range(n)]


def test_the_first_frame_is_known_by_those_after_it() -> None:
    frames, truth = inputs(10)
    both = smoothed(frames)
    past = smoothed(frames, DynamicsConfig(temporal=TemporalConfig(backward=False)))
    assert iou(both[0], truth[0]) > 0.6 and not past[0].moving.any()
    assert np.mean([iou(m, t) for m, t in zip(both, truth, strict=True)]) > 0.7
    assert np.mean([(m.moving & ~t).mean() for m, t in zip(both, truth, strict=True)]) < 0.02


def test_an_empty_room_stays_static() -> None:
    frames = [input_of(i, *frame(i, 1e6)[:2]) for i in range(8)]
    assert max(m.moving.mean() for m in smoothed(frames)) < 0.005


def test_nothing_is_said_to_move_against_a_pose_that_is_a_guess() -> None:
    wrong = np.eye(4)
    wrong[0, 3] = 0.4
    frames, _ = inputs(8)
    frames[4] = replace(frames[4], world_from_cam=frames[4].world_from_cam @ wrong)
    told = [replace(one, pose_known=n != 4) for n, one in enumerate(frames)]
    assert np.abs(smoothed(frames)[4].evidence["motion"]).max() > 1.0
    masks = smoothed(told)
    assert not masks[4].evidence["motion"].any()
    assert masks[3].evidence["motion"].any()  # from the others


def test_what_most_of_a_scene_lacks_is_no_mark_of_motion() -> None:
    """Between views far apart much of a static scene has no match; a few pixels without one are a thing that moves."""
    rng = np.random.default_rng(3)
    gray, pose, _ = frame(0, 1e6)
    noise = cv2.GaussianBlur(rng.integers(0, 255, gray.shape).astype(np.uint8), (0, 0), 1.5)
    said = []
    noise = cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX)
    for share in (0.3, 0.7):
        other, columns = gray.copy(), slice(0, round(share * W))
        other[:, columns] = noise[:, columns]
        config = DynamicsConfig(temporal=TemporalConfig(smoother_gaps=(1,)))
        first = smoothed([input_of(0, gray, pose), input_of(1, other, pose)], config)[0]
        said.append(float(np.median(first.evidence["motion"][:, : W // 10])))
    assert said[0] > 0.8 and said[1] < 0.2


def unmatched_ratio(share: float, config: DynamicsConfig) -> float:
    """Median log ratio of one comparison where a share of a static picture has no match, nothing known before."""
    gray, pose, _ = frame(0, 1e6)
    now, other = cv2.resize(gray, (W // 2, H // 2)), cv2.resize(gray, (W // 2, H // 2))
    noise = np.random.default_rng(3).integers(0, 255, other.shape).astype(np.uint8)
    noise = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.0), None, 0, 255, cv2.NORM_MINMAX)
    columns = slice(0, round(share * W / 2))
    other[:, columns] = noise[:, columns]
    nothing = np.zeros(now.shape, np.float32)
    test = MotionTest(config, HalfFlow(W // 2, H // 2), W // 2, H // 2)
    present = test.present(input_of(0, gray, pose), now, texture_information(now, 7, config.motion.texture_noise))
    found = test.compare([(present, nothing + 1, Past(other, pose, nothing))])[0]
    return float(np.median(found.log_ratio[:, : W // 20]))


def test_the_more_of_a_scene_has_no_match_the_less_that_says_but_not_while_tracking() -> None:
    doubting, tracking = DynamicsConfig(), DynamicsConfig().while_tracking()
    assert unmatched_ratio(0.3, doubting) == unmatched_ratio(0.3, tracking) > 1.0
    assert unmatched_ratio(0.5, doubting) < 0.8 * unmatched_ratio(0.5, tracking)  # a pose needs what moves kept out


def coloured(gray: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """(h, w, 3) photograph: wall and moving thing in colours of their own."""
    return (COLOURS[moving.astype(int)] * (0.5 + gray[..., None] / 510.0)).clip(0, 255).astype(np.uint8)


def stops(with_appearance: bool) -> tuple[float, float]:
    """(share found of a thing that walked and has stood still for 20 frames, false positives beside it)."""
    config = DynamicsConfig(appearance=AppearanceConfig(enabled=with_appearance))
    mask_filter = LogOddsFilter(config, W, H)
    for i in range(12 + 20):
        gray, pose, moving = frame(min(i, 12), 3.0)
        one = input_of(i, gray, pose, features=plain_descriptors(coloured(gray, moving), W // 4, H // 4))
        mask_filter.prior(gray, None, one.features)
        mask = mask_filter.update(one)
    return float((mask.moving & moving).sum() / moving.sum()), float((mask.moving & ~moving).mean())


def test_who_walked_and_stands_still_stays_recognised_by_appearance() -> None:
    known, without = stops(True), stops(False)
    assert known[0] > 0.5 > without[0] + 0.2
    assert known[1] < 0.05


def test_the_classifier_takes_features_of_any_kind_and_knows_what_it_does_not_know() -> None:
    rng = np.random.default_rng(2)
    kinds = rng.normal(size=(3, 40))  # tokens of a network: background, mover, never seen
    classifier = AppearanceClassifier(DynamicsConfig())
    which = np.zeros((20, 30), int)
    which[5:12, 8:15] = 1
    assert classifier.log_odds(kinds[which].astype(np.float32)) is None
    for _ in range(12):
        tokens = (kinds[which] + 0.2 * rng.normal(size=(20, 30, 40))).astype(np.float32)
        classifier.learn(tokens, cv2.resize(np.where(which == 1, 5.0, -5.0), (90, 60), interpolation=cv2.INTER_NEAREST))
    alike = classifier.log_odds(kinds[which].astype(np.float32))
    assert alike is not None and alike[which == 1].mean() > 1 and alike[which == 0].mean() < -1
    never = classifier.log_odds(np.tile(-3 * kinds[2], (2, 2, 1)).astype(np.float32))
    assert never is not None and np.abs(never).max() < 0.7 * alike[which == 1].mean()
    assert classifier.log_odds(np.zeros((4, 4, 7), np.float32)) is None  # other features than those it learned


def test_four_cells_of_fine_features_are_answered_together() -> None:
    rng = np.random.default_rng(5)
    classifier, moves = AppearanceClassifier(DynamicsConfig()), np.arange(48) > 30
    coarse = (rng.normal(size=(36, 48, 11)) + 3 * moves[:, None]).astype(np.float32)
    for _ in range(8):
        classifier.learn(coarse, np.tile(np.where(moves, 5.0, -5.0), (36, 1)))
    fine = (
        np.repeat(np.repeat(coarse, 2, 0), 2, 1) + np.tile(np.float32([[0.1, -0.1], [-0.1, 0.1]]), (36, 48))[..., None]
    )
    apart, together = classifier.log_odds(coarse), classifier.log_odds(fine)
    assert apart is not None and together is not None and together.shape == (36, 48)
    np.testing.assert_allclose(together, apart, atol=1e-4)


def test_a_classifier_that_saw_nothing_move_has_no_say() -> None:
    classifier = AppearanceClassifier(DynamicsConfig())
    for i in range(10):
        classifier.learn(plain_descriptors(coloured(*frame(i, 3.0)[::2]), 80, 60), np.full((120, 160), -5.0))
    assert classifier.log_odds(np.zeros((60, 80, 11), np.float32)) is None


def test_same_video_gives_the_same_masks() -> None:
    runs = []
    for _ in range(2):
        frames, truth = inputs(7)
        frames = [
            replace(g, features=plain_descriptors(coloured(g.gray, t), 80, 60))
            for g, t in zip(frames, truth, strict=True)
        ]
        runs.append([m.probability for m in smoothed(frames, None, AppearanceClassifier(DynamicsConfig()))])
    np.testing.assert_array_equal(runs[0], runs[1])


def test_votes_prune_and_restore_points() -> None:
    votes = PointVotes()
    grey = np.full((3, 3), 100, np.uint8)
    votes.start(4, np.array([0.9, 0.1, 0.9]), grey)
    other = np.array([[100] * 3, [100] * 3, [180] * 3], np.uint8)  # the third is hidden behind something later on
    inside = np.ones(3, bool)
    for _ in range(6):
        votes.add(4, np.array([0.05, 0.95, 0.05]), other, inside)
    restored, pruned, unchanged = votes.moving()[4]
    assert restored < 0.35 and pruned > 0.65 and unchanged == pytest.approx(0.9, abs=0.01)
    before = votes.moving()[4].copy()
    votes.add(4, np.ones(3), grey, np.zeros(3, bool))
    np.testing.assert_array_equal(votes.moving()[4], before)


def test_the_thing_is_there_to_be_found() -> None:
    """The scene that these tests stand on: the thing covers some of the image, the lens sees it."""
    assert 0.01 < frame(0, 3.0)[2].mean() < 0.2 and THING.size > 0 and CAMERA.width == W


def test_the_input_of_the_mask_holds_the_features(monkeypatch: pytest.MonkeyPatch) -> None:
    from mastd3r.tracking import mask_input

    grid, p = (6, 8), 48
    monkeypatch.setattr(mask_input, "carried", lambda *_: (np.ones(p), np.ones(p)))
    block = SimpleNamespace(px=np.zeros((p, 2)), inv_depth=np.ones(p), cam_from_world=np.eye(4))
    graph = SimpleNamespace(variables=[block], camera=lambda: CAMERA, depth_info=lambda _: np.ones(p), size=(80, 60))
    work = SimpleNamespace(
        index=3, timestamp_s=0.1, gray=np.zeros((60, 80), np.uint8), px=np.zeros((p, 2)), grid=grid,
        own_inv_depth=None, semantic=np.full((60, 80), 0.2, np.float32),
    )  # fmt: skip
    features = np.ones((15, 20, 11), np.float32)
    one = mask_input.dynamics_input(graph, 0, np.eye(4), work, 1.0, features)  # type: ignore[arg-type]
    assert one.features is features and one.color is None and one.semantic is work.semantic
