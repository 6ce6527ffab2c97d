"""The network provider: with a network that knows the truth, one that talks nonsense, and a tiny random one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from known_pair import Maps, RoomView, decoded, look, truth_of
from mastd3r.alignment.align import CoarseToFine, align
from mastd3r.alignment.problem import AlignmentProblem
from mastd3r.alignment.reproject import StaticMatches
from mastd3r.camera.pinhole import Camera
from mastd3r.config import AlignmentConfig
from mastd3r.errors import InputError
from mastd3r.geometry.se3 import inverse, transform
from mastd3r.networks import matching as in_torch
from mastd3r.networks.mast3r import Mast3rConfig, random_mast3r
from mastd3r.networks.pair import PairNetwork
from mastd3r.networks.preprocess import PixelMapping, prepare_image
from mastd3r.pointmap.geometric import GeometricPointmaps
from mastd3r.pointmap.mast3r import Mast3rPointmaps, NetworkFrame, working_size_of
from mastd3r.pointmap.matching import FoundPixels
from mastd3r.pointmap.network_view import focal_from_points, sample_smooth
from mastd3r.sources.synthetic import room_camera
from mastd3r.types import Frame, Guess, PairPrediction

Array = NDArray[Any]
LONG_SIDE, CELL = 160, 8
FULL = (320, 240)  # working size 160 x 120, of which the network sees the rows 4 … 115


@dataclass(frozen=True)
class Known:
    """A prepared or encoded photograph of a network that knows everything."""

    mapping: PixelMapping
    view: RoomView
    time_s: float
    pooled: Array


class TrueNetwork:
    """Answers with the truth, each view in its own ``scale``; photographs say in their first pixels when they were."""

    def __init__(self, noise: float = 0.0, long_side_px: int = LONG_SIDE) -> None:
        self.noise, self.long_side_px = noise, long_side_px
        self.scale: dict[float, float] = {}
        self.prepared, self.encoded, self.decoded = 0, 0, 0

    def prepare(self, image: Array) -> Known:
        self.prepared += 1
        _, mapping = prepare_image(image, self.long_side_px)
        time_s = float(image[0, 0, 0]) / 10
        camera = room_camera(*mapping.full_size).resized(*mapping.resized_size)
        return Known(mapping, cropped(look(time_s, camera), mapping), time_s, np.array([3.0, time_s]))

    def encode(self, prepared: Known) -> Known:
        self.encoded += 1
        return prepared

    def pairs(self, pairs: Any) -> list[Any]:
        return [self.pair(a, b) for a, b in pairs]

    def pair(self, a: Known, b: Known) -> Any:
        self.decoded += 1
        first, second = decoded(a.view, b.view, self.noise)
        scale = np.float32(self.scale.get(a.time_s, 1.0))
        return Both(replace(first, points=first.points * scale), replace(second, points=second.points * scale))


@dataclass(frozen=True)
class Both:
    first: Any
    second: Any


def cropped(view: RoomView, mapping: PixelMapping) -> RoomView:
    """What the network's window sees; the camera's pixels are the window's."""
    x, y, (w, h) = mapping.crop_left_px, mapping.crop_top_px, mapping.net_size
    part = np.s_[y : y + h, x : x + w]
    c = view.camera
    camera = replace(c, cx_px=c.cx_px - x, cy_px=c.cy_px - y, width=w, height=h)
    return RoomView(camera, view.world_from_cam, view.points_cam[part], view.points_world[part])


def photograph(time_s: float, size: tuple[int, int] = FULL) -> Frame:
    image = np.random.default_rng(0).integers(0, 255, (size[1], size[0], 3)).astype(np.uint8)
    image[0, 0, 0] = round(time_s * 10)
    return Frame(round(time_s * 10), time_s, image)


def provider_of(network: Any, size: tuple[int, int] = FULL, **more: Any) -> Mast3rPointmaps:
    return Mast3rPointmaps(network, *working_size_of(network, size), CELL, **more)


WORK = room_camera(*FULL).resized(160, 120)
NEW, REF = 3.2, 0.0


