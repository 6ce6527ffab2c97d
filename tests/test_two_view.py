"""A view recognised from far away: by the network's own matches where there is a network, by corner features else."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from known_pair import look
from mastd3r.concurrency import Future
from mastd3r.config import Config
from mastd3r.geometry.se3 import inverse, so3_log
from mastd3r.parts import parts_of
from mastd3r.pointmap.geometric import GeometricPointmaps
from mastd3r.slam import Slam
from mastd3r.tracking import two_view
from mastd3r.tracking.two_view import SURE_FEATURES, Start, TwoViewEstimator
from mastd3r.types import FeatureMatches, Frame, Guess
from test_pointmap import pair_of
from test_pointmap_mast3r import FULL, WORK, TrueNetwork, photograph, provider_of


class NoFeatures:
    """Corner features that must not be asked, or that find nothing."""

    def __init__(self, allowed: bool) -> None:
        self.allowed, self.asked = allowed, 0

    def matches(self, ref: Any, new: Any, ref_moving: Any, new_moving: Any) -> None:
        assert self.allowed, "the network's own matches were not trusted"
        self.asked += 1


NOTHING_MOVES = Future.done(np.zeros((120, 160), np.float32))


@pytest.mark.parametrize("time_s", [2.0, 10.0])
def test_a_network_recognises_without_corner_features(time_s: float) -> None:
    """10 s: turned by 29 degrees, pixels moved by an eighth of the width, every frame in a scale of its own."""
    network = TrueNetwork(noise=0.1)
    network.scale = {time_s: 1.3}
    provider = provider_of(network)
    parts = parts_of(provider, Config())
    parts.features = NoFeatures(allowed=False)  # type: ignore[assignment]
    slam = Slam(Config(), FULL, parts=parts)
    slam.track(photograph(0.0))
    keyframe = slam.graph.keyframes[0]
    view = slam.two_view.relocalised(keyframe, provider.observe(photograph(time_s)), NOTHING_MOVES)
    assert view is not None
    truth = inverse(look(time_s).world_from_cam) @ look(0.0).world_from_cam
    error = view.alignment.new_from_ref @ inverse(truth)
    assert np.rad2deg(np.linalg.norm(so3_log(error[:3, :3]))) < 0.3
    moved = view.alignment.new_from_ref[:3, 3] - truth[:3, 3]
    assert np.linalg.norm(moved) < 0.02 * np.linalg.norm(truth[:3, 3])
    assert view.matched > 0.5 * len(keyframe.work.px)


def test_without_a_network_features_start_the_flow() -> None:
    parts = parts_of(GeometricPointmaps(160, 120, 8), Config())
    features = parts.features = NoFeatures(allowed=True)  # type: ignore[assignment]
    slam = Slam(Config(), FULL, parts=parts)
    slam.track(photograph(0.0))
    work = parts.provider.observe(photograph(0.1))
    assert slam.two_view.relocalised(slam.graph.keyframes[0], work, NOTHING_MOVES) is None
    assert isinstance(features, NoFeatures) and features.asked == 1


def test_where_few_match_features_are_asked_and_the_better_start_is_kept() -> None:
    """A jump of a quarter of the width: flow alone finds little, features find it, a wrong start is not taken."""
    ref, new, _ = pair_of(np.eye(2), np.array([-80.0, 8.0]))
    parts = parts_of(GeometricPointmaps(320, 240, 10), Config())
    slam = Slam(Config(semantics="none"), (320, 240), parts=parts)
    slam.track(Frame(0, 0.0, np.dstack([ref] * 3)))
    keyframe = slam.graph.keyframes[0]
    still = Future.done(np.zeros((240, 320), np.float32))
    matched = {}
    for name, moved in (("none", None), ("true", [-80, 8]), ("wrong", [60, -60])):
        parts.features = Given(moved)  # type: ignore[assignment]
        work = parts.provider.observe(Frame(1, 0.1, np.dstack([new] * 3)))
        nothing = Start(np.zeros((240, 320, 2), np.float32))  # where a slow camera would be
        matched[name] = slam.two_view.estimate(keyframe, work, still, nothing, np.eye(4)).matched
    assert parts.features.asked == 1  # type: ignore[attr-defined]
    assert matched["none"] == matched["wrong"] < 0.3 * matched["true"]
    work = parts.provider.observe(Frame(1, 0.1, np.dstack([ref] * 3)))
    slam.two_view.estimate(keyframe, work, still, nothing, np.eye(4))
    assert parts.features.asked == 1  # type: ignore[attr-defined] # enough matched: nothing else was tried


def test_before_a_start_what_passes_in_front_makes_no_keyframe() -> None:
    """A still camera, and a third of the picture 12 px aside: nobody knows yet that it moves by itself."""
    ref, shifted, _ = pair_of(np.eye(2), np.array([12.0, 0.0]))
    new = np.where(np.arange(320) > 215, shifted, ref)
    parts = parts_of(GeometricPointmaps(320, 240, 10), Config())
    slam = Slam(Config(semantics="none"), (320, 240), parts=parts)
    slam.track(Frame(0, 0.0, np.dstack([ref] * 3)))
    keyframe, work = slam.graph.keyframes[0], parts.provider.observe(Frame(1, 0.1, np.dstack([new] * 3)))
    still, nothing = Future.done(np.zeros((240, 320), np.float32)), Start(np.zeros((240, 320, 2), np.float32))
    motion = []
    for started in (set(), {0}):
        slam.graph.started = started
        motion.append(slam.two_view.estimate(keyframe, work, still, nothing, np.eye(4)).motion_ratio)
    assert motion[0] < 0.1 * slam.config.tracking.first_motion_ratio
    assert motion[1] == pytest.approx(12 / np.sqrt(320 * 240), rel=0.05)


class Given:
    """Features that say what they are told."""

    def __init__(self, moved: Any) -> None:
        x, y = np.meshgrid(np.arange(4.0, 320, 8), np.arange(4.0, 240, 8))
        px = np.stack([x, y], -1).reshape(-1, 2)
        self.answer = None if moved is None else FeatureMatches(px, px + moved, np.ones(len(px)))
        self.asked = 0

    def matches(self, *_: Any) -> Any:
        self.asked += 1
        return self.answer


def test_expected_pairs_are_decoded_once_in_both_orders() -> None:
    """As one batch where they can be remembered until they are asked for; else when they are asked for."""
    for most, decoded in ((8, 4), (4, 0)):
        network = TrueNetwork()
        provider = provider_of(network, remembered_pairs=most)
        a, b, c = (provider.look(photograph(t)) for t in (0.0, 0.2, 0.4))
        provider.expect([(a, c), (b, c)])
        assert network.decoded == decoded
        a, b, c = (provider.beside(work, other) for work, other in ((a, c), (b, c), (c, a)))
        for ref, new in ((a, c), (c, a), (b, c), (c, b)):
            provider.predict(ref, new, Guess(WORK))
        assert network.decoded == 4 and network.encoded == 3


@pytest.mark.parametrize(
    ("inliers", "features", "sure"),
    [(0.8, 0, True), (0.6, 100, True), (0.6, 60, False), (0.6, 0, False), (0.4, 200, False)],
)
def test_doubt_is_dispelled_by_dense_matches_or_by_features(
    monkeypatch: pytest.MonkeyPatch, inliers: float, features: int, sure: bool
) -> None:
    view: Any = SimpleNamespace(anchor=None, alignment=SimpleNamespace(inlier_ratio=inliers))
    px = np.zeros((features, 2))
    far = FeatureMatches(px, px, np.ones(features)) if features else None
    monkeypatch.setattr(two_view, "far_features", lambda *_: far)
    estimator: Any = SimpleNamespace(parts=None)
    prior: Any = SimpleNamespace(get=lambda: None)
    assert SURE_FEATURES == 80 and TwoViewEstimator.beyond_doubt(estimator, view, None, prior) == sure  # type: ignore[arg-type]
