"""What floats: depths that nothing holds, on made-up scenes."""

from __future__ import annotations

import numpy as np

from mastd3r.dynamics.config import DynamicsConfig, SemanticConfig, SupportConfig
from mastd3r.dynamics.depth_support import CELL_PX, SURE_LEAP, floating_log_ratio, leap_to_border
from mastd3r.dynamics.refinement import EdgeRefinement
from test_dynamics_filter import H, W, frame, input_of

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
    config = DynamicsConfig(support=SupportConfig(floating_gain=1.5))
    ratio = floating_log_ratio(input_of(0, gray, pose), config)
    assert ratio.shape == (H, W) and ratio.min() >= 0 and ratio.max() <= 1.5


def test_a_map_that_shows_nothing_near_may_be_wrong_and_its_edges_are_right() -> None:
    refinement = EdgeRefinement(DynamicsConfig(), W, H)
    semantic = np.zeros((H, W), np.float32)
    semantic[:, : W // 4] = 1
    log_odds = refinement.semantic_log_odds(semantic)
    assert (log_odds[:, : W // 5] > 2.5).all()
    assert (log_odds[:, W // 4 + 1] < -2.5).all()
    assert (log_odds[:, -W // 4 :] > -1.5).all() and (log_odds[:, -W // 4 :] < 0).all()
    believed = EdgeRefinement(DynamicsConfig(semantic=SemanticConfig(missed=0.02)), W, H).semantic_log_odds(semantic)
    assert (believed[:, -W // 4 :] < -2.5).all()
