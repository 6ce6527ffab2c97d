"""Matches from a pair's own points and descriptors: numba and torch against plain searches and against the truth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from known_pair import Maps, RoomView, decoded, look, truth_of, with_noise
from mastd3r.networks import matching as in_torch
from mastd3r.pointmap.matching import (
    FoundPixels,
    MatchOptions,
    match_pixels,
    ray_image,
    search_descriptors,
    search_rays,
    subsampled,
)

Array = NDArray[Any]
OPTIONS = MatchOptions()
STEP = 4


@pytest.fixture(scope="module")
def views() -> tuple[RoomView, RoomView]:
    """Two views across the room, each with surfaces that the other cannot see."""
    return look(3.2), look(0.0)


@pytest.fixture(scope="module")
def exact(views: tuple[RoomView, RoomView]) -> tuple[Maps, Maps]:
    return decoded(*views)


def cells(maps: Maps) -> Array:
    return subsampled(*maps.points.shape[:2], STEP)[0]


def by_torch(
    target: Maps, source: Maps, px: Array, start: Array | None, options: MatchOptions = OPTIONS
) -> FoundPixels:
    return FoundPixels(*in_torch.match_pixels(target, source, px, start, options))


def rays_of(points: Array) -> Array:
    return points / np.linalg.norm(points, axis=-1, keepdims=True)


# -- plain twins: every pixel is looked at ---------------------------------------------------------------------


def plain_nearest_ray(target: Maps, points: Array) -> Array:
    """(n, 2) whole pixels whose ray is nearest to that of each point, over the whole image."""
    w = target.points.shape[1]
    rays = rays_of(target.points.astype(float)).reshape(-1, 3)
    best = [int((rays @ ray).argmax()) for ray in rays_of(points)]
    return np.array([[b % w, b // w] for b in best], float).reshape(-1, 2)


def plain_nearest_descriptor(target: Maps, wanted: Array) -> Array:
    """(n, 2) whole pixels with the most alike descriptor, over the whole image."""
    w = target.points.shape[1]
    flat = target.descriptors.reshape(-1, wanted.shape[1])
    best = [int((flat @ row).argmax()) for row in wanted]
    return np.array([[b % w, b // w] for b in best], float)


def plain_window(descriptors: Array, row: Array, start: tuple[int, int], radius: int, dilation: int) -> tuple[int, int]:
    """The dilated search as its definition says it, one pixel at a time."""
    h, w = descriptors.shape[:2]
    x, y = start
    for step in range(dilation, 0, -1):
        candidates = [
            (x + i * step, y + j * step) for j in range(-radius, radius + 1) for i in range(-radius, radius + 1)
        ]
        inside = [(i, j) for i, j in candidates if 0 <= i < w and 0 <= j < h]
        x, y = max(inside, key=lambda p: float(descriptors[p[1], p[0]].astype(float) @ row.astype(float)))
    return x, y


# -- the search on rays ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("off_px", [0.0, 3.0, 12.0, 50.0])
def test_rays_are_found_to_a_hundredth_of_a_pixel(
    views: tuple[RoomView, RoomView], exact: tuple[Maps, Maps], off_px: float
) -> None:
    px = cells(exact[1])
    truth = truth_of(*views, px)
    points = exact[1].points[px[:, 1].astype(int), px[:, 0].astype(int)].astype(float)
    start = truth.px + np.random.default_rng(0).uniform(-off_px, off_px, px.shape)
    found, cost = search_rays(ray_image(exact[0].points), points, start, OPTIONS)
    error = np.linalg.norm(found - truth.px, axis=1)
    assert truth.in_view.sum() > 800
    assert error[truth.in_view].max() < 0.01 and (cost[truth.in_view] < OPTIONS.converged).all()


def test_a_point_out_of_view_does_not_converge(views: tuple[RoomView, RoomView], exact: tuple[Maps, Maps]) -> None:
    camera = views[0].camera
    outside = camera.rays(np.array([[-15.0, 70], [90, -12], [camera.width + 9, 20], [80, camera.height + 30]])) * 2
    behind, nothing = -camera.rays(np.array([[90.0, 70]])), np.zeros((1, 3))
    points = np.concatenate([outside, behind, nothing, [[np.nan, 0, 1]], [[np.inf, 0, 1]]])
    start = np.full((len(points), 2), 70.0)
    found, cost = search_rays(ray_image(exact[0].points), points, start, OPTIONS)
    assert (cost > OPTIONS.converged).all() and np.isfinite(found).all()
    there, again = in_torch.search_rays(
        in_torch.ray_image(torch.as_tensor(exact[0].points)), torch.as_tensor(points), torch.as_tensor(start), OPTIONS
    )
    assert (again.numpy() > OPTIONS.converged).all() and np.isfinite(there.numpy()).all()


def test_rays_agree_with_a_search_over_all_pixels(exact: tuple[Maps, Maps]) -> None:
    noisy = with_noise(exact[0], 0.002)
    px = subsampled(*noisy.points.shape[:2], 9)[0]
    points = with_noise(exact[1], 0.002, seed=3).points[px[:, 1].astype(int), px[:, 0].astype(int)].astype(float)
    found, cost = search_rays(ray_image(noisy.points), points, px, OPTIONS)
    good = cost < 1e-10  # the ray lies inside the image
    plain = plain_nearest_ray(noisy, points[good])
    assert good.mean() > 0.7
    assert np.abs(found[good] - plain).max() < 0.75  # half a pixel, and a little where pixels are not square


def test_ray_image_is_the_same_in_torch_and_holds_gradients(exact: tuple[Maps, Maps]) -> None:
    points = exact[0].points.copy()
    points[3, 4], points[5, 6] = np.nan, 0
    image = ray_image(points)
    np.testing.assert_allclose(in_torch.ray_image(torch.as_tensor(points)).numpy(), image, atol=1e-6)
    assert (image[3, 4, :3] == 0).all() and (image[5, 6, :3] == 0).all()
    inner = image[20:-1, 20:-1]
    middle = (image[20:-1, 21:, :3] - image[20:-1, 19:-2, :3]) / 2
    assert np.abs(inner[..., 3:6] - middle).max() < 1e-4  # a ray image is nearly linear over three rows


# -- the search on descriptors ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("radius", "dilation"), [(3, 5), (1, 1), (2, 3)])
def test_descriptor_search_is_what_its_definition_says(exact: tuple[Maps, Maps], radius: int, dilation: int) -> None:
    rng = np.random.default_rng(1)
    h, w = exact[0].points.shape[:2]
    start = rng.integers(0, [w, h], (150, 2))
    start[:4] = [[0, 0], [w - 1, 0], [0, h - 1], [w - 1, h - 1]]
    wanted = exact[1].descriptors[start[:, 1], start[:, 0]]
    options = replace(OPTIONS, radius=radius, dilation_max=dilation)
    plain = [
        plain_window(exact[0].descriptors, row, (x, y), radius, dilation)
        for row, (x, y) in zip(wanted, start.tolist(), strict=True)
    ]
    found, similarity = search_descriptors(exact[0].descriptors, wanted, start.astype(float), options)
    there, again = in_torch.search_descriptors(
        torch.as_tensor(exact[0].descriptors), torch.as_tensor(wanted), torch.as_tensor(start).float(), options
    )
    for got, alike in ((found, similarity), (there.numpy(), again.numpy())):
        assert np.abs(got - plain).max() <= 1
        here = [exact[0].descriptors[y, x] @ row for (x, y), row in zip(plain, wanted, strict=True)]
        np.testing.assert_allclose(alike, here, atol=1e-5)
    np.testing.assert_allclose(there.numpy(), found, atol=2e-2)


def test_descriptor_search_finds_the_best_of_the_whole_image(
    views: tuple[RoomView, RoomView], exact: tuple[Maps, Maps]
) -> None:
    px = subsampled(*exact[1].points.shape[:2], 9)[0]
    truth = truth_of(*views, px)
    px, at = px[truth.seen], truth.px[truth.seen]
    wanted = exact[1].descriptors[px[:, 1].astype(int), px[:, 0].astype(int)]
    start = at + np.random.default_rng(0).uniform(-5, 5, px.shape)
    found, _ = search_descriptors(exact[0].descriptors, wanted, start, OPTIONS)
    plain = plain_nearest_descriptor(exact[0], wanted)
    assert len(px) > 100
    assert (np.abs(found - plain).max(1) <= 1).mean() > 0.97


# -- all of it -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("matcher", [match_pixels, by_torch])
@pytest.mark.parametrize("off_px", [0.0, 4.0, 25.0])
def test_matches_are_sub_pixel_from_a_wrong_start(
    views: tuple[RoomView, RoomView], exact: tuple[Maps, Maps], matcher: Any, off_px: float
) -> None:
    px = cells(exact[1])
    truth = truth_of(*views, px)
    start = truth.px + np.random.default_rng(2).uniform(-off_px, off_px, px.shape)
    found = matcher(exact[0], exact[1], px, start, OPTIONS)
    error = np.linalg.norm(found.px - truth.px, axis=1)
    used = found.valid & truth.seen
    assert used.sum() > 0.95 * truth.seen.sum() > 1000
    assert np.median(error[used]) < 0.01 and np.percentile(error[used], 90) < 0.3
    assert np.percentile(error[used & truth.smooth], 98) < 0.05 and truth.smooth.sum() > 500
    np.testing.assert_allclose(found.confidence[used], 5, rtol=1e-6)


@pytest.mark.parametrize("matcher", [match_pixels, by_torch])
def test_hidden_points_are_refused(views: tuple[RoomView, RoomView], exact: tuple[Maps, Maps], matcher: Any) -> None:
    px = subsampled(*exact[1].points.shape[:2], 1)[0]
    truth = truth_of(*views, px)
    px, truth = px[truth.hidden | ~truth.in_view], truth_of(*views, px[truth.hidden | ~truth.in_view])
    found = matcher(exact[0], exact[1], px, None, OPTIONS)
    assert truth.hidden.sum() > 500 and found.valid[truth.hidden].mean() < 0.01
    gone = matcher(exact[0], exact[1], px, None, replace(OPTIONS, distance_ratio=1e9))
    assert gone.valid[truth.hidden].mean() > 0.5, "nothing else refuses them: the test in space does"
    assert not found.valid[~truth.in_view & ((truth.px < -3) | (truth.px > [195, 147])).any(1)].any()


@pytest.mark.parametrize("matcher", [match_pixels, by_torch])
def test_descriptors_that_lead_to_another_place_are_refused(
    views: tuple[RoomView, RoomView], exact: tuple[Maps, Maps], matcher: Any
) -> None:
    """A source pixel is given the descriptor of a target pixel 10 px beside its own, on another surface."""
    px = subsampled(*exact[1].points.shape[:2], 1)[0]
    truth = truth_of(*views, px)
    decoy = np.clip(np.round(truth.px) + np.array([10, 0]), 0, [191, 143]).astype(int)
    own = np.clip(np.round(truth.px), 0, [191, 143]).astype(int)
    depth = exact[0].points[..., 2]
    ratio = depth[decoy[:, 1], decoy[:, 0]] / depth[own[:, 1], own[:, 0]]
    lured = np.flatnonzero(truth.seen & truth.smooth & (np.abs(np.log(ratio)) > 0.25))
    x, y = px[lured].astype(int).T
    source = replace(exact[1], descriptors=exact[1].descriptors.copy())
    source.descriptors[y, x] = exact[0].descriptors[decoy[lured, 1], decoy[lured, 0]]
    found = matcher(exact[0], source, px[lured], truth.px[lured], OPTIONS)
    there = np.abs(found.px - decoy[lured]).max(1) <= 1
    assert there.sum() > 30 and not found.valid[there].any()
    assert matcher(exact[0], exact[1], px[lured], truth.px[lured], OPTIONS).valid.mean() > 0.95


def test_the_limit_in_space_is_a_share_of_the_distance(exact: tuple[Maps, Maps]) -> None:
    px = cells(exact[1])
    near = match_pixels(*exact, px)
    for scale in (1e-3, 1e3):
        scaled = [replace(m, points=m.points * np.float32(scale)) for m in exact]
        assert (match_pixels(scaled[0], scaled[1], px).valid == near.valid).mean() > 0.998


def test_descriptors_mend_what_points_get_wrong(views: tuple[RoomView, RoomView], exact: tuple[Maps, Maps]) -> None:
    wrong = with_noise(exact[0], 0.012), with_noise(exact[1], 0.012, seed=5)
    px = cells(exact[1])
    truth = truth_of(*views, px)
    points = wrong[1].points[px[:, 1].astype(int), px[:, 0].astype(int)].astype(float)
    rays, _ = search_rays(ray_image(wrong[0].points), points, px, OPTIONS)
    found = match_pixels(*wrong, px)
    used = found.valid & truth.seen
    assert used.sum() > 0.7 * truth.seen.sum()
    assert np.median(np.linalg.norm(rays - truth.px, axis=1)[used]) > 1.5
    assert np.median(np.linalg.norm(found.px - truth.px, axis=1)[used]) < 0.1


def test_noise_of_descriptors_costs_accuracy_not_sanity(views: tuple[RoomView, RoomView]) -> None:
    noisy = decoded(*views, noise=0.2)
    px = cells(noisy[1])
    truth = truth_of(*views, px)
    once = match_pixels(*noisy, px)
    both = match_pixels(*noisy, px, None, replace(OPTIONS, reciprocal_px=1.0))
    error = np.linalg.norm(once.px - truth.px, axis=1)
    assert np.median(error[once.valid & truth.seen]) < 1.0
    kept = both.valid & truth.seen
    assert (both.valid <= once.valid).all() and 0.4 < kept.sum() / truth.seen.sum() < 1
    assert np.percentile(error[kept], 95) < np.percentile(error[once.valid & truth.seen], 95)


@pytest.mark.parametrize("matcher", [match_pixels, by_torch])
def test_where_all_descriptors_are_alike_the_ray_decides(
    views: tuple[RoomView, RoomView], exact: tuple[Maps, Maps], matcher: Any
) -> None:
    same = [replace(m, descriptors=np.full_like(m.descriptors, 24**-0.5)) for m in exact]
    px = cells(exact[1])
    truth = truth_of(*views, px)
    found = matcher(*same, px, None, OPTIONS)
    assert found.valid[truth.seen].mean() > 0.95
    assert np.abs(found.px - truth.px)[truth.seen].max() < 0.51  # the pixel that the ray is in, whole


@pytest.mark.parametrize("reciprocal_px", [0.0, 1.5])
def test_torch_and_numba_say_the_same_and_bear_nonsense(exact: tuple[Maps, Maps], reciprocal_px: float) -> None:
    options = replace(OPTIONS, reciprocal_px=reciprocal_px)
    rng = np.random.default_rng(0)
    target, source = (
        replace(with_noise(m, 0.004), descriptors=m.descriptors.copy(), descriptor_confidence=np.ones((144, 192)) * 3)
        for m in exact
    )
    for maps in (target, source):
        for values in (maps.points, maps.descriptors, maps.descriptor_confidence):
            where = rng.random((144, 192)) < 0.03
            values[where] = rng.choice([np.nan, np.inf, -np.inf], int(where.sum()))[
                (..., *([None] * (values.ndim - 2)))
            ]
    px = cells(source)
    start = px + rng.uniform(-3, 3, px.shape)
    start[0] = np.nan
    a, b = match_pixels(target, source, px, start, options), by_torch(target, source, px, start, options)
    assert np.isfinite(a.px).all() and np.isfinite(b.px).all() and 0.3 < a.valid.mean() < 0.99
    x, y = px.astype(int).T
    for maps_of_pixel in (source.points[y, x], source.descriptors[y, x], source.descriptor_confidence[y, x][:, None]):
        assert not a.valid[~np.isfinite(maps_of_pixel).all(1)].any()
    assert (a.valid == b.valid).mean() > 0.995
    same = a.valid & b.valid
    assert np.percentile(np.abs(a.px - b.px)[same], 99.5) < 0.01
    np.testing.assert_allclose(a.confidence[same], b.confidence[same], rtol=1e-5)


def test_a_pair_of_pure_noise_gives_no_error() -> None:
    rng = np.random.default_rng(0)

    def noise() -> Maps:
        sure = np.full((48, 64), 9.0, np.float32)
        return Maps(rng.normal(size=(48, 64, 3)).astype("f"), sure, rng.normal(size=(48, 64, 24)).astype("f"), sure)

    a, b = noise(), noise()
    px = cells(b)
    for found in (match_pixels(a, b, px), by_torch(a, b, px, None)):
        assert np.isfinite(found.px).all() and found.valid.mean() < 0.5


def test_pixels_outside_are_refused(exact: tuple[Maps, Maps]) -> None:
    for matcher in (match_pixels, by_torch):
        for px in ([[192.0, 5.0]], [[-1.0, 5.0]], [[5.0, 144.0]]):
            with pytest.raises(ValueError, match="expected pixels inside 192x144"):
                matcher(exact[0], exact[1], np.array(px), None, OPTIONS)
        assert len(matcher(exact[0], exact[1], np.zeros((0, 2)), None, OPTIONS).px) == 0


def test_subsampled_grids() -> None:
    px, grid = subsampled(10, 16, 8)
    assert grid == (2, 2) and px.tolist() == [[4, 4], [12, 4], [4, 9], [12, 9]]
    px, grid = subsampled(3, 4, 1)
    assert grid == (3, 4) and px.tolist() == [[x, y] for y in range(3) for x in range(4)]
