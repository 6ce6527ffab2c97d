"""The mask's input of one frame: pose, the depth that the graph expects there, and its 1-sigma."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..dynamics.data import DynamicsInput
from ..geometry.se3 import inverse
from ..graph.depth import carried, upsampled
from ..graph.keyframe_graph import KeyframeGraph
from ..types import WorkFrame

Array = NDArray[Any]


def dynamics_input(
    graph: KeyframeGraph,
    kf_id: int,
    world_from_cam: Array,
    work: WorkFrame,
    scale: float,
    features: Array | None = None,
) -> DynamicsInput:
    """The mask's input of a frame: pose, expected static depth with its 1-sigma, own depth, semantics, features."""
    v, camera = graph.variables[kf_id], graph.camera()
    new_from_ref = inverse(world_from_cam) @ inverse(v.cam_from_world)
    value, confidence = carried(v.px, v.inv_depth, graph.depth_info(kf_id), new_from_ref, camera, work.px)
    sigma = 0.1 * value * np.sqrt(1 / np.maximum(confidence, 1e-4) - 1) + 0.02 * value
    own = None if work.own_inv_depth is None else work.own_inv_depth / np.float32(scale)
    return DynamicsInput(
        work.index,
        work.timestamp_s,
        work.gray,
        camera,
        world_from_cam,
        upsampled(value, work.grid, *graph.size),
        upsampled(sigma, work.grid, *graph.size),
        own,
        work.semantic,
        features=features,
    )