@pytest.fixture(scope="module")
def pair() -> tuple[NetworkFrame, NetworkFrame, PairPrediction]:
    provider = provider_of(TrueNetwork())
    ref, new = provider.observe(photograph(REF)), provider.observe(photograph(NEW))
    return ref, new, provider.predict(ref, new, Guess(WORK))


def inside_window(px: Array) -> Array:
    return np.asarray((px[:, 1] >= 4) & (px[:, 1] < 116))


# -- one frame -------------------------------------------------------------------------------------------------


def test_working_image_is_the_whole_photograph(pair: tuple[NetworkFrame, NetworkFrame, PairPrediction]) -> None:
    ref = pair[0]
    assert ref.gray.shape == (120, 160) and ref.grid == (15, 20) and ref.px.shape == (300, 2)
    assert (ref.window.crop_left_px, ref.window.crop_top_px, ref.window.net_size) == (0, 4, (160, 112))


def test_own_depth_is_exact_where_the_network_looks(pair: tuple[NetworkFrame, NetworkFrame, PairPrediction]) -> None:
    own = pair[0].own_inv_depth
    assert own is not None and own.dtype == np.float32 and own.shape == (120, 160)
    np.testing.assert_allclose(own[4:116], 1 / look(REF, WORK).points_cam[4:116, :, 2], rtol=1e-5)
    assert (own[:4] == 0).all() and (own[116:] == 0).all()
    assert pair[0].focal_px == pytest.approx(WORK.fx_px, rel=1e-4)


@pytest.mark.parametrize("size", [(320, 240), (240, 320), (310, 95), (200, 200), (90, 70)])
def test_pixels_of_the_photograph_are_where_the_camera_says(size: tuple[int, int]) -> None:
    """Through resize, crop and back: a landmark's full-size pixel is that of its matches' pixel."""
    network = TrueNetwork()
    provider = provider_of(network, size)
    full = room_camera(*size)
    work = full.resized(provider.width, provider.height)
    assert max(provider.width, provider.height) == LONG_SIDE
    ref, new = provider.observe(photograph(0.3, size)), provider.observe(photograph(0.0, size))
    found = provider.predict(ref, new, Guess(work)).matches
    used = found.weight > 0
    assert used.sum() > 0.4 * len(used)
    x, y = found.ref_px[used].astype(int).T
    world = look(0.3, work).points_world[y, x]
    in_new = full.project(transform(inverse(look(0.0, work).world_from_cam), world))
    to_full = np.array(size) / [provider.width, provider.height]
    error = np.linalg.norm((found.new_px[used] + 0.5) * to_full - 0.5 - in_new, axis=1)
    assert np.median(error) < 0.03 * to_full.max() and np.percentile(error, 90) < 0.5 * to_full.max()


def test_frames_of_another_shape_are_refused() -> None:
    provider = provider_of(TrueNetwork())
    with pytest.raises(InputError, match="working size is 160x120, got 320x200 pixels, which give 160x100"):
        provider.observe(photograph(0.0, (320, 200)))
    alien = GeometricPointmaps(160, 120, CELL).observe(photograph(0.0))
    with pytest.raises(TypeError, match="expected a frame of its own look"):
        provider.predict(alien, alien, Guess(WORK))


# -- a pair ----------------------------------------------------------------------------------------------------


def test_matches_are_within_half_a_pixel(pair: tuple[NetworkFrame, NetworkFrame, PairPrediction]) -> None:
    ref, _, said = pair
    found, inside = said.matches, inside_window(ref.px)
    truth = truth_of(look(NEW, WORK), look(REF, WORK), ref.px)
    error = np.linalg.norm(found.new_px - truth.px, axis=1)
    matched = found.weight > 0
    assert found.ref_px is ref.px and (found.weight[~inside] == 0).all() and (found.weight <= 1).all()
    assert matched[inside & truth.seen & inside_window(truth.px)].mean() > 0.9
    assert np.median(error[matched]) < 0.01 and (error[matched & truth.smooth] < 0.5).all()
    assert (error[matched] < 0.5).mean() > 0.9
    assert not matched[truth.hidden].any() and np.isfinite(found.new_px).all()


