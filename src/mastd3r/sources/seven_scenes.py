"""7-Scenes: a folder ``seq-NN`` with frame-NNNNNN.color.png, .depth.png and .pose.txt.

Shotton et al., "Scene coordinate regression forests for camera relocalization in RGB-D images", CVPR 2013, and the
dataset's page: depth in millimetres, 65535 where nothing was measured; a pose file is the (4, 4) matrix from camera to
world, from KinectFusion. No times: 30 frames a second assumed.

Depth and colour are NOT registered, and the poses are those of the depth camera, whose intrinsics alone are published
(585 px, centre 320, 240). The colour camera stands about 2.5 cm beside it and has a wider view (a Kinect's default is
525 px). So depth is handed out as it is, with a note, and there is no calibration for ``--intrinsics dataset``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import InputError
from ..reading.files import is_file
from .sequence import ASSUMED_FPS, Listed, Sequenced, numbered, read_numbers, rigid, truth_or_note

KIND = "7scenes"
EXPECTED = "7-Scenes (frame-000000.color.png, .pose.txt, .depth.png ...)"
NO_DEPTH = 65535
CAVEAT = (
    "depth is not registered to colour: its camera stands about 2.5 cm beside and sees less; poses are the depth "
    "camera's, and the colour camera has no published intrinsics"
)


def looks_like(folder: Path) -> str | None:
    """What makes a folder a sequence of 7-Scenes, or None."""
    first = next(folder.glob("frame-*.color.png"), None)
    return f"{first.name} and its like are there" if first is not None else None


def find(folder: Path) -> Sequenced:
    """Frames with depth where it is there, and poses. Raises InputError."""
    images = numbered(folder, "frame-", ".color.png", "images")
    stems = {i: path.name.removesuffix(".color.png") for i, path in images.items()}
    poses = [folder / f"{stem}.pose.txt" for stem in stems.values()]
    depths = [folder / f"{stem}.depth.png" for stem in stems.values()]
    times = np.array(list(images)) / ASSUMED_FPS
    notes = [f"no times: {ASSUMED_FPS:g} frames a second assumed", CAVEAT]
    true_times, matrices = truth_or_note(lambda: _truth(poses, times), notes)
    frames = [
        Listed(float(t), image, depth if is_file(depth) else None)
        for t, image, depth in zip(times, images.values(), depths, strict=True)
    ]
    return Sequenced(
        KIND,
        _name(folder),
        frames,
        f"{len(frames)} frames, {len(matrices)} with a pose, {sum(f.depth is not None for f in frames)} with depth",
        true_times,
        matrices,
        units_per_metre=1000.0,
        no_depth=NO_DEPTH,
        notes=notes,
    )


def _truth(files: list[Path], times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    known = [is_file(p) for p in files]
    if not any(known):
        return np.empty(0), np.empty((0, 4, 4))
    if not all(known):
        raise InputError(f"{files[known.index(False)]}: expected a pose as its neighbours have, got no such file")
    return times, np.stack([_pose(p) for p in files])


def _pose(path: Path) -> np.ndarray:
    """(4, 4) of one file."""
    matrix = read_numbers(path, 4, "a row of a (4, 4) matrix")
    if matrix.shape != (4, 4):
        raise InputError(f"{path}: expected 4 lines of 4 numbers, got {len(matrix)} lines")
    return rigid(matrix, str(path))


def _name(folder: Path) -> str:
    """chess/seq-01: the number alone says little."""
    here = folder.resolve()
    return f"{here.parent.name}/{here.name}"
