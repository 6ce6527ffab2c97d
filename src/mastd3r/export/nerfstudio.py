"""nerfstudio's transforms.json: one lens, a pose an image, OpenGL camera axes (x right, y up, looking along -z)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera.opencv_lens import OpenCvLens
from ..camera.pinhole import Camera
from .lens_models import nerfstudio_lens

Array = NDArray[Any]
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # camera axes


def transforms(lens: Camera | OpenCvLens, names: Sequence[str], world_from_cam: Array, cloud: str) -> dict[str, Any]:
    """The content of transforms.json for images/NAME with masks/NAME.png, poses (n, 4, 4) with OpenCV's axes.

    ``cloud``: the start cloud's file, in the same world. Raises InputError as ``nerfstudio_lens``.
    """
    frames = [
        {
            "file_path": f"images/{name}",
            "mask_path": f"masks/{name}.png",
            "transform_matrix": (pose @ OPENCV_FROM_OPENGL + 0.0).tolist(),  # + 0.0: no "-0"
        }
        for name, pose in zip(names, world_from_cam, strict=True)
    ]
    return {**nerfstudio_lens(lens), "ply_file_path": cloud, "frames": frames}
