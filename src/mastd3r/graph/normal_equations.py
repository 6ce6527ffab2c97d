"""The normal equations of the joint optimisation, block by block: dense where they are small, else sparse.

A block is the six unknowns of one pose, the last one those of the lens. The keyframes that one anchor keyframe is
matched with are coupled, so a block row has as many blocks as a keyframe has neighbours, however long the video is.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array

from ..geometry.pose_kernels import add_part

Array = NDArray[Any]
BLOCK = 6
DENSE_MOST = 300  # blocks, above: sparse. Below, Cholesky of the whole is faster.


class DenseEquations:
    """H (n, n) and b (n,)."""

    def __init__(self, blocks: int) -> None:
        self._hess, self.rhs = np.zeros((BLOCK * blocks, BLOCK * blocks)), np.zeros(BLOCK * blocks)

    def add(self, blocks: Array, part_h: Array, part_b: Array) -> None:
        """Add parts (6 k, 6 k) and (6 k,), whose rows and columns are those of ``blocks`` (k,); -1: left out."""
        add_part(self._hess, self.rhs, blocks, part_h, part_b)

    def matrix(self) -> Array:
        """H as it is now."""
        return self._hess


class BlockPattern:
    """Which blocks of H there are: every pair within a group."""

    def __init__(self, blocks: int, groups: Iterable[Array]) -> None:
        """``groups``: blocks (k,) that are coupled with one another."""
        keys = [np.add.outer(g.astype(np.int64) * blocks, g).ravel() for g in groups]
        self.keys = np.unique(np.concatenate([np.arange(blocks, dtype=np.int64) * (blocks + 1), *keys]))
        self.blocks = blocks
        self.indices = (self.keys % blocks).astype(np.int32)
        self.indptr = np.searchsorted(self.keys, np.arange(blocks + 1, dtype=np.int64) * blocks).astype(np.int32)

    def slots(self, group: Array) -> Array:
        """(k, k) numbers of the blocks that a group couples."""
        slots: Array = np.searchsorted(self.keys, np.add.outer(group.astype(np.int64) * self.blocks, group))
        return slots


class SparseEquations:
    """The same H, of which only the blocks of a pattern are held, and b."""

    def __init__(self, pattern: BlockPattern) -> None:
        self._pattern = pattern
        self._data, self.rhs = np.zeros((len(pattern.keys), BLOCK, BLOCK)), np.zeros(BLOCK * pattern.blocks)

    def add(self, blocks: Array, part_h: Array, part_b: Array) -> None:
        """See ``DenseEquations.add``; the blocks are within a group of the pattern."""
        k, moves = len(blocks), blocks >= 0
        parts = part_h.reshape(k, BLOCK, k, BLOCK).transpose(0, 2, 1, 3)
        np.add.at(self._data, self._pattern.slots(blocks[moves]), parts[np.ix_(moves, moves)])
        np.add.at(self.rhs.reshape(-1, BLOCK), blocks[moves], part_b.reshape(k, BLOCK)[moves])

    def matrix(self) -> Any:
        """H as it is now, a scipy.sparse array."""
        size = BLOCK * self._pattern.blocks
        return bsr_array((self._data, self._pattern.indices, self._pattern.indptr), shape=(size, size)).tocsc()
