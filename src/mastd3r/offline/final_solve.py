"""After the last frame: the joint optimisation over everything, then every frame's pose and the static cloud."""

from __future__ import annotations

import itertools
import logging
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..alignment.reproject import StaticMatches, solve_pose
from ..concurrency import on_two_threads
from ..config import Config
from ..errors import InputError
from ..geometry.se3 import interpolate, inverse
from ..geometry.sim3 import Sim3
from ..geometry.upright import TOLD_RAD, down, turn_upright
from ..graph.bridging import bridge_submaps
from ..graph.bundle_adjustment import SolveReport
from ..graph.initialisation import MIN_AGREEMENT, bootstrap
from ..graph.intrinsics import RADIAL, without_radial
from ..graph.keyframe_graph import FrameRecord, KeyframeGraph
from ..graph.loose import AGREES_PX, FIRM_SHARE, agreeing_weights, firm_weight
from ..graph.match_noise import learn_match_variance
from ..graph.observability import Observability
from ..graph.radial_terms import radial_is_told
from ..graph.turning import observed, put_at_infinity
from ..types import State, Trajectory

Array = NDArray[Any]
COARSE = ((4.0, 0.15), (1.0, 0.5))  # kernel in pixels before the last, and its share of the iterations
MOST_FIT_PX, CLEARLY = 0.3, 0.8  # kernel by which two minima are told apart, and the share of the cost that is less
LEAP_DEPTHS = 30.0  # typical depths of what is seen, that a camera does not go between two frames
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FinalFrame:
    """One frame at the end of a run."""

    record: FrameRecord
    world_from_cam: Array  # (4, 4); NaN where there is none
    state: State


def finish_graph(graph: KeyframeGraph, config: Config, *, needs_motion: bool = True) -> Observability | None:
    """Start what never started, then optimise everything; what the matches let be known, None where nothing started.

    ``needs_motion``: depth comes from the camera's motion. InputError is raised for one that never moves; where it
    only turns, all points end at infinity and all keyframes at one place. Of several submaps one may do so.
    """
    had_poses = bool(graph.started)
    start = bootstrap(graph) if not had_poses and len(graph.members()) >= 2 else None
    started = had_poses or (start is not None and start.started)
    if not needs_motion and not started:
        return None
    if started and not had_poses:
        learn_match_variance(graph)
    report = _solve(graph, config) if started else None
    seen, _ = observed(graph, graph.members())
    if needs_motion and len(graph.roots()) == 1 and not graph.held:  # in a saved map depth is known
        if seen.kind == "none":
            raise InputError(
                f"the camera never moves: expected one that changes its place, got {seen.still_ratio:.0%} of the "
                f"matches, spread over the whole image, that stay where they are, and things that move by themselves, "
                f"in {len(graph.records)} frames; no depth can be found"
            )
        if seen.kind == "rotation":
            put_at_infinity(graph)
            report = _solve(graph, config)
    if report is None and start is not None and start.agreeing is not None:
        raise InputError(
            f"no structure can be found: expected at least {MIN_AGREEMENT:.0%} of the matches between keyframes to fit "
            f"one camera and one static scene, got {start.agreeing:.0%} between {len(graph.keyframes)} keyframes in "
            f"{len(graph.records)} frames"
        )
    if report is None:
        raise InputError(
            f"the camera never moves enough: expected image motion of at least "
            f"{config.tracking.first_motion_ratio:.0%} of the image with parallax, got "
            f"{len(graph.keyframes)} view(s) apart in {len(graph.records)} frames; no depth can be found"
        )
    for first, last in bridge_submaps(graph):
        log.warning("frames %d to %d were never joined to the rest: placed by continuity", first, last)
    log.info("joint optimisation: %d keyframes, %d edges, %d steps, cost %.0f -> %.0f", len(graph.keyframes),
             len(graph.edges), report.iterations, report.cost_first, report.cost_last)  # fmt: skip
    return seen