def test_pointmaps_are_exact(pair: tuple[NetworkFrame, NetworkFrame, PairPrediction]) -> None:
    ref, _, said = pair
    truth_ref, truth_new = look(REF, WORK), look(NEW, WORK)
    x, y = ref.px.astype(int).T
    known = said.ref.confidence > 0
    assert known.sum() > 250 and (known <= inside_window(ref.px)).all()
    np.testing.assert_allclose(said.ref.points[known], truth_ref.points_cam[y, x][known], rtol=1e-5, atol=1e-5)
    assert said.new_own is not None
    smooth = truth_of(truth_new, truth_ref, ref.px).smooth & (said.new_own.confidence > 0)
    new_from_ref = inverse(truth_new.world_from_cam) @ truth_ref.world_from_cam
    expected = transform(new_from_ref, truth_ref.points_cam[y, x])
    assert smooth.sum() > 60
    away = np.linalg.norm(said.new_own.points - expected, axis=1)[smooth] / expected[smooth, 2]
    assert np.median(away) < 2e-4 and away.max() < 5e-3
    np.testing.assert_allclose(said.ref.confidence[known], 0.8)  # 1 - 1/5
    assert ((said.new_own.confidence > 0) <= (said.matches.weight > 0)).all()


def test_dense_flow_follows_the_scene(pair: tuple[NetworkFrame, NetworkFrame, PairPrediction]) -> None:
    flow = pair[2].flow
    assert flow.shape == (120, 160, 2) and flow.dtype == np.float32 and np.isfinite(flow).all()
    px = np.stack(np.meshgrid(np.arange(2, 158, 3), np.arange(6, 114, 3)), -1).reshape(-1, 2).astype(float)
    truth = truth_of(look(NEW, WORK), look(REF, WORK), px)
    x, y = px.astype(int).T
    error = np.linalg.norm(px + flow[y, x] - truth.px, axis=1)
    assert np.median(error[truth.seen]) < 0.1 and np.percentile(error[truth.seen & truth.smooth], 90) < 1.0


@pytest.mark.parametrize("off_px", [5.0, 60.0])
def test_a_start_may_be_wrong(pair: tuple[NetworkFrame, NetworkFrame, PairPrediction], off_px: float) -> None:
    provider = provider_of(TrueNetwork())
    ref, new = provider.observe(photograph(REF)), provider.observe(photograph(NEW))
    start = pair[2].flow + np.float32([off_px, -off_px / 2])
    said = provider.predict(ref, new, Guess(WORK, flow=start))
    both = (said.matches.weight > 0) & (pair[2].matches.weight > 0)
    assert both.sum() > 0.95 * (pair[2].matches.weight > 0).sum()
    assert np.abs(said.matches.new_px - pair[2].matches.new_px)[both].max() < 0.01


def by_torch(*arguments: Any) -> FoundPixels:
    return FoundPixels(*in_torch.match_pixels(*arguments))


def test_the_matcher_of_the_device_says_the_same(pair: tuple[NetworkFrame, NetworkFrame, PairPrediction]) -> None:
    provider = provider_of(TrueNetwork(), matcher=by_torch)
    ref, new = provider.observe(photograph(REF)), provider.observe(photograph(NEW))
    said = provider.predict(ref, new, Guess(WORK))
    np.testing.assert_allclose(said.matches.weight, pair[2].matches.weight, atol=1e-6)
    np.testing.assert_allclose(said.matches.new_px, pair[2].matches.new_px, atol=1e-2)


