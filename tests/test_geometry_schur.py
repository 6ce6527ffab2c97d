"""Depths eliminated point by point, against dense algebra."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mastd3r.geometry.anchor_matches import AnchorMatches
from mastd3r.geometry.reprojection_kernels import N_COLS, anchor_system
from mastd3r.geometry.schur_kernels import (
    anchor_part,
    anchor_part_cost,
    depth_steps,
    eliminate,
    local_system,
    moved_depths,
)
from mastd3r.geometry.se3 import adjoint, inverse, se3_exp

Array = NDArray[Any]
QUICK = settings(max_examples=25, deadline=None)
B = 6


class Anchor:
    """Random parts of the system of one anchor keyframe, and the same as dense matrices over all unknowns."""

    def __init__(self, seed: int, edges: int, points: int, seen: float) -> None:
        rng = np.random.default_rng(seed)
        weight = np.where(rng.random((edges, points)) < seen, rng.uniform(0.1, 1, (edges, points)), 0.0)
        self.matches = AnchorMatches.of(rng.normal(size=(edges, points, 2)), weight)
        self.cross = rng.normal(size=(len(self.matches.point), N_COLS)).astype(np.float32)
        root = rng.normal(size=(edges, N_COLS, N_COLS))
        self.hess, self.rhs = root @ root.transpose(0, 2, 1), rng.normal(size=(edges, N_COLS))
        self.to_anchor = rng.normal(size=(edges, B, B))
        self.blocks = np.where(rng.random(edges + 2) < 0.8, np.arange(edges + 2), -1)
        self.free = np.repeat(self.blocks >= 0, B)
        self.hdd, self.bd = rng.uniform(1, 2, points), rng.normal(size=points)
        self.to_local = np.zeros((edges, N_COLS, 2 * B + B * edges))  # an edge's unknowns from all of them
        for e in range(edges):
            self.to_local[e, :B, :B] = self.to_anchor[e]
            self.to_local[e, :B, B + B * e : 2 * B + B * e] = np.eye(B)
            self.to_local[e, B:, -B:] = np.eye(B)
        self.columns = np.zeros((points, 2 * B + B * edges))  # E of all points
        for k, (e, n) in enumerate(zip(self.matches.edge, self.matches.point, strict=True)):
            self.columns[n] += self.cross[k] @ self.to_local[e]


anchors = st.builds(Anchor, st.integers(0, 10**6), st.integers(1, 7), st.integers(1, 20), st.floats(0, 1))


@QUICK
@given(anchors)
def test_matches_are_listed_by_edge_and_by_point(a: Anchor) -> None:
    m = a.matches
    for e in range(len(m.first) - 1):
        of_edge = slice(m.first[e], m.first[e + 1])
        assert (m.edge[of_edge] == e).all() and (np.diff(m.point[of_edge]) > 0).all()
    for n in range(len(a.hdd)):
        rows = m.by_point[m.of_point[n] : m.of_point[n + 1]]
        assert (m.point[rows] == n).all() and (np.diff(m.edge[rows]) > 0).all()
    assert len(m.by_point) == m.of_point[-1] == m.first[-1] == (m.weight > 0).sum()


@QUICK
@given(anchors)
def test_the_system_without_depths_is_the_schur_complement(a: Anchor) -> None:
    hess, rhs = local_system(a.hess, a.rhs, a.to_anchor)
    whole = np.einsum("eri,ers,esj->ij", a.to_local, a.hess, a.to_local)
    np.testing.assert_allclose(hess, whole, atol=1e-9 * np.abs(whole).max())
    np.testing.assert_allclose(rhs, np.einsum("eri,er->i", a.to_local, a.rhs), atol=1e-9)
    right = rhs - a.columns.T @ (a.bd / a.hdd)
    reduced = whole - a.columns.T @ (a.columns / a.hdd[:, None])
    eliminate(hess, rhs, a.cross, a.matches, a.to_anchor, a.blocks, a.hdd, a.bd)
    moves = np.ix_(a.free, a.free)
    np.testing.assert_allclose(hess[moves], reduced[moves], atol=1e-9 * np.abs(whole).max())
    np.testing.assert_allclose(rhs[a.free], right[a.free], atol=1e-9 * np.abs(right).max())


@QUICK
@given(anchors)
def test_depths_follow_from_the_step(a: Anchor) -> None:
    step = np.where(a.free, np.random.default_rng(0).normal(size=a.columns.shape[1]), 0.0)
    found = depth_steps(step.reshape(-1, B), a.cross, a.matches, a.to_anchor, a.blocks, a.hdd, a.bd)
    np.testing.assert_allclose(found, (a.bd - a.columns @ step) / a.hdd, atol=1e-9)


@QUICK
@given(anchors)
def test_a_depth_neither_leaps_nor_passes_infinity_in_one_step(a: Anchor) -> None:
    depth = np.random.default_rng(1).normal(1, 0.5, len(a.hdd))
    still = np.zeros((len(a.blocks), B))
    of = a.cross, a.matches, a.to_anchor, a.blocks, a.hdd, 20 * a.bd
    least = 0.1 * np.abs(depth).mean()
    allowed = np.clip(depth_steps(still, *of), -np.maximum(0.75 * depth, least), 3 * np.abs(depth) + least)
    np.testing.assert_allclose(moved_depths(depth, still, *of, 0.1), depth + allowed)


@QUICK
@given(st.integers(0, 10**6))
def test_an_anchor_keyframe_s_part_is_made_of_what_its_edges_say(seed: int) -> None:
    rng, m, p = np.random.default_rng(seed), 3, 12
    a = Anchor(seed, m, p, 0.7)
    px, depth = rng.uniform(20, 300, (p, 2)), rng.uniform(0.5, 2, p)
    prior, g = rng.uniform(0.5, 2, (2, p)), np.array([np.log(300.0), 0.01, 160, 120, 0, 0])
    poses, ends = np.stack([se3_exp(rng.normal(scale=0.1, size=6)) for _ in range(m + 2)]), rng.permutation(m + 2)[:-1]
    j_from_i = np.stack([poses[k] @ inverse(poses[ends[0]]) for k in ends[1:]])
    to_anchor = -np.stack([adjoint(t) for t in j_from_i])
    h, b, cross, depth_info, bd, cost = anchor_system(px, depth, a.matches, j_from_i, g, 5.0, a.blocks[-1] >= 0)
    hdd, bd = depth_info + prior[1] + 1e-9, bd + prior[1] * (prior[0] - depth)
    hess, rhs = local_system(h, b, to_anchor)
    eliminate(hess, rhs, cross, a.matches, to_anchor, a.blocks, hdd, bd)
    total = cost.sum() + (prior[1] * (depth - prior[0]) ** 2).sum()
    of_edges = px, depth, prior, a.matches, poses, ends
    made = anchor_part(*of_edges, a.blocks, g, 5.0)
    for ours, twin in zip(made, (hess, rhs, cross, to_anchor, hdd, bd, depth_info, total), strict=True):
        np.testing.assert_allclose(ours, twin, rtol=1e-5, atol=1e-7 * np.abs(twin).max())
    np.testing.assert_allclose(anchor_part_cost(*of_edges, g, 5.0), total)