def turned_upright(graph: KeyframeGraph) -> tuple[str, dict[str, Any]]:
    """The world with gravity along +y, as viewers of splats expect it of such files; a saved map's stays as it is.

    Gives the line for the choices of run.json, and its key ``world``.
    """
    if graph.held:
        return "world: that of the saved map", {}
    members = graph.members()
    direction, sigma = down(np.stack([graph.world_from_cam(k) for k in members]))
    turn = turn_upright(direction)
    graph.transform_keyframes(range(len(graph.keyframes)), Sim3(turn, np.zeros(3)))
    told = sigma < TOLD_RAD
    note = (
        f"world upright: down is +y, from {'the horizon of' if told else 'the down axes of'} {len(members)} "
        f"keyframes, to {np.degrees(sigma):.0f} deg (1 sigma)"
    )
    return note, {"down_sigma_deg": float(np.degrees(sigma)), "upright_from_first": turn.tolist()}


def _solve(graph: KeyframeGraph, config: Config) -> SolveReport:
    for kernel_px, share in COARSE:
        graph.solve_all(max(int(share * config.graph.final_iterations), 1), kernel_px, steady=True)
    report = graph.solve_all(config.graph.final_iterations, config.graph.kernel_px, steady=True)
    if radial_is_told(graph):
        return report
    log.info("lens: no radial term that the video tells from none, k = %.4f", graph.intrinsics.values[RADIAL[0]])
    graph.set_intrinsics(without_radial(graph.intrinsics))
    return graph.solve_all(config.graph.final_iterations, config.graph.kernel_px, steady=True)


def final_frames(graph: KeyframeGraph) -> list[FinalFrame]:
    """Every frame's pose from its kept matches and the final depths; lost ones between tracked ones interpolated.

    A frame whose matches hardly agree with the pose that they give is a lost one, too, and one that is nowhere near.
    """
    passages = [list(some) for _, some in itertools.groupby(graph.records, lambda r: r.kf_id)]
    out: list[FinalFrame] = []
    for some, poses in zip(passages, on_two_threads(partial(_refined_all, graph), passages), strict=True):
        for record, cam_from_kf in zip(some, poses, strict=True):
            if cam_from_kf is None:
                out.append(FinalFrame(record, np.full((4, 4), np.nan), "lost"))
                continue
            graph.set_record_pose(record, cam_from_kf)
            cam_from_world = cam_from_kf @ graph.variables[record.kf_id].cam_from_world
            out.append(FinalFrame(record, inverse(cam_from_world), record.state))
    return _bridged(_without_leaps(graph, _without_unsupported(graph, out)))


def _refined_all(graph: KeyframeGraph, records: list[FrameRecord]) -> list[Array | None]:
    """Poses from the keyframe that one frame after the other was tracked from; None where a frame is lost."""
    poses: list[Array | None] = []
    guess = np.eye(4)
    for record in records:
        if record.state != "lost":
            guess = np.eye(4) if record.is_keyframe else _refined(graph, record, guess)
        poses.append(guess if record.state != "lost" else None)
    return poses


def _without_unsupported(graph: KeyframeGraph, frames: list[FinalFrame]) -> list[FinalFrame]:
    """Frames as lost whose matches agree with their pose by less than makes a link firm, and than is usual."""
    agreeing = {
        n: _agreeing(graph, f.record)
        for n, f in enumerate(frames)
        if f.state != "lost" and not f.record.is_keyframe and len(f.record.points)
    }
    if not agreeing:
        return frames
    usual = FIRM_SHARE * float(np.median(list(agreeing.values())))
    least = min(usual, firm_weight(agreeing_weights(graph, list(graph.variables))))
    out = list(frames)
    for n in (n for n, weight in agreeing.items() if weight < least):
        log.info("frame %d: next to nothing agrees with its pose, it is lost", out[n].record.index)
        out[n] = replace(out[n], state="lost")
    return out


