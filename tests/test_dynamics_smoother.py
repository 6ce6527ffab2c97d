"""The mask with all poses known: evidence from both sides in time, the head that learns looks, votes for points."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from test_dynamics_belief import CAMERA, THING, H, W, frame, given, iou

from mastd3r.dynamics import DynamicsConfig, DynamicsInput, LogOddsFilter
from mastd3r.dynamics.appearance import AppearanceClassifier, plain_descriptors
from mastd3r.dynamics.smoother import ForwardBackwardSmoother
from mastd3r.offline.point_votes import PointVotes

COLOURS = np.array([[90, 160, 90], [200, 60, 40]], np.uint8)  # wall, thing


def inputs(n: int, **more: object) -> tuple[list[DynamicsInput], list[np.ndarray]]:
    seen = [frame(i, 3.0) for i in range(n)]
    return [given(i, gray, pose, **more) for i, (gray, pose, _) in enumerate(seen)], [m for *_, m in seen]


def test_one_mask_a_frame_in_order_whatever_the_length() -> None:
    config = DynamicsConfig(second_gaps=(1, 4))
    for n in (0, 1, 3, 5, 9):
        frames, _ = inputs(n)
        told: list[int] = []
        masks = ForwardBackwardSmoother(config, W, H).masks(told.append(g.index) or g for g in frames)  # type: ignore[func-returns-value]
        for i, mask in enumerate(masks):
            assert mask.probability.shape == (H, W) and len(told) == min(i + 5, n)
        assert told == list(range(n)) and (n == 0 or i == n - 1)


def test_the_first_frame_is_known_by_those_after_it() -> None:
    frames, truth = inputs(10)
    both = list(ForwardBackwardSmoother(DynamicsConfig(), W, H).masks(frames))
    past = list(ForwardBackwardSmoother(DynamicsConfig(use_future=False), W, H).masks(frames))
    assert iou(both[0], truth[0]) > 0.6 and not past[0].moving.any()
    assert np.mean([iou(m, t) for m, t in zip(both, truth, strict=True)]) > 0.7
    assert np.mean([(m.moving & ~t).mean() for m, t in zip(both, truth, strict=True)]) < 0.02


def test_an_empty_room_stays_static_both_ways() -> None:
    frames = [given(i, *frame(i, 1e6)[:2]) for i in range(8)]
    assert max(m.moving.mean() for m in ForwardBackwardSmoother(DynamicsConfig(), W, H).masks(frames)) < 0.005


def coloured(gray: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """(h, w, 3) photograph: wall and moving thing in colours of their own."""
    return (COLOURS[moving.astype(int)] * (0.5 + gray[..., None] / 510.0)).clip(0, 255).astype(np.uint8)


def stops(use_head: bool) -> tuple[float, float]:
    """(share found of a thing that walked and has stood still for 20 frames, false positives beside it)."""
    belief = LogOddsFilter(DynamicsConfig(use_head=use_head), W, H)
    for i in range(12 + 20):
        gray, pose, moving = frame(min(i, 12), 3.0)
        told = given(i, gray, pose, features=plain_descriptors(coloured(gray, moving), W // 4, H // 4))
        belief.prior(gray, None, told.features)
        mask = belief.update(told)
    return float((mask.moving & moving).sum() / moving.sum()), float((mask.moving & ~moving).mean())


def test_who_walked_and_stands_still_stays_recognised_by_the_head() -> None:
    with_head, without = stops(True), stops(False)
    assert with_head[0] > 0.5 > without[0] + 0.2
    assert with_head[1] < 0.05


def test_the_head_takes_features_of_any_kind_and_knows_what_it_does_not_know() -> None:
    rng = np.random.default_rng(2)
    kinds = rng.normal(size=(3, 40))  # tokens of a network: background, mover, never seen
    head = AppearanceClassifier(DynamicsConfig())
    which = np.zeros((20, 30), int)
    which[5:12, 8:15] = 1
    assert head.log_odds(kinds[which].astype(np.float32)) is None
    for _ in range(12):
        tokens = (kinds[which] + 0.2 * rng.normal(size=(20, 30, 40))).astype(np.float32)
        head.learn(tokens, cv2.resize(np.where(which == 1, 5.0, -5.0), (90, 60), interpolation=cv2.INTER_NEAREST))
    looks = head.log_odds(kinds[which].astype(np.float32))
    assert looks is not None and looks[which == 1].mean() > 1 and looks[which == 0].mean() < -1
    never = head.log_odds(np.tile(-3 * kinds[2], (2, 2, 1)).astype(np.float32))
    assert never is not None and np.abs(never).max() < 0.7 * looks[which == 1].mean()
    assert head.log_odds(np.zeros((4, 4, 7), np.float32)) is None  # other features than those it learned


def test_a_head_that_saw_nothing_move_has_no_say() -> None:
    head = AppearanceClassifier(DynamicsConfig())
    for i in range(10):
        head.learn(plain_descriptors(coloured(*frame(i, 3.0)[::2]), 80, 60), np.full((120, 160), -5.0))
    assert head.log_odds(np.zeros((60, 80, 11), np.float32)) is None


def test_same_video_gives_the_same_masks() -> None:
    runs = []
    for _ in range(2):
        frames, truth = inputs(7)
        frames = [
            replace(g, features=plain_descriptors(coloured(g.gray, t), 80, 60))
            for g, t in zip(frames, truth, strict=True)
        ]
        runs.append(
            [
                m.probability
                for m in ForwardBackwardSmoother(DynamicsConfig(), W, H, AppearanceClassifier(DynamicsConfig())).masks(
                    frames
                )
            ]
        )
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


def test_what_the_mask_is_told_of_a_frame_holds_its_features(monkeypatch: pytest.MonkeyPatch) -> None:
    from mastd3r.tracking import mask_input as view_depth

    grid, p = (6, 8), 48
    monkeypatch.setattr(view_depth, "carried", lambda *_: (np.ones(p), np.ones(p)))
    block = SimpleNamespace(px=np.zeros((p, 2)), inv_depth=np.ones(p), cam_from_world=np.eye(4))
    graph = SimpleNamespace(blocks=[block], camera=lambda: CAMERA, depth_info=lambda _: np.ones(p), size=(80, 60))
    work = SimpleNamespace(
        index=3, timestamp_s=0.1, gray=np.zeros((60, 80), np.uint8), px=np.zeros((p, 2)), grid=grid,
        own_inv_depth=None, semantic=np.full((60, 80), 0.2, np.float32),
    )  # fmt: skip
    features = np.ones((15, 20, 11), np.float32)
    told = view_depth.dynamics_input(graph, 0, np.eye(4), work, 1.0, features)  # type: ignore[arg-type]
    assert told.features is features and told.color is None and told.semantic is work.semantic
