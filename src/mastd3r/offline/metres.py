"""A map in metres: what it is measured by, from its graph or its run folder, and what run.json says of it."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..export.frame_names import names_by_time
from ..export.read_run import Run
from ..geometry.sim3 import Sim3
from ..graph.focal_sigma import focal_facts
from ..graph.keyframe_graph import KeyframeGraph
from ..metric.material import Material
from ..metric.measure import Measure
from .final_solve import FinalFrame, trajectory_of
from .renders import lens_of
from .tracked import Tracked
from .tracks import static_tracks

Array = NDArray[Any]


def material_of_run(run: Run) -> Material:
    """What a run folder gives to measure its map by. Raises InputError for files that cannot be read."""
    tracks = run.tracks() if os.path.lexists(run.path / "tracks.npz") else None
    camera, world = run.record.get("camera") or {}, run.record.get("world") or {}
    down_sigma_deg = world.get("down_sigma_deg")
    return Material(
        str(run.path),
        run.trajectory,
        tracks,
        None if run.camera is None else lens_of(run),
        camera.get("focal_sigma_ratio") or 0.0,
        None if down_sigma_deg is None else float(np.radians(down_sigma_deg)),
        run.record.get("files") or {},
    )


def material_of_graph(tracked: Tracked, final: list[FinalFrame], record: Mapping[str, Any]) -> Material:
    """The same of a map that is still a graph, without what tracking found to move; ``record``: run.json by now."""
    graph = tracked.graph
    no_color = {k: np.zeros((len(v.px), 3), np.uint8) for k, v in graph.variables.items()}
    moving = {kf.id: 1 - kf.static for kf in graph.keyframes}
    down_sigma_deg = (record.get("world") or {}).get("down_sigma_deg")
    return Material(
        tracked.source.name,
        trajectory_of(final),
        static_tracks(graph, final, no_color, moving, tracked.photograph_px),
        tracked.lens(),
        focal_facts(graph, given=tracked.lens_is_given)["focal_sigma_ratio"] or 0.0,
        None if down_sigma_deg is None else float(np.radians(down_sigma_deg)),
        names_by_time(tracked.source, [(f.record.index, f.record.timestamp_s) for f in final]),
    )


def in_lengths(graph: KeyframeGraph, final: list[FinalFrame], factor: float) -> list[FinalFrame]:
    """The graph, and the frames with it, with lengths times a factor; gives the frames."""
    graph.transform_keyframes(range(len(graph.keyframes)), Sim3(np.eye(3), np.zeros(3), factor))
    poses = trajectory_of(final).in_lengths(factor).world_from_cam
    return [replace(frame, world_from_cam=pose) for frame, pose in zip(final, poses, strict=True)]


def scale_facts(wanted: Measure, map_: Callable[[], Material], record: Mapping[str, Any]) -> dict[str, Any]:
    """The key ``scale`` of run.json: the factor, how sure it is and where from; or why there is none (``refused``).

    ``record`` is run.json by now: where it says that the map has no lengths (a camera that only turns), none is found.
    """
    asked = {"asked": wanted.asked.text, "applied": False}
    said = (record.get("observability") or {}).get("said")
    try:
        if said:
            raise InputError(f"--scale: expected a map with lengths, got one without: {said}")
        scale = wanted.of(map_())
    except InputError as e:
        return {**asked, "refused": str(e)}
    return {**asked, **asdict(scale), "said": scale.said}


def scale_of_run(tracked: Tracked, final: list[FinalFrame], record: Mapping[str, Any]) -> dict[str, Any] | None:
    """``scale_facts`` of a run whose files are all still to be written, hence in metres; None where nobody asked."""
    before = tracked.continues()
    if before is not None and before["found"] and before["unit"] == "m":
        said = f"lengths are those of the map {before['name']}"
        return {"asked": "map", "applied": True, "metres_per_unit": 1.0, "sigma_ratio": None, "said": said}
    if tracked.scale is None:
        return None
    facts = scale_facts(tracked.scale, lambda: material_of_graph(tracked, final, record), record)
    return {**facts, "applied": "metres_per_unit" in facts}


def scale_notes(facts: Mapping[str, Any] | None) -> list[str]:
    """The line for the choices of run.json, of its key ``scale``."""
    return [] if facts is None else [f"scale: {facts.get('said') or facts['refused']}"]
