"""Gaps are filled from what is near, and what is known stays."""

from __future__ import annotations

import numpy as np
import pytest

from mastd3r.geometry.inpainting import inpainted_grid


@pytest.mark.parametrize("channels", [0, 2])
def test_known_values_stay_and_a_plane_goes_on_through_a_gap(channels: int) -> None:
    y, x = np.mgrid[0:24, 0:32].astype(np.float32)
    plane = 0.05 * x - 0.02 * y + 3
    values = plane if channels == 0 else np.stack([plane, -plane], -1)
    known = np.ones((24, 32), np.float32)
    known[10:14, 12:17] = 0
    hole = known == 0
    given = np.where((hole if channels == 0 else hole[..., None]), 99.0, values).astype(np.float32)
    found = inpainted_grid(given, known, 0.0)
    assert found.dtype == np.float32 and np.array_equal(found[~hole], values[~hole])
    assert np.abs(found - values)[hole].max() < 0.15


def test_every_channel_is_filled_by_itself() -> None:
    rng = np.random.default_rng(0)
    values, known = rng.normal(size=(12, 16, 2)).astype(np.float32), (rng.random((12, 16)) < 0.4).astype(np.float32)
    both = inpainted_grid(values, known, np.array([1.0, -1.0]))
    for c, everywhere in enumerate((1.0, -1.0)):
        np.testing.assert_allclose(both[..., c], inpainted_grid(values[..., c].copy(), known, everywhere), rtol=1e-5)


def test_where_nothing_is_known_there_is_what_stands_everywhere() -> None:
    values = np.full((8, 8), 7.0, np.float32)
    assert (inpainted_grid(values, np.zeros((8, 8), np.float32), 2.5) == 2.5).all()
    half = inpainted_grid(values, np.full((8, 8), 0.5, np.float32), 0.0)
    np.testing.assert_allclose(half, 7.0, rtol=1e-6)  # half known everywhere: neighbours say the same
