"""The one owner of poses: keyframes, their depths, the intrinsics, the matches between them, every frame's place.

Nothing else writes them (tests/test_graph_writers.py): others ask the graph, by what it is that they want.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera.pinhole import Camera
from ..config import GraphConfig
from ..geometry.se3 import inverse
from ..geometry.sim3 import Sim3
from ..types import USABLE_WEIGHT, Matches, State, WorkFrame
from .bundle_adjustment import SolveReport, solve
from .factors import KeyframeVariables, ReprojectionFactor, no_matches, strongest
from .intrinsics import Intrinsics, believing, camera_of
from .windows import Window, depths_of, everything, in_a_row, sliding

Array = NDArray[Any]


@dataclass(frozen=True)
class Keyframe:
    """A frame that carries structure. It has no pose: the graph has."""

    id: int
    work: WorkFrame
    static: Array  # (p,) P(static) at work.px
    moving: Array  # (h, w) uint8, 255 x P(moving)


@dataclass
class FrameRecord:
    """One frame, stored relative to its keyframe, with the matches that its pose came from."""

    index: int
    timestamp_s: float
    kf_id: int
    cam_from_kf: Array  # (4, 4)
    state: State
    points: Array  # (m,) indices into the keyframe's px
    target: Array  # (m, 2) float32
    weight: Array  # (m,) float32
    is_keyframe: bool = False


class KeyframeGraph:
    """Keyframes and what holds them together. Lengths are map units, pixels are at working size."""

    def __init__(self, config: GraphConfig, intrinsics: Intrinsics) -> None:
        self.config, self.intrinsics = config, intrinsics
        self.size = (0, 0)
        self.keyframes: list[Keyframe] = []
        self.variables: dict[int, KeyframeVariables] = {}
        self.edges: list[ReprojectionFactor] = []
        self.records: list[FrameRecord] = []
        self.submap = 0  # the one being tracked
        self.submap_of: dict[int, int] = {}
        self.started: set[int] = set()  # submaps that have poses and depths
        self.held = 0  # keyframes of a saved map, the first: their poses stay, and their submap is 0
        self.found_at: int | None = None  # frame at which the video was found in that map
        self.last_report: SolveReport | None = None
        self.match_variance_px2 = 1.0  # what a speed that goes on is weighed against
        self.loops: list[tuple[int, int, str]] = []  # two frames that may show one place, and what came of it

    # -- reading ---------------------------------------------------------------------------------------------

    @property
    def latest(self) -> Keyframe:
        """The newest keyframe."""
        return self.keyframes[-1]

    @property
    def initialised(self) -> bool:
        """True where the submap being tracked has poses and depths."""
        return self.submap in self.started

    def members(self, submap: int | None = None) -> list[int]:
        """Keyframes of a submap (of the one being tracked by default), oldest first."""
        wanted = self.submap if submap is None else submap
        return [kf.id for kf in self.keyframes if self.submap_of[kf.id] == wanted]

    def roots(self) -> list[int]:
        """The first keyframe of every submap: they do not move."""
        return sorted({s: k for k, s in sorted(self.submap_of.items(), reverse=True)}.values())

    def free_members(self) -> list[int]:
        """The same as ``members``, without the keyframes of a saved map."""
        return [k for k in self.members() if k >= self.held]

    def camera(self) -> Camera:
        """The camera at working size."""
        return camera_of(self.intrinsics, self.size)

    def world_from_cam(self, kf_id: int) -> Array:
        """(4, 4) pose of a keyframe."""
        return inverse(self.variables[kf_id].cam_from_world)

    def depth_info(self, kf_id: int) -> Array:
        """(p,) information of a keyframe's inverse depths, prior included."""
        v = self.variables[kf_id]
        return v.depth_info + v.prior_info if len(v.depth_info) else v.prior_info

    def median_inv_depth(self, kf_id: int) -> float:
        """Median over the points that have been seen from elsewhere."""
        v = self.variables[kf_id]
        seen = v.depth_info > 0 if len(v.depth_info) else np.zeros(len(v.inv_depth), bool)
        return float(np.median(v.inv_depth[seen] if seen.sum() > 10 else v.inv_depth))

    @property
    def depths_measured(self) -> bool:
        """True where depths have strong priors: the scale is theirs."""
        first = [self.variables[k] for k in sorted(self.variables) if k >= self.held][:3]
        return any((v.prior_info * v.inv_depth**2 > 25).mean() > 0.1 for v in first)

    def connected(self, i: int, j: int) -> bool:
        """True where matches of one in the other are edges."""
        return any({e.i, e.j} == {i, j} for e in self.edges)

    def connected_pairs(self) -> set[frozenset[int]]:
        """All pairs that are ``connected``, for those who ask about many."""
        return {frozenset((e.i, e.j)) for e in self.edges}

    def edges_among(self, ids: Iterable[int]) -> list[ReprojectionFactor]:
        """Edges with both ends in ``ids``."""
        inside = set(ids)
        return [e for e in self.edges if e.i in inside and e.j in inside]

    # -- growing and shrinking -------------------------------------------------------------------------------

    def believe_focal(self, focal_px: float | None) -> None:
        """Start the lens at a focal length that a frame's own points speak of, where a camera may have it."""
        self.intrinsics = believing(self.intrinsics, focal_px, self.size)

    def add_keyframe(
        self, work: WorkFrame, static: Array, moving: Array, cam_from_world: Array, inv_depth: Array, prior_info: Array
    ) -> Keyframe:
        """Store a keyframe with a first pose and first depths (p,); ``prior_info`` (p,) is that of the depths."""
        kf = Keyframe(len(self.keyframes), work, static, np.rint(255 * moving).astype(np.uint8))
        self.size = (work.gray.shape[1], work.gray.shape[0])
        self.keyframes.append(kf)
        self.submap_of[kf.id] = self.submap
        self.variables[kf.id] = KeyframeVariables(work.px, inv_depth, inv_depth.copy(), prior_info, cam_from_world)
        return kf

    def edge(
        self, i: int, j: int, matches: Matches, static_new: Array, *, followed: bool = False
    ) -> ReprojectionFactor | None:
        """Matches of i's pixels in j as an edge, not yet added; None where too few survive the static weight.

        ``followed``: the camera was tracked from i to j. Then few are enough, or the chain would come apart there.
        """
        weight = matches.weight * self.keyframes[i].static * static_new
        least = 0.0 if followed else self.config.min_match_ratio
        if (weight > USABLE_WEIGHT).mean() < least or (weight > USABLE_WEIGHT).sum() < 20:
            return None
        return ReprojectionFactor(i, j, matches.new_px.astype(np.float32), weight.astype(np.float32))

    def connect(self, i: int, j: int, matches: Matches, static_new: Array, *, followed: bool = False) -> bool:
        """Add an ``edge``; False where there is none."""
        edge = self.edge(i, j, matches, static_new, followed=followed)
        if edge is not None:
            self.edges.append(edge)
        return edge is not None

    def record(
        self, work: WorkFrame, kf_id: int, cam_from_kf: Array, state: State, matches: Matches | None, weight: Array
    ) -> FrameRecord:
        """Store a frame's place; its strongest matches are kept for the final pose."""
        kept = no_matches() if matches is None else strongest(matches, weight)
        entry = FrameRecord(work.index, work.timestamp_s, kf_id, cam_from_kf, state, *kept)
        self.records.append(entry)
        return entry

    def place(self, record: FrameRecord, kf_id: int, cam_from_kf: Array, matches: Matches, weight: Array) -> None:
        """A frame that was lost has been found: (4, 4) relative to keyframe ``kf_id``, by ``matches`` with it."""
        record.kf_id, record.cam_from_kf, record.state = kf_id, cam_from_kf, "tracked"
        record.points, record.target, record.weight = strongest(matches, weight)

    def replace_last_by_keyframe(self, kf: Keyframe) -> None:
        """The frame recorded last has become keyframe ``kf``."""
        last = self.records[-1]
        self.records[-1] = FrameRecord(
            last.index, last.timestamp_s, kf.id, np.eye(4), last.state, *no_matches(), is_keyframe=True
        )

    def start_submap(self) -> None:
        """What comes next is not connected to what is there, until it is recognised."""
        self.submap = 1 + max(self.submap_of.values(), default=-1)

    def drop_submap(self, submap: int | None = None) -> None:
        """Forget the keyframes of a submap, by default of the one being tracked; its frames become lost."""
        self.drop_keyframes(self.members(submap))
        self.started.discard(self.submap if submap is None else submap)

    def drop_keyframes(self, ids: Iterable[int]) -> None:
        """Forget keyframes; the frames that hang on them become lost. Those that stay are numbered anew."""
        kept = sorted(set(self.variables) - set(ids))
        new = {k: n for n, k in enumerate(kept)}
        self.keyframes = [replace(self.keyframes[k], id=n) for k, n in new.items()]
        self.edges = [replace(e, i=new[e.i], j=new[e.j]) for e in self.edges if e.i in new and e.j in new]
        self.variables = {n: self.variables[k] for k, n in new.items()}
        self.submap_of = {n: self.submap_of[k] for k, n in new.items()}
        for r in self.records:
            if r.kf_id not in new:
                r.state, r.is_keyframe, (r.points, r.target, r.weight) = "lost", False, no_matches()
            r.kf_id = max(int(np.searchsorted(kept, r.kf_id, "right")) - 1, 0)

    def separate(self, ids: Iterable[int]) -> None:
        """Some keyframes of a submap become one of their own, started as it was."""
        new = 1 + max(self.submap_of.values())
        self.submap_of.update(dict.fromkeys(ids, new))
        self.started.add(new)

    def part(self) -> KeyframeGraph:
        """The submap being tracked as a graph by itself, sharing keyframes, variables, edges and records."""
        ids = set(self.members())
        out = KeyframeGraph(self.config, self.intrinsics)
        out.size, out.submap = self.size, self.submap
        out.keyframes = [kf for kf in self.keyframes if kf.id in ids]
        out.variables = {k: self.variables[k] for k in sorted(ids)}
        out.submap_of = dict.fromkeys(sorted(ids), self.submap)
        out.edges = self.edges_among(ids)
        out.records = [r for r in self.records if r.kf_id in ids]
        return out

    def aside(self) -> KeyframeGraph:
        """A copy to which edges may be added, and whose window may be solved, while this one is read."""
        out = copy.copy(self)
        out.keyframes, out.edges, out.records = list(self.keyframes), list(self.edges), []
        out.variables = {k: copy.copy(v) for k, v in self.variables.items()}
        return out

    def take(self, aside: KeyframeGraph) -> None:
        """Edges, poses, depths and intrinsics of a copy; nothing may have been added here since."""
        if len(aside.keyframes) != len(self.keyframes):
            raise ValueError(f"take: expected a copy of {len(self.keyframes)} keyframes, got {len(aside.keyframes)}")
        self.edges, self.variables, self.intrinsics = aside.edges, aside.variables, aside.intrinsics

    def hold(self) -> None:
        """The keyframes that are there are those of a saved map."""
        self.held = len(self.keyframes)
        self.started.add(self.submap)

    def found_in_map(self, index: int) -> None:
        """The video has been found in the saved map, at this frame for the first time."""
        self.found_at = index if self.found_at is None else self.found_at

    def leave_map_unless_found(self) -> None:
        """Without the saved map, where nothing was found in it: as if it had never been there, but for the lens."""
        gone, self.held = self.held, self.held if self.found_at is not None else 0
        if self.held == gone:
            return
        self.keyframes = [replace(kf, id=kf.id - gone) for kf in self.keyframes[gone:]]
        self.variables = {k - gone: v for k, v in self.variables.items() if k >= gone}
        self.submap_of = {k - gone: s for k, s in self.submap_of.items() if k >= gone}
        self.edges = [replace(e, i=e.i - gone, j=e.j - gone) for e in self.edges if min(e.i, e.j) >= gone]
        for r in self.records:
            r.kf_id = max(r.kf_id - gone, 0)
        self.started.discard(0)

    def become(self, other: KeyframeGraph) -> None:
        """Hold what another graph holds: one that was written down earlier."""
        vars(self).update(vars(other))

    # -- poses, depths, intrinsics, weights ------------------------------------------------------------------

    def set_intrinsics(self, intrinsics: Intrinsics) -> None:
        """Other intrinsics, or other priors of them."""
        self.intrinsics = intrinsics

    def set_keyframe_pose(self, kf_id: int, cam_from_world: Array) -> None:
        """Place a keyframe, (4, 4); the frames that hang on it come with it."""
        self.variables[kf_id].cam_from_world = cam_from_world

    def set_depths(self, kf_id: int, inv_depth: Array) -> None:
        """Inverse depths (p,) of a keyframe's points; the prior, and what matches said of them, stay."""
        self.variables[kf_id].inv_depth = inv_depth

    def hold_depths(self, kf_id: int, info: Array) -> None:
        """A keyframe's present depths become their own prior, with information ``info`` (p,)."""
        v = self.variables[kf_id]
        v.prior_depth, v.prior_info = v.inv_depth.copy(), info

    def forget_matched_depths(self, kf_id: int) -> None:
        """What matches said of a keyframe's depths counts no more."""
        self.variables[kf_id].depth_info = np.zeros(0)

    def set_record_pose(self, record: FrameRecord, cam_from_kf: Array) -> None:
        """Place a frame, (4, 4) relative to its keyframe."""
        record.cam_from_kf = cam_from_kf

    def set_record_state(self, record: FrameRecord, state: State) -> None:
        """How a frame came by its pose."""
        record.state = state

    def set_weights(self, matches: ReprojectionFactor | FrameRecord, weight: Array) -> None:
        """What the matches of an edge, or of a frame, count: (p,), or (m,) of those that were kept."""
        matches.weight = weight

    def transform_keyframes(self, ids: Iterable[int], new_from_old: Sim3) -> None:
        """Bring some keyframes, and the frames that hang on them, into another world."""
        chosen, old_from_new = set(ids), inverse(new_from_old.rigid)
        self.scale_keyframes(chosen, new_from_old.scale)
        for k in chosen:
            self.set_keyframe_pose(k, self.variables[k].cam_from_world @ old_from_new)

    def scale_keyframes(self, ids: Iterable[int], factor: float) -> None:
        """Lengths of some keyframes, and of the frames that hang on them, times ``factor``: about the origin."""
        chosen = set(ids)
        for k in chosen:
            v = self.variables[k]
            v.cam_from_world = v.cam_from_world.copy()
            v.cam_from_world[:3, 3] *= factor
            v.inv_depth, v.prior_depth = v.inv_depth / factor, v.prior_depth / factor
            v.prior_info, v.depth_info = v.prior_info * factor**2, v.depth_info * factor**2
        for r in self.records:
            if r.kf_id in chosen:
                r.cam_from_kf = r.cam_from_kf.copy()
                r.cam_from_kf[:3, 3] *= factor

    def normalise(self) -> None:
        """Monocular scale is free: keep the median inverse depth of the first three keyframes at one.

        Where depths are measured (strong priors), or in a saved map, the scale is theirs and nothing is done.
        """
        if self.held or self.depths_measured:
            return
        m = float(np.median([self.median_inv_depth(k) for k in sorted(self.variables)[:3]]))
        if not np.isfinite(m) or m <= 0:
            return
        self.scale_keyframes(self.variables, m)

    def discount_points(self, kf_id: int, static: Array) -> None:
        """Later evidence on a keyframe's points, (p,) P(static): it lowers what they and their surroundings count.

        The matches of these points that frames keep count for less as well.
        """
        kf = self.keyframes[kf_id]
        np.minimum(kf.static, static, out=kf.static)
        half = round(np.sqrt(kf.moving.size / len(kf.work.px)) / 2)
        for n in np.flatnonzero(static < 0.5):
            x, y = np.rint(kf.work.px[n]).astype(int)
            cell = kf.moving[max(y - half, 0) : y + half, max(x - half, 0) : x + half]
            np.maximum(cell, np.uint8(255 * (1 - static[n])), out=cell)
        for r in self.records:
            if r.kf_id == kf_id:
                r.weight = (r.weight * static[r.points]).astype(np.float32)

    # -- optimisation ----------------------------------------------------------------------------------------

    def optimise(
        self, problem: Window, iterations: int, kernel_px: float = 1.0, tolerance: float = 1e-4
    ) -> SolveReport:
        """Joint optimisation of a part of the graph; see ``bundle_adjustment.solve``."""
        intrinsics = replace(self.intrinsics, prior_info=problem.prior_info(self.intrinsics))
        report = solve(
            {k: self.variables[k] for k in problem.ids},
            problem.edges,
            intrinsics,
            fixed=problem.fixed,
            iterations=iterations,
            kernel_px=kernel_px,
            tolerance=tolerance,
            speed=in_a_row(self, problem),
        )
        self.intrinsics = replace(self.intrinsics, values=intrinsics.values)
        return report

    def solve_window(self) -> SolveReport:
        """The last ``window`` keyframes move, everything they are matched with holds them."""
        window, whole = sliding(self)
        report = self.optimise(window, self.config.window_iterations * (2 if whole else 1))
        if whole and self.submap == 0:
            self.normalise()
        return report

    def solve_depths(self, kf_id: int, iterations: int = 3) -> None:
        """The depths of one keyframe from the edges that it has; poses and intrinsics stay."""
        self.optimise(depths_of(self, kf_id), iterations)

    @property
    def window_is_all(self) -> bool:
        """True while the sliding window holds every keyframe of the submap being tracked."""
        return len(self.free_members()) <= self.config.window

    def solve_all(self, iterations: int, kernel_px: float, steady: bool = False) -> SolveReport:
        """Every keyframe moves but the first of each submap."""
        report = self.optimise(everything(self, steady), iterations, kernel_px, tolerance=1e-5)
        self.normalise()
        self.last_report = report
        return report
