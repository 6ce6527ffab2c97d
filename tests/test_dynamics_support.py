"""What floats: depths that nothing holds, on made-up scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from test_dynamics_belief import H, W, frame, given

from mastd3r.dynamics import DynamicsConfig
from mastd3r.dynamics.depth_support import CELL_PX, SURE_LEAP, floating_log_ratio, leap_to_border
from mastd3r.dynamics.refinement import EdgeRefinement

ROWS, COLS = 30, 40


def scene(thing: float) -> np.ndarray:
    """(h, w) inverse depth: a wall at 10, a floor that comes nearer, a thing before the wall above the floor."""
    cells = np.full((ROWS, COLS), 0.1, np.float32)
    cells[15:] = 0.1 + 0.9 * np.linspace(0, 1, ROWS - 15)[:, None] ** 2
    cells[6:16, 10:20] = thing
    return np.kron(cells, np.ones((CELL_PX, CELL_PX), np.float32))


def leap(inv_depth: np.ndarray, sigma_ratio: float = 0.02) -> np.ndarray:
    return leap_to_border(inv_depth, sigma_ratio * inv_depth)


def test_only_a_near_thing_that_nothing_holds_floats_in_any_unit() -> None:
    assert (leap(scene(0.1)) < SURE_LEAP / 2).all()
    for unit in (1.0, 1e-3, 50.0):
        found = leap(unit * scene(0.8)) > SURE_LEAP
        assert found[8:14, 12:18].all() and found.sum() <= 100


def test_a_thing_on_a_leg_a_thing_at_the_border_and_a_hole_do_not_float() -> None:
    on_leg = scene(0.8)
    on_leg[15 * CELL_PX : 28 * CELL_PX, 14 * CELL_PX : 15 * CELL_PX] = 0.8
    at_border = scene(0.1)
    at_border[5 * CELL_PX : 15 * CELL_PX, : 8 * CELL_PX] = 0.8
    for held in (on_leg, at_border, scene(0.01)):
        assert (leap(held) < SURE_LEAP / 2).all()


def test_a_depth_that_nobody_is_sure_of_does_not_float() -> None:
    assert (leap(scene(0.5), 0.9) < SURE_LEAP).all()
    unknown = leap_to_border(scene(0.8), np.full((ROWS * CELL_PX, COLS * CELL_PX), np.inf))
    assert (unknown <= 0).all()


def test_the_log_ratio_is_bounded_and_of_the_image() -> None:
    gray, pose, _ = frame(0, 3.0)
    told, config = given(0, gray, pose), DynamicsConfig(floating_gain=1.5)
    ratio = floating_log_ratio(told, config)
    assert ratio.shape == (H, W) and ratio.min() >= 0 and ratio.max() <= 1.5


def test_a_map_that_shows_nothing_near_is_doubted_and_its_outlines_are_not() -> None:
    outline = EdgeRefinement(DynamicsConfig(), W, H)
    semantic = np.zeros((H, W), np.float32)
    semantic[:, : W // 4] = 1
    told = outline.semantic_log_odds(semantic)
    assert (told[:, : W // 5] > 2.5).all()
    assert (told[:, W // 4 + 1] < -2.5).all()
    assert (told[:, -W // 4 :] > -1.5).all() and (told[:, -W // 4 :] < 0).all()
    old = EdgeRefinement(replace(DynamicsConfig(), semantic_missed=0.02), W, H).semantic_log_odds(semantic)
    assert (old[:, -W // 4 :] < -2.5).all()
