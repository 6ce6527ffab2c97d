"""Which part of a graph is optimised at once: the last keyframes, one keyframe's depths, or everything."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.reprojection_kernels import N_GLOBAL
from .factors import ReprojectionFactor
from .intrinsics import HELD_AT_FIRST, RADIAL, Intrinsics
from .steady_speed import SteadySpeed

if TYPE_CHECKING:
    from .keyframe_graph import KeyframeGraph

Array = NDArray[Any]
ALL_INTRINSICS = frozenset(range(N_GLOBAL))


@dataclass(frozen=True)
class Window:
    """A part of a graph, and what of it stays as it is."""

    ids: Collection[int]  # keyframes, in the order of their rows in the system
    edges: list[ReprojectionFactor]  # between those
    fixed: frozenset[int]  # keyframes whose pose stays
    held: frozenset[int]  # intrinsics that stay, indices into g
    steady: bool = False  # whether a camera's speed that goes on is the likelier where matches do not tell

    def prior_info(self, intrinsics: Intrinsics) -> Array:
        """(6,) information of the intrinsics' priors, inf for those that are held."""
        return np.where(np.isin(np.arange(N_GLOBAL), list(self.held)), np.inf, intrinsics.prior_info)


def sliding(graph: KeyframeGraph) -> tuple[Window, bool]:
    """The last ``window`` keyframes and what they are matched with, which holds them; True where that is all.

    What a saved map sees of them holds them too: its depths are known.
    """
    ids, size = graph.free_members(), graph.config.window
    n, active = len(ids), set(ids[-size:])
    edges = [e for e in graph.edges if e.i in active or (e.i < graph.held and e.j in active)]
    near = active | {k for e in edges for k in (e.i, e.j)}
    whole = len(near) == n and n <= size
    if n <= size and near - active:
        fixed = frozenset(near - active)
    else:
        fixed = frozenset(ids[:1]) if whole else frozenset((near - active) | {min(active)})
    moves = n <= 2 * size or n % 4 == 0
    early = RADIAL if len(graph.keyframes) < graph.config.radial_keyframes else ()
    return Window(sorted(near), edges, fixed, _held(graph, early if moves else ALL_INTRINSICS)), whole


def depths_of(graph: KeyframeGraph, kf_id: int) -> Window:
    """One keyframe's depths, from the edges that it has."""
    edges = [e for e in graph.edges if e.i == kf_id]
    near = sorted({kf_id, *(e.j for e in edges)})
    return Window(near, edges, frozenset(near), ALL_INTRINSICS)


def everything(graph: KeyframeGraph, steady: bool = False) -> Window:
    """Every keyframe; the first of each submap stays, and a saved map."""
    still = frozenset([*graph.roots(), *range(graph.held)])
    return Window(graph.variables.keys(), graph.edges, still, _held(graph, ()), steady)


def in_a_row(graph: KeyframeGraph, window: Window) -> SteadySpeed:
    """What keyframes of a window that follow one another in a submap and a video ask of the camera's speed."""
    inside = set(window.ids) if window.steady else set[int]()
    times_s = {kf.id: kf.work.timestamp_s for kf in graph.keyframes if kf.id in inside and kf.id >= graph.held}
    rows = [(k, k + 1, k + 2) for k in times_s if k + 1 in times_s and k + 2 in times_s]
    alike = [row for row in rows if len({graph.submap_of[k] for k in row}) == 1]
    return SteadySpeed.of(alike, times_s, graph.config.steady_speed * graph.match_variance_px2)


def _held(graph: KeyframeGraph, named: Iterable[int]) -> frozenset[int]:
    """Those named, and those that too few views cannot tell apart."""
    held = HELD_AT_FIRST if len(graph.keyframes) < graph.config.lens_keyframes else ()
    return frozenset(named) | frozenset(held)
