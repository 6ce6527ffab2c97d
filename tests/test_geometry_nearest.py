"""The three nearest points against a search through all."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mastd3r.geometry.nearest_kernels import three_nearest


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(3, 300), st.floats(1, 60))
def test_the_three_nearest_are_those_of_a_search_through_all(seed: int, count: int, bucket: float) -> None:
    """Points lie anywhere, most of them far outside of where is asked."""
    rng = np.random.default_rng(seed)
    points = rng.normal(50, rng.uniform(5, 300), (count, 2))
    at = rng.uniform(0, 100, (40, 2))
    distance, index = three_nearest(points, at, bucket)
    every = np.linalg.norm(points[None] - at[:, None], axis=-1)
    np.testing.assert_allclose(distance, np.sort(every, 1)[:, :3])
    np.testing.assert_allclose(np.take_along_axis(every, index, 1), distance)


def test_two_points_are_too_few() -> None:
    with pytest.raises(ValueError, match="at least 3 points, got 2"):
        three_nearest(np.zeros((2, 2)), np.zeros((1, 2)), 1.0)
