"""Equations (1)-(4): what each of them means, on cases small enough to work out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from mastd3r.dynamics import paper


def test_local_log_variance_of_a_step_is_that_of_its_two_halves() -> None:
    log_depth = np.zeros((9, 9))
    log_depth[:, 5:] = 0.6
    variance = paper.local_log_variance(log_depth, np.ones((9, 9), bool), 3)
    # a 3x3 window over the edge holds 6 zeros and 3 times 0.6: 0.6^2 · (1/3)(2/3)
    assert variance[4, 4] == pytest.approx(0.36 * 2 / 9, abs=1e-6)
    assert variance[4, 1] == pytest.approx(0, abs=1e-9)


def test_eq_1_marks_depth_edges_and_far_off_depths_whatever_the_unit() -> None:
    depth = np.full((40, 40), 2.0)
    depth[:, 20:] = 2.02  # 1 %: below tau_var
    depth[10:14, 5:9] = 6.0
    once = paper.depth_anomaly(depth, 3, 0.01, 2.5)
    assert once[11:13, 6:8].all()  # |log Z - mu| > k sigma in the middle of the small thing
    assert once[9, 6]  # and the edge beside it by its local variance
    assert not once[25:, :].any()
    np.testing.assert_array_equal(once, paper.depth_anomaly(1000 * depth, 3, 0.01, 2.5))


def test_eq_1_says_nothing_where_there_is_no_depth() -> None:
    depth = np.zeros((12, 12))
    assert not paper.depth_anomaly(depth, 3, 0.01, 2.5).any()
    depth[:, :6] = 3.0
    assert not paper.depth_anomaly(depth, 3, 0.01, 2.5).any()  # missing depth is no edge


def test_eq_2_in_log_odds_is_bayes_rule() -> None:
    prior, moving, static = np.array([0.2]), np.array([0.9]), np.array([0.3])
    bayes = 0.9 * 0.2 / (0.9 * 0.2 + 0.3 * 0.8)
    log_odds = paper.posterior_log_odds(prior, moving, static)
    assert 1 / (1 + np.exp(-log_odds[0])) == pytest.approx(bayes)
    even = paper.posterior_log_odds(prior, moving, moving)
    assert 1 / (1 + np.exp(-even[0])) == pytest.approx(0.2)  # equal likelihoods leave the prior


def test_eq_3_thresholds_the_probability() -> None:
    p = np.array([0.29, 0.31, 0.69, 0.71])
    log_odds = np.log(p / (1 - p))
    assert paper.moving_mask(log_odds, 0.3).tolist() == [False, True, True, True]
    assert paper.moving_mask(log_odds, 0.7).tolist() == [False, False, False, True]


def test_eq_4_keeps_only_what_both_masks_say() -> None:
    a, b = np.array([True, True, False, False]), np.array([True, False, True, False])
    assert paper.coarse_mask(a, b).tolist() == [True, False, False, False]


def test_depth_likelihoods_are_even_where_depth_is_unknown() -> None:
    depth = np.concatenate([[0.0], np.linspace(1.0, 1.3, 30), [9.0]])[None]
    moving, static = paper.depth_likelihoods(depth)
    assert moving[0, 0] == static[0, 0]
    assert moving[0, -1] > static[0, -1]  # the one far off
    assert static[0, 15] > moving[0, 15]
