"""Kernels that do for many poses, and blocks of a system, what se3 and dense algebra do for one."""

from __future__ import annotations

import numpy as np
import pytest

from mastd3r.geometry.pose_kernels import add_part, edge_poses, moved_poses, to_anchor_pose
from mastd3r.geometry.se3 import adjoint, inverse, se3_exp

RNG = np.random.default_rng(0)
POSES = np.stack([se3_exp(RNG.normal(size=6)) for _ in range(7)])


def test_poses_of_edges_and_what_leads_to_their_anchor() -> None:
    ends = np.array([4, 0, 6, 4])
    found = edge_poses(POSES, ends)
    twin = np.stack([POSES[k] @ inverse(POSES[4]) for k in ends[1:]])
    np.testing.assert_allclose(found, twin, atol=1e-14)
    np.testing.assert_allclose(to_anchor_pose(found), -np.stack([adjoint(t) for t in twin]), atol=1e-14)


@pytest.mark.parametrize("size", [0.0, 1e-9, 0.9e-3, 1.1e-3, 0.1, 3.0])
def test_poses_move_by_the_step_of_their_block(size: float) -> None:
    block_of = np.array([2, -1, 0, 1, -1, 3, 4])
    step = size * RNG.normal(size=(5, 6))
    found = moved_poses(POSES, block_of, step)
    for k, block in enumerate(block_of):
        twin = POSES[k] if block < 0 else se3_exp(step[block]) @ POSES[k]
        np.testing.assert_allclose(found[k], twin, atol=2e-13)


def test_a_part_goes_to_its_blocks_and_what_is_held_nowhere() -> None:
    hess, rhs = np.ones((24, 24)), np.ones(24)
    blocks, part_h, part_b = np.array([2, -1, 0, 2]), RNG.normal(size=(24, 24)), RNG.normal(size=24)
    to_all = np.zeros((24, 24))
    for n, block in enumerate(blocks):
        if block >= 0:
            to_all[6 * block : 6 * block + 6, 6 * n : 6 * n + 6] = np.eye(6)
    add_part(hess, rhs, blocks, part_h, part_b)
    np.testing.assert_allclose(hess, 1 + to_all @ part_h @ to_all.T)
    np.testing.assert_allclose(rhs, 1 + to_all @ part_b)
