"""The one owner of poses: keyframes, their depths, the lens, the matches between them, and every frame's place."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..config import CameraConfig, GraphConfig
from ..geometry.camera import Camera
from ..geometry.se3 import inverse
from ..types import Matches, State, WorkFrame
from .bundle import Block, Edge, Lens, SolveReport, solve

Array = NDArray[Any]
PRIOR_FOCAL_RATIO, PRIOR_FOCAL_SIGMA = 1.0, 0.25  # focal / sqrt(width * height) of most cameras; 1 sigma of its log
PRIOR_RADIAL_SIGMA = 0.05
PRIOR_GAIN = 10.0  # match errors are alike within a view, so their sum claims too much: the prior is raised instead
KEPT_MATCHES = 600  # matches kept of a frame that is no keyframe, for the final pose


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

    def __init__(self, config: GraphConfig, camera: CameraConfig, lens: Lens) -> None:
        self.config, self.camera_config, self.lens = config, camera, lens
        self.size = (0, 0)
        self.keyframes: list[Keyframe] = []
        self.blocks: dict[int, Block] = {}
        self.edges: list[Edge] = []
        self.records: list[FrameRecord] = []
        self.initialised = False
        self.last_report: SolveReport | None = None

    # -- reading ---------------------------------------------------------------------------------------------

    @property
    def latest(self) -> Keyframe:
        """The newest keyframe."""
        return self.keyframes[-1]

    def camera(self) -> Camera:
        """The lens at working size."""
        return camera_of(self.lens, self.size)

    def world_from_cam(self, kf_id: int) -> Array:
        """(4, 4) pose of a keyframe."""
        return inverse(self.blocks[kf_id].cam_from_world)

    def depth_info(self, kf_id: int) -> Array:
        """(p,) information of a keyframe's inverse depths, prior included."""
        block = self.blocks[kf_id]
        return block.prior_info if len(block.depth_info) == 0 else block.depth_info + block.prior_info

    def median_inv_depth(self, kf_id: int) -> float:
        """Median over the points that have been seen from elsewhere."""
        block = self.blocks[kf_id]
        seen = block.depth_info > 0 if len(block.depth_info) else np.zeros(len(block.inv_depth), bool)
        return float(np.median(block.inv_depth[seen] if seen.sum() > 10 else block.inv_depth))

    # -- writing ---------------------------------------------------------------------------------------------

    def add_keyframe(
        self,
        work: WorkFrame,
        static: Array,
        moving: Array,
        cam_from_world: Array,
        inv_depth: Array,
        prior_info: Array,
    ) -> Keyframe:
        """Store a keyframe with a first pose and first depths (p,); ``prior_info`` is how far those are trusted."""
        kf = Keyframe(len(self.keyframes), work, static, np.rint(255 * moving).astype(np.uint8))
        self.size = (work.gray.shape[1], work.gray.shape[0])
        self.keyframes.append(kf)
        self.blocks[kf.id] = Block(work.px, inv_depth, inv_depth.copy(), prior_info, cam_from_world)
        return kf

    def connect(self, i: int, j: int, matches: Matches, static_new: Array) -> bool:
        """Add matches of i's pixels in j as an edge; False where too few survive the static weight."""
        weight = matches.weight * self.keyframes[i].static * static_new
        if (weight > 0.05).mean() < self.config.min_match_ratio or (weight > 0.05).sum() < 20:
            return False
        self.edges.append(Edge(i, j, matches.new_px, weight))
        return True

    def record(
        self,
        work: WorkFrame,
        kf_id: int,
        cam_from_kf: Array,
        state: State,
        matches: Matches | None,
        weight: Array,
    ) -> FrameRecord:
        """Store a frame's place; its strongest matches are kept for the final pose."""
        keep = np.zeros(0, int)
        if matches is not None:
            strong = np.flatnonzero(weight > 0.05)
            keep = np.sort(strong[np.argsort(-weight[strong], kind="stable")[:KEPT_MATCHES]])
        target = np.zeros((0, 2), np.float32) if matches is None else matches.new_px[keep].astype(np.float32)
        entry = FrameRecord(
            work.index,
            work.timestamp_s,
            kf_id,
            cam_from_kf,
            state,
            keep,
            target,
            weight[keep].astype(np.float32),
        )
        self.records.append(entry)
        return entry

    def replace_last_by_keyframe(self, kf: Keyframe) -> None:
        """The frame recorded last has become keyframe ``kf``."""
        last = self.records[-1]
        self.records[-1] = FrameRecord(
            last.index, last.timestamp_s, kf.id, np.eye(4), last.state, *_nothing(), is_keyframe=True
        )

    def clear(self) -> None:
        """Forget everything but the frames seen, which become lost: the first view could not be followed."""
        self.keyframes, self.edges = [], []
        self.blocks = {}
        for r in self.records:
            r.state, r.is_keyframe, r.kf_id = "lost", False, 0

    # -- optimisation ----------------------------------------------------------------------------------------

    def solve_window(self) -> SolveReport:
        """The last ``window`` keyframes move, everything they are matched with holds them."""
        n, size = len(self.keyframes), self.config.window
        active = set(range(max(0, n - size), n))
        edges = [e for e in self.edges if e.i in active]
        near = active | {e.j for e in edges}
        whole = len(near) == n and n <= size
        fixed = frozenset([0]) if whole else frozenset((near - active) | {min(active)})
        free = self.lens.prior_info if n <= 2 * size or n % 4 == 0 else np.full(4, np.inf)
        if n < self.config.radial_keyframes:  # too little seen to tell k from everything else
            free = np.where(np.arange(4) == 1, np.inf, free)
        lens = Lens(self.lens.g, self.lens.prior, free)
        report = solve(
            {k: self.blocks[k] for k in sorted(near)},
            edges,
            lens,
            fixed=fixed,
            iterations=self.config.window_iterations * (2 if whole else 1),
        )
        self.lens.g = lens.g
        if whole:
            self.normalise()
        return report

    def solve_all(self, iterations: int, kernel_px: float) -> SolveReport:
        """Every keyframe moves but the first."""
        report = solve(
            self.blocks,
            self.edges,
            self.lens,
            fixed=frozenset([0]),
            iterations=iterations,
            kernel_px=kernel_px,
            tolerance=1e-5,
        )
        self.normalise()
        self.last_report = report
        return report

    def normalise(self) -> None:
        """Monocular scale is free: keep the median inverse depth of the first three keyframes at one.

        Where depths are measured (strong priors) the scale is theirs and nothing is done.
        """
        first = [self.blocks[k] for k in sorted(self.blocks)[:3]]
        if any((b.prior_info * b.inv_depth**2 > 100).mean() > 0.1 for b in first):
            return
        m = float(np.median([self.median_inv_depth(k) for k in sorted(self.blocks)[:3]]))
        if not np.isfinite(m) or m <= 0:
            return
        for b in self.blocks.values():
            b.cam_from_world = b.cam_from_world.copy()
            b.cam_from_world[:3, 3] *= m
            b.inv_depth, b.prior_depth = b.inv_depth / m, b.prior_depth / m
            b.prior_info, b.depth_info = b.prior_info * m**2, b.depth_info * m**2
        for r in self.records:
            r.cam_from_kf = r.cam_from_kf.copy()
            r.cam_from_kf[:3, 3] *= m

    def edges_among(self, ids: Iterable[int]) -> list[Edge]:
        """Edges with both ends in ``ids``."""
        inside = set(ids)
        return [e for e in self.edges if e.i in inside and e.j in inside]


