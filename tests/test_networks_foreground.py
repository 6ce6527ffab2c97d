"""The foreground prior finds what stands out from the border, knows no class, and does not flicker over a video."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mastd3r.errors import InputError
from mastd3r.networks.foreground import ForegroundPrior, border_cells, foreground_prior

Array = NDArray[Any]

ROWS, COLS = 27, 36


def disc(x: float, y: float, radius: float) -> Array:
    rows, cols = np.mgrid[0:ROWS, 0:COLS]
    inside: Array = (rows - y) ** 2 + (cols - x) ** 2 < radius**2
    return inside


def scene(thing: Array, channels: int, seed: int = 0, contrast: float = 3.0, noise: float = 0.5) -> Array:
    """Two kinds of cell, far apart along one random direction, with noise along all, on an offset that says nothing."""
    rng = np.random.default_rng(seed)
    offset, direction = np.random.default_rng(1000).normal(size=(2, channels))
    direction /= np.linalg.norm(direction)
    clean = 5 * offset + contrast * thing[..., None] * direction
    features: Array = (clean + noise * rng.normal(size=(ROWS, COLS, channels)) / np.sqrt(channels)).astype(np.float32)
    return features


@pytest.mark.parametrize("channels", [16, 384])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_thing_is_found_whatever_the_sign_of_its_features(channels: int, sign: float) -> None:
    thing = disc(17, 13, 6)
    prior = foreground_prior(scene(thing, channels, contrast=3 * sign))
    assert prior.shape == (ROWS, COLS) and prior.dtype == np.float32
    assert prior.min() == 0 and prior.max() == 1
    assert ((prior > 0.5) == thing).all()


@pytest.mark.parametrize("channels", [16, 200])
def test_it_is_the_first_component_of_a_plain_decomposition(channels: int) -> None:
    features = scene(disc(12, 15, 7), channels, noise=3.0)
    cells = features.reshape(-1, channels).astype(np.float64)
    first = np.linalg.svd(cells - cells.mean(0), full_matrices=False)[2][0]
    projection = (cells @ first).reshape(ROWS, COLS)
    ring = border_cells(ROWS, COLS)
    projection *= -1 if projection[ring].mean() > projection[~ring].mean() else 1
    low, high = np.percentile(projection, [2, 98])
    assert np.abs(foreground_prior(features) - np.clip((projection - low) / (high - low), 0, 1)).max() < 1e-6


def test_shift_and_scale_of_the_features_change_nothing() -> None:
    features = scene(disc(20, 10, 5), 64).astype(np.float64)
    expected = foreground_prior(features)
    assert np.abs(foreground_prior(7 * features - 3) - expected).max() < 1e-5


def test_the_border_is_a_tenth_of_the_shorter_side_wide() -> None:
    ring = border_cells(ROWS, COLS)
    assert ring.sum() == ROWS * COLS - (ROWS - 4) * (COLS - 4) and ring[1].all() and not ring[2, 2]
    assert border_cells(3, 3).sum() == 8
    with pytest.raises(InputError, match="at least 3 x 3 cells, got 2 x 9"):
        border_cells(2, 9)


def test_nothing_stands_out_of_equal_features() -> None:
    assert (foreground_prior(np.full((5, 6, 40), 2.5, np.float32)) == 0).all()
    assert (foreground_prior(np.zeros((5, 6, 8), np.float32)) == 0).all()


def test_features_that_are_not_finite_are_refused() -> None:
    features = scene(disc(20, 10, 5), 16)
    features[3, 4, 5] = np.nan
    with pytest.raises(InputError, match="expected finite features"):
        foreground_prior(features)


def walk(frames: int, channels: int = 64) -> list[tuple[Array, Array]]:
    """A thing that walks through the picture and out of it on one side, covering that border for a while."""
    things = [disc(6 + 0.8 * n, 13, 9) for n in range(frames)]
    return [(thing, scene(thing, channels, seed=n, noise=2.0)) for n, thing in enumerate(things)]


def test_over_a_video_the_sign_holds_where_single_frames_turn() -> None:
    stream, in_video, alone = ForegroundPrior(), [], []
    for thing, features in walk(44):
        in_video.append(_agreement(stream(features), thing))
        alone.append(_agreement(foreground_prior(features), thing))
    assert min(in_video) > 0.9
    assert min(alone) < 0.1, "the thing on the border makes one frame alone take it for background"


def test_a_thing_that_has_left_leaves_no_foreground_behind() -> None:
    stream, channels = ForegroundPrior(), 64
    for n in range(10):
        stream(scene(disc(17, 13, 7), channels, seed=n))
    empty = [scene(np.zeros((ROWS, COLS)), channels, seed=50 + n) for n in range(3)]
    assert max(stream(features).mean() for features in empty) < 0.15
    assert foreground_prior(empty[0]).mean() > 0.3, "one frame alone stretches its noise"


def _agreement(prior: Array, thing: Array) -> float:
    return float(((prior > 0.5) == thing).mean())


def test_a_thing_that_covers_the_border_for_some_frames_does_not_turn_the_sign() -> None:
    stream, channels = ForegroundPrior(), 64
    inner, ring = disc(17, 13, 7), border_cells(ROWS, COLS)
    for n in range(10):
        stream(scene(inner, channels, seed=n))
    covered = ring | inner
    features = scene(covered, channels, seed=99)
    assert _agreement(foreground_prior(features), ~covered) > 0.95, "one frame alone takes the ring for background"
    assert _agreement(stream(features), covered) > 0.95


def test_a_border_that_says_neither_turns_nothing() -> None:
    """Half the picture is one kind, half the other: a few cells of the border, now so, now so, must not decide."""
    half = np.broadcast_to(np.arange(COLS) >= COLS // 2, (ROWS, COLS))
    stream, kept = ForegroundPrior(memory_frames=1), []
    for n in range(8):
        thing = half.copy()
        thing[0, 4:14] |= n % 2 == 1
        thing[0, -14:-4] &= n % 2 == 1
        kept.append(_agreement(stream(scene(thing, 64, seed=n)), thing))
    assert min(kept) > 0.9


def test_a_wrong_start_is_turned_once_the_border_says_so() -> None:
    stream, channels = ForegroundPrior(), 64
    inner = disc(17, 13, 7)
    stream(scene(border_cells(ROWS, COLS), channels))
    agreements = [_agreement(stream(scene(inner, channels, seed=n)), inner) for n in range(12)]
    assert agreements[-1] > 0.95 and sorted(agreements, key=lambda a: a > 0.5) == agreements, "turned once, not back"


def test_two_components_of_like_size_do_not_take_turns() -> None:
    """A thing and a floor vary alike much; noise decides which is first in one frame, memory in a video."""
    channels, rng = 64, np.random.default_rng(5)
    thing = disc(17, 13, 7).astype(np.float64)
    slope = np.linspace(-1, 1, COLS)[None, :] * np.ones((ROWS, 1))
    slope *= thing.std() / slope.std()
    a, b = np.linalg.qr(rng.normal(size=(channels, 2)))[0].T
    stream, last_stream, last_single, moved_stream, moved_single = ForegroundPrior(), None, None, [], []
    for _ in range(40):
        more = rng.normal(0, 0.2)
        features = 3 * ((1 + more) * thing[..., None] * a + (1 - more) * slope[..., None] * b)
        features = features + 0.1 * rng.normal(size=features.shape)
        one, many = foreground_prior(features), stream(features)
        if last_stream is not None and last_single is not None:
            moved_stream.append(np.abs(many - last_stream).mean())
            moved_single.append(np.abs(one - last_single).mean())
        last_stream, last_single = many, one
    assert np.mean(moved_stream[5:]) < 0.5 * np.mean(moved_single[5:])


def test_the_same_frames_give_the_same_prior() -> None:
    frames = [features for _, features in walk(6)]
    first, second = ForegroundPrior(), ForegroundPrior()
    for features in frames:
        assert (first(features) == second(features)).all()
