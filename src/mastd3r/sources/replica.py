"""Replica as rendered for iMAP and published with NICE-SLAM: results/frameNNNNNN.jpg, depthNNNNNN.png, traj.txt.

Straub et al., "The Replica dataset", 2019; Zhu et al., "NICE-SLAM", CVPR 2022. A line of traj.txt is the (4, 4) matrix
from camera to world, 16 numbers row by row, OpenCV axes (NICE-SLAM's loader turns y and z over because its own cameras
look backwards). cam_params.json, in the scene's folder or beside it: w h fx fy cx cy and scale, the units of a depth
file a metre (6553.5). No times: 30 frames a second assumed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import InputError
from ..reading.files import is_dir, is_file, short, whole_json
from .sequence import ASSUMED_FPS, Listed, Sequenced, numbered, read_numbers, rigid_all, truth_or_note, without_gaps

KIND = "replica"
EXPECTED = "Replica (results/frame000000.jpg, results/depth000000.png ..., traj.txt; cam_params.json beside the scene)"
KEYS = ("w", "h", "fx", "fy", "cx", "cy", "scale")


def looks_like(folder: Path) -> str | None:
    """What makes a folder a scene of Replica, or None."""
    if not is_dir(folder / "results"):
        return None
    first = next((folder / "results").glob("frame*.jpg"), None)
    return f"results/{first.name} and its like are there" if first is not None else None


def find(folder: Path) -> Sequenced:
    """Frames with depth, poses and lens. Raises InputError."""
    results = folder / "results"
    found = numbered(results, "frame", ".jpg", "images")
    images = without_gaps(found, len(found), "images", results)
    depths = [results / image.name.replace("frame", "depth", 1).replace(".jpg", ".png") for image in images]
    times = np.arange(len(images)) / ASSUMED_FPS
    notes = [f"no times: {ASSUMED_FPS:g} frames a second assumed"]
    true_times, poses = truth_or_note(lambda: _truth(folder / "traj.txt", times), notes)
    file, camera = _camera(folder)
    frames = [
        Listed(float(t), image, depth if is_file(depth) else None)
        for t, image, depth in zip(times, images, depths, strict=True)
    ]
    return Sequenced(
        KIND,
        folder.resolve().name,
        frames,
        f"{len(frames)} frames, {sum(f.depth is not None for f in frames)} with depth; lens of {file.name}",
        true_times,
        poses,
        tuple(camera[k] for k in ("fx", "fy", "cx", "cy")),
        (int(camera["w"]), int(camera["h"])),
        units_per_metre=camera["scale"],
        notes=notes,
    )


def _truth(file: Path, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    poses = rigid_all(read_numbers(file, 16, "a (4, 4) matrix"), file)
    if len(poses) != len(times):
        raise InputError(f"{file}: expected {len(times)} poses, one an image, got {len(poses)}")
    return times, poses


def _camera(folder: Path) -> tuple[Path, dict[str, float]]:
    """cam_params.json of the scene or of all scenes."""
    here = folder.resolve()
    file = next((p for p in (here / "cam_params.json", here.parent / "cam_params.json") if is_file(p)), None)
    if file is None:
        raise InputError(f"{folder}: expected cam_params.json in the folder or beside it, got none")
    try:
        camera = whole_json(file)["camera"]
        numbers = {k: float(camera[k]) for k in KEYS}
    except (ValueError, LookupError, TypeError, OverflowError) as e:
        raise InputError(f"{file}: expected 'camera' with {', '.join(KEYS)}, got {type(e).__name__} {e}") from e
    if not all(np.isfinite(v) for v in numbers.values()) or min(numbers[k] for k in ("fx", "fy", "scale")) <= 0:
        raise InputError(f"{file}: expected fx, fy and scale above 0, got {short(repr(camera))}")
    return file, numbers
