"""Outlines by colour: the kernels against plain NumPy, and what densities of colour do to an outline."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mastd3r.dynamics import colours
from mastd3r.dynamics.config import ColoursConfig, DynamicsConfig
from mastd3r.dynamics.data import DynamicsInput
from mastd3r.dynamics.refinement import EdgeRefinement
from test_dynamics_filter import frame, input_of

Array = np.ndarray
H, W = 120, 160
CONFIG = ColoursConfig()
THING = np.s_[40:80, 50:100]


def same(log_odds: Array, lab: Array, scale: float) -> Array:
    """No pooling."""
    return log_odds


def picture(inside: int, outside: int) -> Array:
    """(h, w, 3) RGB of noise; a thing of one hue before another."""
    hsv = np.random.default_rng(0).integers(100, 160, (H, W, 3)).astype(np.uint8)
    hsv[..., 0] = outside
    hsv[..., 0][THING] = inside
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)


def said(box: tuple[slice, slice], sure: float = 2.0) -> Array:
    log_odds = np.full((H, W), -sure, np.float32)
    log_odds[box] = sure
    return log_odds


def iou(log_odds: Array) -> float:
    true = np.zeros((H, W), bool)
    true[THING] = True
    return float((true & (log_odds > 0)).sum() / (true | (log_odds > 0)).sum())


def plain_corners(lab: Array) -> tuple[Array, Array]:
    """(h, w, 8, 3) cells around each colour and (h, w, 8) their linear weights, in float64."""
    at = lab / np.array([colours.CELL_L, colours.CELL_AB, colours.CELL_AB])
    below, step = np.floor(at).astype(int), np.array([[n >> 2, n >> 1 & 1, n & 1] for n in range(8)])
    share = (at - below)[..., None, :]
    return below[..., None, :] + step, np.where(step == 1, share, 1 - share).prod(-1)


def test_both_kernels_are_those_of_a_plain_histogram() -> None:
    rng = np.random.default_rng(1)
    lab = rng.integers(0, 256, (13, 17, 3)).astype(np.uint8)
    lab[0, 0], lab[0, 1] = 255, 0
    moving, still = rng.uniform(0, 1, (2, 13, 17)).astype(np.float32)
    seen = np.zeros((*colours.CELLS, 2), np.float32)
    colours.add_colours(lab, moving, still, seen)
    cells, weights = plain_corners(lab)
    plain = np.zeros(seen.shape)
    for n, values in enumerate((moving, still)):
        np.add.at(plain[..., n], tuple(np.moveaxis(cells, -1, 0)), weights * values[..., None])
    assert seen == pytest.approx(plain, abs=1e-5)
    assert seen.sum((0, 1, 2)) == pytest.approx([moving.sum(), still.sum()], rel=1e-5)
    out = np.empty((13, 17), np.float32)
    colours.colour_ratio(lab, seen, 0.5, -1.0, out)
    found = (plain[tuple(np.moveaxis(cells, -1, 0))] * weights[..., None]).sum(2)
    assert out == pytest.approx(np.log((found[..., 0] + 0.5 * np.exp(-1)) / (found[..., 1] + 0.5)) + 1, abs=1e-4)


@pytest.mark.parametrize("box", [np.s_[36:84, 46:104], np.s_[43:77, 53:97], np.s_[43:83, 54:104]])
def test_an_outline_that_is_off_moves_to_where_colours_change(box: tuple[slice, slice]) -> None:
    before = said(box, 1.0)
    after = colours.by_colours(before, picture(10, 90), CONFIG, same)
    assert iou(before) < 0.8 and iou(after) > 0.9


def test_a_thing_of_the_colours_around_it_stays_as_it_came() -> None:
    before = said(np.s_[34:86, 44:106])
    after = colours.by_colours(before, picture(40, 40), CONFIG, same)
    assert np.mean((before > 0) != (after > 0)) < 0.01


def test_colours_alone_do_not_outweigh_what_surely_moves() -> None:
    """A patch of the wall's own hue on the thing is kept by evidence above the bound, and lost to a higher one."""
    color, patch = picture(10, 90), np.s_[57:63, 72:78]  # without its rim, where pixels are mixed at half size
    color[55:65, 70:80] = color[10:20, 10:20]
    before = said(THING, 2.5)
    assert np.all(colours.by_colours(before, color, CONFIG, same)[patch] > 0)
    assert not np.any(colours.by_colours(before, color, replace(CONFIG, max_still_log_odds=3.5), same)[patch] > 0)


def test_what_is_as_red_farther_off_does_not_begin_to_move() -> None:
    color = picture(10, 90)
    color[5:25, 120:150] = color[45:65, 60:90]
    before = said(THING)
    after = colours.by_colours(before, color, replace(CONFIG, margin_ratio=1.0), same)
    assert not np.any(after[5:25, 120:150] > 0) and np.all(after[5:25, 120:150] <= before[5:25, 120:150])


def test_beside_a_semantic_map_an_outline_only_shrinks() -> None:
    for box in (np.s_[36:84, 46:104], np.s_[43:83, 54:104]):
        before = said(box, 0.7)
        after = colours.by_colours(before, picture(10, 90), CONFIG, same, semantic=True)
        assert not np.any((after > 0) & (before <= 0)) and iou(after) > iou(before) + 0.05


def test_where_nothing_moves_nothing_is_changed() -> None:
    before = said(np.s_[0:2, 0:5])
    assert colours.by_colours(before, picture(10, 90), CONFIG, same) is before


def test_a_mask_that_fills_the_image_stays() -> None:
    before = np.full((H, W), 2.0, np.float32)
    after = colours.by_colours(before, picture(10, 90), CONFIG, same)
    assert np.all(np.isfinite(after)) and np.all(after > 0)


def refined(config: DynamicsConfig, color: Array | None) -> Array:
    given: DynamicsInput = replace(input_of(0, *frame(0, 3.0)[:2]), color=color)
    if color is not None:
        given = replace(given, gray=cv2.cvtColor(color, cv2.COLOR_RGB2GRAY))
    h, w = given.gray.shape
    half = cv2.resize(said(np.s_[34:86, 44:106], 4.0), ((w + 1) // 2, (h + 1) // 2), interpolation=cv2.INTER_AREA)
    return EdgeRefinement(config, w, h).probability(half, given, None, None)


def test_the_refinement_asks_colours_where_there_are_any_and_where_it_is_let() -> None:
    config = DynamicsConfig()
    shape = refined(config, None).shape
    color = cv2.resize(picture(10, 90), shape[::-1], interpolation=cv2.INTER_NEAREST)
    without = replace(config, colours=replace(CONFIG, enabled=False))
    plain = replace(without, refinement=replace(config.refinement, enabled=False))
    assert not np.array_equal(refined(config, color), refined(without, color))
    assert np.array_equal(refined(config, None), refined(without, None))
    off = replace(plain, colours=CONFIG)
    assert np.array_equal(refined(plain, color), refined(off, color))


def test_pooling_reaches_as_far_whatever_part_of_the_image_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    reached: list[float] = []

    def pooled(layers: object, value: Array, weight: object, radius_px: float, edge: float) -> Array:
        reached.append(radius_px)
        return value

    monkeypatch.setattr("mastd3r.dynamics.refinement.region_mean", pooled)
    config = DynamicsConfig()
    for box in (np.s_[30:40, 30:40], np.s_[10:110, 10:150]):
        refinement, color = EdgeRefinement(config, W, H), picture(10, 90)
        colours.by_colours(said(box), color, CONFIG, refinement._inside_edges)
    full = config.refinement.fine_px
    assert reached == [full / 2, full / 2, full] * 2
