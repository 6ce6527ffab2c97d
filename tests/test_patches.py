"""Patch alignment: sub-pixel truth, a plain twin of one patch, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mastd3r.camera.pinhole import Camera
from mastd3r.pointmap.flow import FlowMatcher
from mastd3r.pointmap.patches import SETTLED_PX, align_patches, wide, window

Array = NDArray[Any]
WIDTH, HEIGHT = 160, 120
GRID = Camera.centred(1, WIDTH, HEIGHT).pixel_grid()
CENTRE = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
WINDOW = window(13, 3.5)
ROUNDS = 12
QUICK = settings(max_examples=20, deadline=None)


def picture(at: Array, seed: int = 0) -> Array:
    """A sum of plane waves, known between pixels too: grey levels about 128 +- 30 at ``at`` (..., 2)."""
    rng = np.random.default_rng(seed)
    length_px, angle, phase = (
        np.exp(rng.uniform(np.log(8), np.log(60), 60)),
        rng.uniform(0, 7, 60),
        rng.uniform(0, 7, 60),
    )
    k = 2 * np.pi / length_px * np.stack([np.cos(angle), np.sin(angle)])
    height = length_px**0.5
    value = (np.sin(at @ k + phase) * height).sum(-1)
    return np.asarray(128 + 30 * value / np.sqrt((height**2).sum() / 2))


def pair(
    matrix: Array, shift: Array, gain: float = 1.0, bias: float = 0.0
) -> tuple[Array, Array, Callable[..., Array]]:
    """ref, new with new(M (x - c) + c + t) = gain ref(x) + bias, and the map of pixels."""
    back = np.linalg.inv(matrix)
    ref = picture(GRID)
    new = gain * picture((GRID - CENTRE - shift) @ back.T + CENTRE) + bias
    return ref, new, lambda px: (px - CENTRE) @ matrix.T + CENTRE + shift


def spots(step: int = 12, border: int = 24) -> Array:
    y, x = np.mgrid[border : HEIGHT - border : step, border : WIDTH - border : step]
    return np.stack([x.ravel(), y.ravel()], 1).astype(float)


def turned(angle_deg: float, zoom: float) -> Array:
    c, s = zoom * np.cos(np.deg2rad(angle_deg)), zoom * np.sin(np.deg2rad(angle_deg))
    return np.array([[c, -s], [s, c]])


@pytest.mark.parametrize(("gain", "bias"), [(1.0, 0.0), (1.4, 0.0), (1.0, -25.0), (1.4, 18.0), (0.6, 30.0)])
@pytest.mark.parametrize(
    ("matrix", "shift"),
    [
        (np.eye(2), np.array([0.0, 0.0])),
        (np.eye(2), np.array([2.37, -1.61])),
        (turned(6, 1.0), np.array([0.8, 0.3])),
        (turned(-3, 1.08), np.array([-0.4, 1.5])),
        (np.array([[1.05, 0.12], [-0.04, 0.94]]), np.array([1.1, -0.7])),
    ],
)
def test_a_known_warp_comes_back(matrix: Array, shift: Array, gain: float, bias: float) -> None:
    """The start is 1 px off both ways. Half the patches within 0.03 px, 95 % within 0.06 px, none lost.

    What is left is linear interpolation: waves of 8 px are softened between pixels and not at them.
    """
    ref, new, where = pair(matrix, shift, gain, bias)
    px = spots()
    truth = where(px)
    start = truth + np.random.default_rng(1).uniform(-1, 1, px.shape)
    affine = np.tile(matrix, (len(px), 1, 1))
    found, alike = align_patches(wide(ref), wide(new), px, start, affine, WINDOW, ROUNDS)
    error = np.linalg.norm(found - truth, axis=1)
    assert (alike > 0.98).all()
    assert np.median(error) < 0.03 and np.percentile(error, 95) < 0.06


def test_places_between_pixels_are_patches_too() -> None:
    ref, new, where = pair(np.eye(2), np.array([0.6, -0.3]))
    px = spots() + np.random.default_rng(2).uniform(-0.5, 0.5, spots().shape)
    found, alike = align_patches(
        wide(ref), wide(new), px, px + 0.0, np.tile(np.eye(2), (len(px), 1, 1)), WINDOW, ROUNDS
    )
    assert (alike > 0.98).all() and np.median(np.linalg.norm(found - where(px), axis=1)) < 0.02


def test_a_warp_that_is_not_told_is_worse() -> None:
    """What the local affine is for: with the identity instead, the same pictures give several times the error."""
    matrix = np.array([[1.15, 0.16], [-0.12, 0.9]])
    ref, new, where = pair(matrix, np.array([0.4, 0.2]))
    px = spots()
    truth = where(px)
    errors = []
    for warp in (matrix, np.eye(2)):
        found, _ = align_patches(wide(ref), wide(new), px, truth + 0.0, np.tile(warp, (len(px), 1, 1)), WINDOW, ROUNDS)
        errors.append(np.median(np.linalg.norm(found - truth, axis=1)))
    assert errors[0] < 0.03 and errors[1] > 3 * errors[0]


def bilinear(image: Array, x: float, y: float) -> float:
    ix, iy = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - ix, y - iy
    corner = image[iy : iy + 2, ix : ix + 2].astype(float)
    return float(np.array([1 - fy, fy]) @ corner @ np.array([1 - fx, fx]))


def plain_align(
    ref: Array, new: Array, px: Array, start: Array, affine: Array, weight: Array, rounds: int
) -> tuple[Array, float]:
    """One patch with the same equations, as a weighted least-squares problem of shift, gain and bias each round."""
    r = len(weight) // 2
    offsets = [(i - r, j - r) for j in range(2 * r + 1) for i in range(2 * r + 1)]
    w = weight.astype(float).ravel()
    back = np.linalg.inv(affine)

    def template(dx: float, dy: float) -> Array:
        """ref, as new should show it, (dx, dy) beside each pixel of the window."""
        return np.array([bilinear(ref, *(px + back @ (ox + dx, oy + dy))) for ox, oy in offsets])

    value = template(0, 0)

    gradient = 0.5 * np.stack([template(1, 0) - template(-1, 0), template(0, 1) - template(0, -1)], 1)
    at, similarity = np.array(start, float), -1.0
    for _ in range(rounds):
        seen = np.array([bilinear(new, *(at + o)) for o in offsets])
        v, t = seen - w @ seen, value - w @ value
        similarity = (w * v) @ t / np.sqrt(((w * v) @ v) * ((w * t) @ t))
        gain = (w * v) @ t / ((w * t) @ t)
        # seen = gain (T + grad T . step) + bias, with gain and bias free beside the step
        design = np.concatenate([gain * gradient, value[:, None], np.ones((len(w), 1))], 1)
        root = np.sqrt(w)[:, None]
        step = np.linalg.lstsq(root * design, root[:, 0] * seen, rcond=None)[0][:2]
        at = at - step
        if (step**2).sum() < SETTLED_PX**2:
            break
    return at, float(similarity)


@QUICK
@given(st.integers(0, 10**6))
def test_the_kernel_is_its_plain_twin(seed: int) -> None:
    """Same place to 1e-3 px and same likeness: the projection of gain and bias is a joint least-squares solution."""
    rng = np.random.default_rng(seed)
    matrix = np.eye(2) + rng.uniform(-0.1, 0.1, (2, 2))
    ref, new, where = pair(matrix, rng.uniform(-2, 2, 2), rng.uniform(0.7, 1.4), rng.uniform(-10, 10))
    px = rng.uniform([30, 30], [WIDTH - 30, HEIGHT - 30], (1, 2))
    start = where(px) + rng.uniform(-1, 1, (1, 2))
    warp = matrix + rng.uniform(-0.03, 0.03, (2, 2))
    rounds = int(rng.integers(1, ROUNDS))
    found, alike = align_patches(wide(ref), wide(new), px, start, warp[None], WINDOW, rounds)
    wanted, similarity = plain_align(ref, new, px[0], start[0], warp, WINDOW, rounds)
    if alike[0] == -1:  # not settled in so few rounds
        assert rounds < 5
        np.testing.assert_array_equal(found, start)
        return
    np.testing.assert_allclose(found[0], wanted, atol=2e-3)
    assert alike[0] == pytest.approx(similarity, abs=1e-3)


def aligned(ref: Array, new: Array, px: Any, start: Any = None) -> tuple[Array, Array]:
    px = np.atleast_2d(np.asarray(px, float))
    begin = px + 0.0 if start is None else np.atleast_2d(np.asarray(start, float))
    images = wide(ref), wide(new)
    return align_patches(*images, px, begin, np.tile(np.eye(2), (len(px), 1, 1)), WINDOW, ROUNDS)


def test_flat_patches_and_edges_are_refused() -> None:
    """No texture at all, faint noise, and an edge along which nothing changes: the place is not known."""
    flat = np.full((HEIGHT, WIDTH), 90.0)
    faint = flat + np.random.default_rng(0).normal(0, 0.1, flat.shape)
    edge = flat + 60.0 * (GRID[..., 0] > 80) + np.zeros_like(flat)
    ramp = GRID[..., 0] * 1.0  # its slope is a bias, once a shift is free
    for image in (flat, faint, edge, ramp):
        found, alike = aligned(image, image, [80.0, 60.0], [80.4, 60.3])
        assert (alike == -1).all() and (found == [80.4, 60.3]).all()
    corner = edge + 60.0 * (GRID[..., 1] > 60)
    assert aligned(corner, corner, [80.0, 60.0])[1][0] > 0.99


def test_patches_that_leave_a_picture_are_refused() -> None:
    ref, new, _ = pair(np.eye(2), np.zeros(2))
    inside = [80.0, 60.0]
    out = [[0, 60], [6, 60], [WIDTH - 4, 60], [80, 3], [80, HEIGHT - 2], [-50, 60], [80, 1e6]]
    assert (aligned(ref, new, out)[1] == -1).all()
    starts: list[Any] = [*out, [np.nan, 60]]
    for at in starts:
        found, alike = aligned(ref, new, inside, at)
        assert alike[0] == -1 and np.array_equal(found[0], at, equal_nan=True)
    assert aligned(ref, new, [[8, 60], [80, 8], [WIDTH - 10, 60], [80, HEIGHT - 10]])[1].min() > 0.99


def test_one_that_walks_out_is_refused() -> None:
    """The truth lies outside the new picture: the search runs into the border and is given up."""
    ref, new, where = pair(np.eye(2), np.array([-14.0, 0.0]))
    px = np.stack([np.full(8, 17.0), np.linspace(20, 100, 8)], 1)  # lies at x = 3 in new, the window at -3
    found, alike = aligned(ref, new, px, where(px) + np.array([5.0, 0.0]))
    assert not ((alike > 0.7) & (np.linalg.norm(found - where(px), axis=1) < 3)).any()


def test_what_is_covered_or_different_is_not_alike() -> None:
    ref, new, _ = pair(np.eye(2), np.array([0.4, 0.2]))
    px = spots()
    other = picture(GRID, seed=9)
    assert (aligned(ref, other, px)[1] > 0.9).mean() < 0.05
    covered = new.copy()
    covered[:, 80:] = other[:, 80:]
    alike = aligned(ref, covered, px)[1]
    assert alike[px[:, 0] < 72].min() > 0.98
    assert (alike[px[:, 0] > 88] > 0.9).mean() < 0.05
    inverted = aligned(ref, 255 - ref, px)[1]
    assert (inverted < 0.5).all()  # a negative is not the same thing


def test_the_matcher_gives_no_weight_to_what_is_covered() -> None:
    """End to end: a panel with a texture of its own in the second picture, and the light turned up by 1.3."""
    matrix, shift = turned(2, 1.02), np.array([3.2, -2.4])
    ref, new, where = pair(matrix, shift, 1.3, -20.0)
    new = new.copy()
    new[40:80, 60:110] = picture(1.7 * GRID, seed=4)[40:80, 60:110]
    px = spots(6)
    a, b = (np.rint(i).clip(0, 255).astype(np.uint8) for i in (ref, new))
    found = FlowMatcher(WIDTH, HEIGHT).match(a, b, px)
    truth = where(px)
    hidden = ((truth > [62, 42]) & (truth < [107, 77])).all(1)
    clear = ((truth < [50, 30]) | (truth > [119, 89])).any(1)
    assert hidden.sum() > 20 and (found.weight[hidden] > 0.5).mean() < 0.1
    good = clear & (found.weight > 0.5)
    assert good.sum() > 0.8 * clear.sum()
    assert np.median(np.linalg.norm(found.target - truth, axis=1)[good]) < 0.05


def test_the_window_sums_to_one() -> None:
    w = window(13, 3.5)
    assert w.shape == (13, 13) and w.sum() == pytest.approx(1, abs=1e-6) and w.argmax() == 84
    np.testing.assert_allclose(w, w.T)
    np.testing.assert_allclose(w, w[::-1, ::-1])