def _nothing() -> tuple[Array, Array, Array]:
    return np.zeros(0, int), np.zeros((0, 2), np.float32), np.zeros(0, np.float32)


def camera_of(lens: Lens, size: tuple[int, int]) -> Camera:
    """The camera (width, height) that a lens stands for; its radial term fitted to the undistortion of the solver."""
    f, k = float(np.exp(lens.g[0])), float(lens.g[1])
    return Camera(f, f, float(lens.g[2]), float(lens.g[3]), *size, radial_from_undistortion(f, k, size))


def radial_from_undistortion(focal_px: float, k: float, size: tuple[int, int]) -> float:
    """k1 of x_d = x (1 + k1 x²) that fits x = x_d (1 + k x_d²) best over the image, by least squares in x_d."""
    if k == 0.0:
        return 0.0
    r_d = np.linspace(0.05, 1.0, 40) * 0.5 * np.hypot(*size) / focal_px
    r = r_d * (1 + k * r_d**2)
    return float(((r_d - r) * r**3 * r_d).sum() / (r**6 * r_d).sum())


def undistortion_from_radial(focal_px: float, k1: float, size: tuple[int, int]) -> float:
    """k of x = x_d (1 + k x_d²) that fits x_d = x (1 + k1 x²) best over the image: the inverse of the above."""
    r = np.linspace(0.05, 1.0, 40) * 0.5 * np.hypot(*size) / focal_px
    r_d = r * (1 + k1 * r**2)
    return float(((r - r_d) * r_d**3 * r).sum() / (r_d**6 * r).sum())


def lens_for(camera: CameraConfig, width: int, height: int, full_size: tuple[int, int]) -> Lens:
    """The lens before anything is seen: given intrinsics fixed, otherwise centred with wide priors.

    The optimisation knows one focal length, so fx and fy are joined by their geometric mean.
    """
    if camera.intrinsics:
        fx, fy, cx, cy = camera.intrinsics[:4]
        c = Camera(fx, fy, cx, cy, *full_size).resized(width, height)
        f = float(np.sqrt(c.fx_px * c.fy_px))
        k1 = camera.intrinsics[4] if len(camera.intrinsics) > 4 else 0.0
        k = undistortion_from_radial(f, k1, (width, height))
        g = np.array([np.log(f), k, c.cx_px, c.cy_px])
        return Lens(g, g.copy(), np.full(4, np.inf))
    g = np.array([np.log(PRIOR_FOCAL_RATIO * np.sqrt(width * height)), 0.0, (width - 1) / 2, (height - 1) / 2])
    radial = PRIOR_GAIN / PRIOR_RADIAL_SIGMA**2 if camera.estimate_radial else np.inf
    return Lens(g, g.copy(), np.array([PRIOR_GAIN / PRIOR_FOCAL_SIGMA**2, radial, np.inf, np.inf]))
