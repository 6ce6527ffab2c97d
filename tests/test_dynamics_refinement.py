"""The outline that refinement gives to evidence, among textures that show no edge of the thing."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mastd3r.dynamics.config import DynamicsConfig
from mastd3r.dynamics.refinement import EdgeRefinement
from test_dynamics_filter import frame, input_of


def disc_called_moving(width: int, height: int, config: DynamicsConfig | None = None) -> float:
    """Area of the mask / area of a disc that all evidence is sure of, in a picture of noise."""
    gray = np.random.default_rng(0).integers(0, 256, (height, width)).astype(np.uint8)
    gray = cv2.blur(gray, (3, 3))
    given = replace(input_of(0, *frame(0, 3.0)[:2]), gray=gray)
    refinement = EdgeRefinement(config or DynamicsConfig(), width, height)
    radius = height / 7
    y, x = np.mgrid[: refinement.h, : refinement.w]
    disc = np.hypot(2 * x - width / 2, 2 * y - height / 2) < radius
    log_odds = np.where(disc, 6, -6).astype(np.float32)
    moving = refinement.probability(log_odds, given, None, None) > 0.5
    return float(moving.sum() / (np.pi * radius**2))


def test_a_thing_keeps_its_rim_in_small_pictures_as_in_large_ones() -> None:
    assert disc_called_moving(320, 240) == pytest.approx(disc_called_moving(512, 384), abs=0.05)


def test_a_filter_of_so_many_pixels_whatever_the_size_costs_it_its_rim() -> None:
    config = DynamicsConfig()
    wide = replace(config, refinement=replace(config.refinement, edge_px=13))  # 8 px at 320 x 240
    assert disc_called_moving(320, 240, wide) < disc_called_moving(320, 240) - 0.1