def test_pose_and_scale_come_out_of_the_paper_s_stages() -> None:
    """Each frame in a scale of its own: III-B finds the pose in ref's, and the factor between them."""
    network = TrueNetwork()
    network.scale = {0.5: 1.3, 0.0: 0.7}
    provider = provider_of(network)
    ref, new = provider.observe(photograph(0.0)), provider.observe(photograph(0.5))
    x, y = ref.px.astype(int).T
    inv_depth = 1 / look(0.0, WORK).points_cam[y, x, 2]
    info = 1 / (0.02 * inv_depth) ** 2
    said = provider.predict(ref, new, Guess(WORK, inv_depth, info, np.eye(4)))
    known = said.ref.confidence > 0
    np.testing.assert_allclose(said.ref.points[known, 2], 1 / inv_depth[known], rtol=1e-4)  # the map's scale, not 0.7
    lens = np.array([np.log(WORK.fx_px), 0.0, WORK.cx_px, WORK.cy_px, 0.0, 0.0])
    matches = StaticMatches(ref.px, inv_depth, info, said.matches.new_px, said.matches.weight, lens)
    problem = AlignmentProblem(said, matches.weight, matches, np.eye(4), provider.depth_sigma_ratio)
    found = align(CoarseToFine(AlignmentConfig()), problem)
    truth = inverse(look(0.5, WORK).world_from_cam) @ look(0.0, WORK).world_from_cam
    assert found.stages == ("raw", "coarse", "scale", "fine")
    assert found.scale == pytest.approx(1 / 1.3, rel=5e-3)
    assert np.abs(found.new_from_ref - truth).max() < 5e-3


# -- what is remembered ----------------------------------------------------------------------------------------


def test_every_frame_is_encoded_once_and_every_pair_decoded_once() -> None:
    network = TrueNetwork()
    provider = provider_of(network)
    ref = provider.observe(photograph(0.0))
    assert (network.encoded, network.decoded) == (1, 1)  # with itself
    new = provider.observe(photograph(0.3), near=ref)
    for _ in range(3):
        provider.predict(ref, new, Guess(WORK))
    assert (network.encoded, network.decoded) == (2, 2)  # the pair serves own depth and matches
    provider.predict(new, ref, Guess(WORK))
    assert (network.encoded, network.decoded) == (2, 3)
    alone = provider.observe(photograph(0.3))
    assert (network.encoded, network.decoded) == (3, 4)
    np.testing.assert_allclose(alone.own_inv_depth, new.own_inv_depth)  # this network says the same of both


def test_what_was_forgotten_is_encoded_again() -> None:
    network = TrueNetwork()
    provider = provider_of(network, remembered_frames=2, remembered_pairs=1)
    frames = [provider.observe(photograph(t)) for t in (0.0, 0.1, 0.2, 0.3)]
    before = network.encoded
    first = provider.predict(frames[0], frames[3], Guess(WORK))
    assert network.encoded == before + 1
    np.testing.assert_array_equal(
        first.matches.new_px, provider_of(TrueNetwork()).predict(frames[0], frames[3], Guess(WORK)).matches.new_px
    )


def test_place_descriptors_have_unit_length() -> None:
    provider = provider_of(TrueNetwork())
    one, other = (provider.place_descriptor(provider.observe(photograph(t))) for t in (0.0, 4.0))
    assert one.dtype == np.float32 and one.shape == (2,)
    np.testing.assert_allclose([np.linalg.norm(one), np.linalg.norm(other)], 1, rtol=1e-6)
    np.testing.assert_allclose(other, [0.6, 0.8], rtol=1e-6)


# -- nonsense --------------------------------------------------------------------------------------------------


class Broken(TrueNetwork):
    """Spoils what it says: not a number, infinite, behind the camera, or all of it."""

    def __init__(self, share: float) -> None:
        super().__init__()
        self.share, self.rng = share, np.random.default_rng(0)

    def pairs(self, pairs: Any) -> list[Any]:
        return [self.pair(a, b) for a, b in pairs]

    def pair(self, a: Known, b: Known) -> Any:
        said = super().pair(a, b)
        return Both(self.spoilt(said.first), self.spoilt(said.second))

    def spoilt(self, maps: Maps) -> Maps:
        out = {}
        for name in ("points", "confidence", "descriptors", "descriptor_confidence"):
            values = getattr(maps, name).copy()
            bad = self.rng.random(values.shape) < self.share
            nonsense = [np.nan, np.inf, -np.inf, 1e30] + ([] if name == "descriptors" else [-3.0, 0.0])
            values[bad] = self.rng.choice(nonsense, int(bad.sum()))
            out[name] = values
        return Maps(**out)


def assert_sane(said: PairPrediction, count: int) -> None:
    assert said.new_own is not None and np.isfinite(said.flow).all()
    for pointmap in (said.ref, said.new_own):
        assert pointmap.points.shape == (count, 3) and np.isfinite(pointmap.points).all()
        assert ((pointmap.confidence >= 0) & (pointmap.confidence <= 1)).all()
    assert np.isfinite(said.matches.new_px).all()
    assert ((said.matches.weight >= 0) & (said.matches.weight <= 1)).all()