def _without_leaps(graph: KeyframeGraph, frames: list[FinalFrame]) -> list[FinalFrame]:
    """Frames as lost that lie ``LEAP_DEPTHS`` from those around them: no match tells of such a step.

    Of parts between which the camera leaps the one with most frames stays, and what is near that in time and place.
    """
    placed = np.array([n for n, f in enumerate(frames) if f.state != "lost"])
    if len(placed) < 2:
        return frames
    most = LEAP_DEPTHS / max(float(np.median([graph.median_inv_depth(k) for k in graph.variables])), 1e-12)
    place = np.array([frames[n].world_from_cam[:3, 3] for n in placed])
    part = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1) > most)])
    rest = np.flatnonzero(part == np.argmax(np.bincount(part)))
    out = list(frames)
    for n in set(part.tolist()) - {int(part[rest[0]])}:
        inside = np.flatnonzero(part == n)
        beside = rest[np.argmin(np.abs(rest - inside.mean()))]
        if np.linalg.norm(place[inside] - place[beside], axis=1).min() > most:
            ends = [frames[placed[k]].record.index for k in (inside[0], inside[-1])]
            log.info("frames %d to %d: farther away than a camera can have come, they are lost", *ends)
            for k in placed[inside]:
                out[k] = replace(out[k], state="lost")
    return out


def _refined(graph: KeyframeGraph, record: FrameRecord, guess: Array) -> Array:
    """The pose (4, 4) from the keyframe that the kept matches say.

    Where depths are in doubt there may be two minima: one that fits most matches well, and one that fits a few more of
    them badly, such as those on something that moves. The other is looked for as if depths were known.
    """
    if len(record.points) < 20:
        return guess
    matches = kept_matches(graph, record)
    near = solve_pose(matches, guess, kernel_px=3.0).new_from_ref
    pose = solve_pose(matches, near, kernel_px=1.0).new_from_ref
    known = matches.as_known()
    near = solve_pose(known, guess, kernel_px=3.0).new_from_ref
    near = solve_pose(known, near, kernel_px=1.0).new_from_ref
    other = solve_pose(matches, near, kernel_px=1.0).new_from_ref
    cost, cost_other = (matches.system(p, MOST_FIT_PX)[2] for p in (pose, other))
    return other if cost_other < CLEARLY * cost else pose


def _agreeing(graph: KeyframeGraph, record: FrameRecord) -> float:
    """Weight of a frame's kept matches that are where its pose puts them."""
    matches = kept_matches(graph, record)
    return float(matches.weight[matches.residual_px(record.cam_from_kf) < AGREES_PX].sum())


def kept_matches(graph: KeyframeGraph, record: FrameRecord) -> StaticMatches:
    """The matches that a frame kept of its keyframe, with the keyframe's depths as they are now."""
    v, keep = graph.variables[record.kf_id], record.points
    return StaticMatches(
        v.px[keep],
        v.inv_depth[keep],
        graph.depth_info(record.kf_id)[keep],
        record.target.astype(float),
        record.weight.astype(float),
        graph.intrinsics.values,
    )


def _bridged(frames: list[FinalFrame]) -> list[FinalFrame]:
    """Poses for lost frames: between two tracked ones by interpolation, at the ends by standing still."""
    good = [n for n, f in enumerate(frames) if f.state != "lost"]
    if not good:
        return frames
    out = list(frames)
    for n, f in enumerate(frames):
        if f.state != "lost":
            continue
        before = max((g for g in good if g < n), default=None)
        after = min((g for g in good if g > n), default=None)
        if before is None or after is None:
            nearest = before if before is not None else after
            assert nearest is not None
            pose = frames[nearest].world_from_cam
        else:
            a, b = frames[before], frames[after]
            span = b.record.timestamp_s - a.record.timestamp_s
            ratio = (f.record.timestamp_s - a.record.timestamp_s) / span if span > 0 else 0.5
            pose = interpolate(a.world_from_cam, b.world_from_cam, ratio)
        out[n] = FinalFrame(f.record, pose, "interpolated")
    return out


def trajectory_of(frames: list[FinalFrame]) -> Trajectory:
    """All frames as a trajectory."""
    return Trajectory(
        np.array([f.record.timestamp_s for f in frames]),
        np.stack([f.world_from_cam for f in frames]) + 0.0 if frames else np.zeros((0, 4, 4)),  # no -0 in files
        tuple(f.state for f in frames),
        np.array([f.record.is_keyframe for f in frames], bool),
    )
