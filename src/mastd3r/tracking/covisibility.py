"""Edges between keyframes that see the same: their matches, found both ways."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray

from ..concurrency import on_two_threads
from ..config import GraphConfig
from ..dynamics.soft_mask import static_at
from ..graph.covisibility import covisible
from ..graph.factors import ReprojectionFactor
from ..graph.keyframe_graph import Keyframe, KeyframeGraph
from ..graph.prediction import rigid_flow
from ..parts import Parts
from ..pointmap.flow_maps import chained_flow, invert_flow
from ..types import Guess
from .two_view import THIN, far_matches, matched_share

Array = NDArray[Any]


ENOUGH_SHARE = 0.7  # of a keyframe's points found elsewhere, summed over edges: so many need no sparse features


class CovisibilityEdges:
    """Makes edges of a graph. Before there are poses, the flows between keyframes are kept as starts of the next."""

    def __init__(self, config: GraphConfig, parts: Parts) -> None:
        self.config, self.parts = config, parts
        self.flows: dict[tuple[int, int], Array] = {}  # between keyframes, before there are poses

    def connect(self, graph: KeyframeGraph, kf: Keyframe, before: int) -> KeyframeGraph:
        """Matches of ``kf`` with the keyframes before ``before`` and older ones that see the same; the window solved.

        ``graph`` has poses; it is returned.
        """
        recent = self.add_recent(graph, kf, before)
        c = self.config
        older = covisible(graph, kf.id, min(recent, default=before), c.covisible, c.loop_overlap_ratio)
        self.parts.provider.expect([(graph.keyframes[k].work, kf.work) for k in older])
        for k in older:
            self.add(graph, k, kf.id)
        graph.solve_window()
        return graph

    def add_recent(self, graph: KeyframeGraph, kf: Keyframe, before: int) -> list[int]:
        """Matches with the ``neighbours`` last keyframes; those but ``before``, with which there are some already."""
        recent = [k for k in graph.free_members()[-2 - self.config.neighbours : -1] if k != before]
        self.parts.provider.expect([(graph.keyframes[k].work, kf.work) for k in (before, *reversed(recent))])
        for k in reversed(recent):
            self.add(graph, k, kf.id)
        self._support(graph, kf, (before, *reversed(recent)))
        return recent

    def add(self, graph: KeyframeGraph, i: int, j: int) -> bool:
        """Edges both ways; False where one fails, or where nothing says how to start."""
        found = self._found(graph, i, j)
        graph.edges += found
        return len(found) == 2

    def add_many(self, graph: KeyframeGraph, pairs: Sequence[tuple[int, int]]) -> int:
        """``add`` of many pairs, in this order; how many have edges both ways. ``graph`` has poses."""

        def search(pair: tuple[int, int]) -> list[ReprojectionFactor]:
            return self._found(graph, *pair)

        side_by_side = self.parts.provider.side_by_side
        found = on_two_threads(search, pairs) if side_by_side else [search(pair) for pair in pairs]
        for edges in found:
            graph.edges += edges
        return sum(len(edges) == 2 for edges in found)

    def add_one_way(self, graph: KeyframeGraph, i: int, j: int, flow: Array) -> bool:
        """The edge of i's pixels in j, searched from ``flow`` (h, w, 2)."""
        edge = self._edge(graph, i, j, flow)
        if edge is not None:
            graph.edges.append(edge)
        return edge is not None

    def _found(self, graph: KeyframeGraph, i: int, j: int) -> list[ReprojectionFactor]:
        """Edges both ways, not yet added; the way back is searched where there is one there."""
        if graph.initialised:
            start, back = rigid_flow(graph, i, j), rigid_flow(graph, j, i)
        elif (i, j - 1) in self.flows and (j - 1, j) in self.flows:
            start = chained_flow(self.flows[i, j - 1], self.flows[j - 1, j])
            back = invert_flow(start)
        else:
            return []
        there = self._edge(graph, i, j, start)
        if there is None:
            return []
        again = self._edge(graph, j, i, back)
        return [there] if again is None else [there, again]

    def _edge(self, graph: KeyframeGraph, i: int, j: int, flow: Array) -> ReprojectionFactor | None:
        ref, new = graph.keyframes[i], graph.keyframes[j]
        guess = Guess(graph.camera(), flow=flow, flow_is_near=graph.initialised)
        pair = self.parts.provider.predict(ref.work, new.work, guess)
        if not graph.initialised:
            self.flows[i, j] = pair.flow
        return graph.edge(i, j, pair.matches, static_at(new.moving / 255.0, pair.matches.new_px))

    # -- where flow finds too little -------------------------------------------------------------------------

    def _support(self, graph: KeyframeGraph, kf: Keyframe, pairs: Sequence[int]) -> None:
        """Edges of a new keyframe from sparse features, nearest first, until enough of it is seen elsewhere."""
        own = {e.j: e for e in graph.edges if e.i == kf.id}
        shares = {k: matched_share(kf, own[k].weight) if k in own else 0.0 for k in pairs}
        for k in pairs:
            if sum(shares.values()) >= ENOUGH_SHARE:
                return
            if shares[k] < THIN:
                self._add_far(graph, k, kf.id)
                shares[k] = max(shares[k], _share(graph, kf.id, k))

    def _add_far(self, graph: KeyframeGraph, i: int, j: int) -> bool:
        """Edges both ways from sparse features, each in the place of one that there is if it weighs more."""
        made = [self._far_edge(graph, *ends) for ends in ((i, j), (j, i))]
        for edge in made:
            if edge is None:
                continue
            at = next((n for n, e in enumerate(graph.edges) if (e.i, e.j) == (edge.i, edge.j)), None)
            if at is None:
                graph.edges.append(edge)
            elif graph.edges[at].weight.sum() < edge.weight.sum():
                graph.edges[at] = edge
        return None not in made

    def _far_edge(self, graph: KeyframeGraph, i: int, j: int) -> ReprojectionFactor | None:
        ref, new = graph.keyframes[i], graph.keyframes[j]
        moving = new.moving / 255.0
        far = far_matches(self.parts, ref, new.work, moving)
        if far is None:
            return None
        pair = self.parts.provider.predict(
            ref.work, new.work, Guess(graph.camera(), flow=far.flow, features=far.features)
        )
        if not graph.initialised:
            self.flows[i, j] = pair.flow
        return graph.edge(i, j, pair.matches, static_at(moving, pair.matches.new_px))


def _share(graph: KeyframeGraph, i: int, j: int) -> float:
    """Share of i's static points that an edge finds in j; 0 without one."""
    edge = next((e for e in graph.edges if (e.i, e.j) == (i, j)), None)
    return 0.0 if edge is None else matched_share(graph.keyframes[i], edge.weight)
