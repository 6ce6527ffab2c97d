"""What the image motion of the static scene lets be known: nothing, rotations alone, a plane, or depth.

Pure statistics of matched pixels; of cameras it knows nothing but what rotation alone predicts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[Any]
Kind = Literal["none", "rotation", "plane", "parallax"]
CELLS = (6, 4)  # of the picture, across and down: supports are counted by them
LEAST_IN_CELL = 3  # matches in a cell, for it to have a say; 2 of them that stay, for it to be one that stays
LEAST_MATCHES = 20  # in a pair
NOISE_BOUND = 4.0  # times the noise of a coordinate: a match that is off by less fits
MODEL_ERROR_RATIO = 0.0015  # of sqrt(width * height): what a lens that is not known yet bends
NEARLY = 8.0  # times the same: matches that are asked for the noise
NEIGHBOUR_PX = 12.0  # to the match whose way back is compared
EXPLAINED, PLANE_EXPLAINED = 0.65, 0.9  # share of a pair's matches, and of its cells, that a motion must explain
STILL_MATCHES, STILL_CELLS = 0.1, 0.2  # the same of no motion at all, which has no parameter that could fit by chance
STILL_QUADRANTS = 3  # of the picture that hold such cells: a bonnet or a banner lies in fewer
ALMOST_ALL = 0.8  # of the pairs: where more than the rest say otherwise there is something to see


@dataclass(frozen=True)
class PairMotion:
    """Matches of one pair of views, those that count alone."""

    ref: int  # which view
    new: int
    ref_px: Array  # (n, 2)
    new_px: Array  # (n, 2)
    off_turn_px: Array  # (n, 2) new_px minus where rotation alone would put it


@dataclass(frozen=True)
class Observability:
    """What can be known, and from what that was seen."""

    kind: Kind
    supports: int  # image cells, over all pairs, whose motion rotation alone does not explain
    cells: int  # that had a say
    pairs: int
    noise_px: float  # 1 sigma of a coordinate of a match, from there and back
    still_ratio: float  # share of matches that do not move, median over the pairs
    turn_ratio: float  # share that rotation alone explains
    plane_ratio: float  # share that a homography explains


NOTHING_SEEN = Observability("parallax", 0, 0, 0, float("nan"), 0.0, 0.0, 0.0)


def observability(pairs: Sequence[PairMotion], size: tuple[int, int]) -> Observability:
    """Decide from pairs that are some image motion apart; ``size`` (width, height) of the views.

    A motion explains a pair where it explains most matches in most cells of the picture, so that what moves by itself
    is outvoted; that the camera stands still is believed from less, if it is spread over the picture. A kind needs
    almost all pairs. Without pairs nothing speaks against parallax.
    """
    pairs = [p for p in pairs if len(p.ref_px) >= LEAST_MATCHES]
    if not pairs:
        return NOTHING_SEEN
    moved = [p.new_px - p.ref_px for p in pairs]
    still_px = fit_bound_px(noise_of(pairs, moved, size), size)
    noise_px = noise_of(pairs, [p.off_turn_px for p in pairs], size)
    bound_px = fit_bound_px(noise_px, size)
    still = [_Fit.of(p, np.linalg.norm(m, axis=1) < still_px, size) for p, m in zip(pairs, moved, strict=True)]
    turn = [_Fit.of(p, np.linalg.norm(p.off_turn_px, axis=1) < bound_px, size) for p in pairs]
    plane = [_Fit.of(p, _off_plane_px(p, bound_px) < bound_px, size) for p in pairs]
    kind: Kind = "parallax"
    if np.mean([f.stays for f in still]) >= ALMOST_ALL:
        kind = "none"
    elif np.mean([f.explains(EXPLAINED) for f in turn]) >= ALMOST_ALL:
        kind = "rotation"
    elif np.mean([f.explains(PLANE_EXPLAINED) for f in plane]) >= ALMOST_ALL:
        kind = "plane"
    cells = sum(f.cells for f in turn)
    return Observability(
        kind,
        cells - sum(f.explained_cells for f in turn),
        cells,
        len(pairs),
        noise_px,
        *(float(np.median([f.ratio for f in fits])) for fits in (still, turn, plane)),
    )


def explained_by_turn(pair: PairMotion, noise_px: float, size: tuple[int, int]) -> bool:
    """True where rotation alone explains a pair."""
    fits = np.linalg.norm(pair.off_turn_px, axis=1) < fit_bound_px(noise_px, size)
    return len(fits) >= LEAST_MATCHES and _Fit.of(pair, fits, size).explains(EXPLAINED)


def fit_bound_px(noise_px: float, size: tuple[int, int]) -> float:
    """How far from its prediction a match may lie."""
    return max(NOISE_BOUND * noise_px, MODEL_ERROR_RATIO * float(np.sqrt(size[0] * size[1])))


def noise_of(pairs: Sequence[PairMotion], off_px: Sequence[Array], size: tuple[int, int]) -> float:
    """1 sigma in pixels of a coordinate of a match, from pairs that were matched both ways; 0 where too few are near.

    ``off_px`` (n, 2) a pair is what a motion leaves of its matches. There and, at the match nearest to where it ends,
    back again cancel but for noise: parallax there is the negative of parallax back. Only matches that the motion
    nearly explains are asked, since what parallax changes by from one match to its neighbour is no noise.
    """
    near_px = NEARLY * MODEL_ERROR_RATIO * float(np.sqrt(size[0] * size[1]))
    back = {(p.ref, p.new): (p, off) for p, off in zip(pairs, off_px, strict=True)}
    sums = [np.zeros((0, 2))]
    for p, off in zip(pairs, off_px, strict=True):
        if (p.new, p.ref) not in back:
            continue
        q, off_back = back[p.new, p.ref]
        distance, nearest = (np.asarray(a) for a in cKDTree(q.ref_px).query(p.new_px))
        there_and_back = off_back[nearest]
        near = (distance < NEIGHBOUR_PX) & (np.linalg.norm(off, axis=1) < near_px)
        near &= np.linalg.norm(there_and_back, axis=1) < near_px
        sums.append(off[near] + there_and_back[near])
    left = np.concatenate(sums)
    return 0.0 if len(left) < LEAST_MATCHES else float(1.4826 * np.median(np.abs(left)) / np.sqrt(2))


@dataclass(frozen=True)
class _Fit:
    """How well one motion explains one pair."""

    ratio: float  # of the matches
    cells: int  # that have a say
    explained_cells: int  # in which the most matches fit
    quadrants: int  # in which a cell fits, if only by some of its matches
    some_ratio: float  # of the cells in which some fit

    @staticmethod
    def of(pair: PairMotion, fits: Array, size: tuple[int, int]) -> _Fit:
        cell = np.clip((pair.ref_px + 0.5) / np.array(size) * CELLS, 0, np.array(CELLS) - 1).astype(int)
        n = cell[:, 1] * CELLS[0] + cell[:, 0]
        total = np.bincount(n, minlength=CELLS[0] * CELLS[1])
        good = np.bincount(n[fits], minlength=CELLS[0] * CELLS[1])
        known = total >= LEAST_IN_CELL
        some = good >= LEAST_IN_CELL - 1
        y, x = np.divmod(np.flatnonzero(some), CELLS[0])
        quadrants = len(set(zip(x < CELLS[0] // 2, y < CELLS[1] // 2, strict=True)))
        explained = int((known & (good > 0.5 * total)).sum())
        return _Fit(float(fits.mean()), int(known.sum()), explained, quadrants, float(some.mean()))

    def explains(self, share: float) -> bool:
        """True where it explains that share of the matches, and of the cells."""
        return self.cells > 0 and self.ratio >= share and self.explained_cells >= share * self.cells

    @property
    def stays(self) -> bool:
        """True where enough of the picture, spread over it, fits."""
        spread = self.some_ratio >= STILL_CELLS and self.quadrants >= STILL_QUADRANTS
        return spread and self.ratio >= STILL_MATCHES


def _off_plane_px(pair: PairMotion, bound_px: float) -> Array:
    """(n,) distance of each match from where the best homography puts it; inf without one."""
    h, _ = cv2.findHomography(pair.ref_px, pair.new_px, cv2.USAC_MAGSAC, bound_px)
    if h is None:
        return np.full(len(pair.ref_px), np.inf)
    moved = np.c_[pair.ref_px, np.ones(len(pair.ref_px))] @ h.T
    return np.asarray(np.linalg.norm(moved[:, :2] / moved[:, 2:] - pair.new_px, axis=1))
