"""``mastd3r run --map``: a saved map that a new video goes on in, as the first keyframes of the graph of its run."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera.opencv_lens import OpenCvLens
from ..camera.pinhole import Camera
from ..camera.rectification import Rectifier
from ..config import Config
from ..errors import ConfigError
from ..geometry.se3 import inverse, transform
from ..graph.intrinsics import of_camera
from ..graph.keyframe_graph import KeyframeGraph
from ..mapping.gaussian_arrays import GaussianArrays
from ..parts import Parts
from ..pointmap.geometric import GeometricPointmaps
from ..registry import AUTO
from ..tracking.map_entry import MAP
from ..types import MEASURED, Source, StaticCloud, View
from .map_drawing import color_of, digest_of, drawn
from .saved_map import SavedMap, add_keyframes, check_shape, describe
from .static_cloud import placed_points
from .tracks import SURE

Array = NDArray[Any]
NOT_FOUND = "not found in the map"


class ExtendedMap:
    """The map of one run: its keyframes stay where they are, the video is found in it or not."""

    def __init__(self, saved: SavedMap) -> None:
        self.saved = saved
        self.record = saved.record  # as the run's camera sees it, once there is a graph

    # -- before the first frame ------------------------------------------------------------------------------

    def options(self, config: Config, source: Source) -> Config:
        """The options of the run, with pointmaps that a map has. Raises ConfigError and InputError for others."""
        if config.pointmaps not in (AUTO, "geometric"):
            raise ConfigError(f"--map: expected --pointmaps geometric, as saved maps are, got {config.pointmaps}")
        if config.mapping.enabled and config.mapping.realtime:
            raise ConfigError("--map: expected a splat that is made after tracking, got --realtime")
        if config.scale:
            unit = "in metres" if self.saved.unit == "m" else "in map units; mastd3r scale measures the run afterwards"
            raise ConfigError(f"--map: expected no --scale, as lengths are those of the map, which are {unit}")
        if not config.camera.intrinsics:
            check_shape(self.saved.camera, source.size, source.name)
        return replace(config, pointmaps="geometric")

    def rectifier(self, source: Source) -> Rectifier | None:
        """What makes photographs of the map's lens pinhole images; None where they are."""
        lens = self.saved.camera
        return Rectifier(lens.resized(*source.size)) if isinstance(lens, OpenCvLens) else None

    def graph(self, config: Config, parts: Parts, rectifier: Rectifier | None, source: Source) -> KeyframeGraph:
        """A graph without keyframes that has the map's lens."""
        lens = self.saved.camera.resized(*source.size) if rectifier is None else rectifier.pinhole
        assert isinstance(lens, Camera)
        parts.notes.append(f"lens: that of the map {self.saved.path.name}")
        return KeyframeGraph(config.graph, of_camera(lens.resized(*parts.provider.size)))

    def begin(self, graph: KeyframeGraph, config: Config, parts: Parts) -> None:
        """The keyframes of the map become those of a graph that has a lens and nothing else; what follows is new.

        Raises ConfigError for parts that a map does not have.
        """
        if not isinstance(parts.provider, GeometricPointmaps):
            raise ConfigError(f"--map: expected geometric pointmaps, as saved maps are, got {parts.provider.name}")
        graph.size = parts.provider.size
        self.record = drawn(self.saved.record, self.saved.eye.camera, graph.camera(), parts.provider)
        add_keyframes(graph, self.record)
        graph.hold()
        graph.start_submap()
        describe(parts, config, graph, self.record)

    # -- what came of it -------------------------------------------------------------------------------------

    def facts(self, graph: KeyframeGraph) -> dict[str, Any]:
        """The key ``continues`` of run.json."""
        name, found = self.saved.path.name, graph.found_at is not None
        in_map = [r for r in graph.records if r.state in MEASURED and graph.submap_of[r.kf_id] == MAP and found]
        if found:
            said = f"in the map {name}: {len(in_map)} of {len(graph.records)} images placed, first found there at frame"
            said += f" {graph.found_at}"
        else:
            said = f"{NOT_FOUND} {name}: the run is in a frame of its own"
        return {
            "map": str(self.saved.path.resolve()),
            "name": name,
            "digest": digest_of(self.saved.record),
            "keyframes": len(self.record.keyframes),
            "unit": self.saved.unit,
            "found": found,
            "placed": len(in_map),
            "first_frame": graph.found_at,
            "said": said,
        }

    def with_points(self, cloud: StaticCloud, graph: KeyframeGraph) -> StaticCloud:
        """The static cloud of a run and the map's own points, where the video was found in it."""
        parts = [cloud]
        for k, kf in enumerate(self.record.keyframes[: graph.held]):
            placed = placed_points(graph, k, 1 - graph.keyframes[k].static)
            keep = placed.keep & (placed.own_confidence > SURE)
            cell = graph.size[0] / graph.keyframes[k].work.grid[1]
            spacing = placed.depth * cell / graph.camera().fx_px
            parts.append(
                StaticCloud(
                    placed.points_world[keep].astype(np.float32),
                    color_of(kf)[keep],
                    placed.confidence[keep].astype(np.float32),
                    spacing[keep].astype(np.float32),
                    np.full(int(keep.sum()), k, np.int32),
                )
            )
        names = ("points_world", "colors", "confidence", "spacing", "kf_id")
        return StaticCloud(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))

    def splat(self, graph: KeyframeGraph) -> GaussianArrays | None:
        """The map's splat, in the frame of the run."""
        return self.saved.gaussians if graph.held else None


def in_view(cloud: StaticCloud, views: list[View]) -> StaticCloud:
    """The points of a cloud that lie before one of the cameras."""
    seen = np.zeros(len(cloud.points_world), bool)
    for view in views:
        points = transform(inverse(view.world_from_cam), cloud.points_world.astype(float))
        front = points[:, 2] > 0
        px = view.camera.project(np.where(front[:, None], points, 1.0))
        seen |= front & (px > -0.5).all(1) & (px < [view.camera.width - 0.5, view.camera.height - 0.5]).all(1)
    names = ("points_world", "colors", "confidence", "spacing", "kf_id")
    return StaticCloud(*(getattr(cloud, name)[seen] for name in names))