@pytest.mark.parametrize("share", [0.01, 0.3, 1.0])
def test_nonsense_has_no_weight(share: float) -> None:
    provider = provider_of(Broken(share))
    ref, new = provider.observe(photograph(0.0)), provider.observe(photograph(0.3))
    for guess in (
        Guess(WORK),
        Guess(WORK, np.full(300, 0.4), np.full(300, 1e4), np.eye(4), np.zeros((120, 160, 2), "f")),
    ):
        said = provider.predict(ref, new, guess)
        assert_sane(said, 300)
    for work in (ref, new):
        assert work.own_inv_depth is not None and np.isfinite(work.own_inv_depth).all()
        assert ((work.own_inv_depth >= 0) & (work.own_inv_depth < 1e4)).all()
    if share == 0.01:
        truth = truth_of(look(0.3, WORK), look(0.0, WORK), ref.px)
        error = np.linalg.norm(said.matches.new_px - truth.px, axis=1)[said.matches.weight > 0]
        assert len(error) > 80 and np.median(error) < 0.5
    if share == 1.0:
        assert (said.matches.weight == 0).all()


@pytest.mark.parametrize("size", [(160, 120), (120, 160)])
def test_a_tiny_random_network_runs_the_whole_path(size: tuple[int, int]) -> None:
    network = PairNetwork(random_mast3r(Mast3rConfig.tiny()), long_side_px=96)
    provider = provider_of(network, size)
    camera = Camera.centred(100, provider.width, provider.height)
    near: NetworkFrame | None = None
    rng = np.random.default_rng(0)
    frames = []
    for n in range(3):
        image = rng.integers(0, 255, (size[1], size[0], 3)).astype(np.uint8)
        near = provider.observe(Frame(n, n / 30, image), near)
        frames.append(near)
    for ref, new in ((frames[0], frames[1]), (frames[2], frames[0])):
        assert_sane(provider.predict(ref, new, Guess(camera)), len(ref.px))
    assert np.linalg.norm(provider.place_descriptor(frames[1])) == pytest.approx(1, rel=1e-5)
    torch_says = provider_of(network, size, matcher=by_torch)
    a, b = (m.predict(frames[0], frames[1], Guess(camera)).matches.weight for m in (provider, torch_says))
    assert ((a > 0) == (b > 0)).mean() > 0.95


# -- its instruments -------------------------------------------------------------------------------------------


def test_own_depth_between_pixels_is_that_of_the_plane_and_stops_at_edges() -> None:
    y, x = np.mgrid[0:20, 0:30].astype(np.float32)
    plane = 0.2 + 0.001 * x + 0.002 * y
    at = np.random.default_rng(0).uniform([0, 0], [29, 19], (50, 2))
    np.testing.assert_allclose(sample_smooth(plane, at), 0.2 + at @ [0.001, 0.002], rtol=1e-6)
    plane[:, 15:] *= 2
    plane[5, 5] = 0
    edge = np.array([[14.5, 3.0], [14.0, 3.0], [15.0, 3.0], [4.5, 5.0], [4.0, 5.0], [-0.1, 3], [29, 19], [29.1, 3]])
    assert (sample_smooth(plane, edge) > 0).tolist() == [False, True, True, False, True, False, True, False]
    assert (sample_smooth(None, edge) == 0).all()


def test_focal_length_from_points() -> None:
    camera = Camera(210, 210, 40, 30, 96, 80)
    depth = 2 + np.random.default_rng(0).random((80, 96))
    points = camera.rays(camera.pixel_grid()) * depth[..., None]
    points[::3, ::3] += 50  # outliers
    assert focal_from_points(points, np.ones((80, 96), bool), (40, 30)) == pytest.approx(210, rel=0.02)
    assert focal_from_points(points, np.zeros((80, 96), bool), (40, 30)) is None
    assert focal_from_points(-points, points[..., 2] > 1e9, (40, 30)) is None
