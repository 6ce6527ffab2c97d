"""``mastd3r localise``: the images of a source found in a saved map, and what is written of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..concurrency import one_blas_thread
from ..config import SourceConfig
from ..errors import InputError
from ..export.export_folder import FolderKind, export_folder
from ..export.frame_names import video_frame_name
from ..export.trajectory_files import write_tum
from ..progress import Reporter
from ..reading.files import is_file
from ..sources import open_source
from ..sources.image_files import IMAGE_SUFFIXES, read_rgb
from ..tracking.localisation import Place, Unplaced
from ..types import Frame, State, Trajectory
from .saved_map import SavedMap

Array = NDArray[Any]
LOCALISED = FolderKind("localised.json", "mastd3r localise", "an earlier localisation")
POSES = "poses.txt"


@dataclass(frozen=True)
class Located:
    """One image, and where it was taken."""

    name: str
    timestamp_s: float
    place: Place | Unplaced
    unit: str  # of the map

    @property
    def said(self) -> str:
        """For people."""
        if isinstance(self.place, Unplaced):
            return f"not found: {self.place.reason}"
        x, y, z = self.place.world_from_cam[:3, 3]
        sigma, turn = self.place.position_sigma, self.place.rotation_sigma_deg
        return f"found at {x:.4f} {y:.4f} {z:.4f}, to {sigma:.4f} {self.unit} and {turn:.2f} deg (1 sigma)"

    def facts(self) -> dict[str, Any]:
        """For localised.json."""
        out: dict[str, Any] = {"name": self.name, "timestamp_s": self.timestamp_s}
        if isinstance(self.place, Unplaced):
            return {**out, "state": "not found", "reason": self.place.reason}
        p = self.place
        return {
            **out,
            "state": "found",
            "world_from_cam": p.world_from_cam,
            "position_sigma": p.position_sigma,
            "rotation_sigma_deg": p.rotation_sigma_deg,
            "inliers": p.inliers,
            "inlier_ratio": p.inlier_ratio,
            "keyframes": p.keyframes,
        }


@one_blas_thread()
def localise_source(
    saved: SavedMap,
    path: Path,
    out: Path,
    window: SourceConfig,
    intrinsics: Sequence[float],
    reporter: Reporter,
) -> list[Located]:
    """Look for every image of ``path`` (an image, a folder, a video, a sequence) in a map; write the folder ``out``.

    It holds poses.txt (TUM, the images that were found) and localised.json (all of them). In a source of several
    images each is looked for from the place of the one before, too. Raises InputError, ConfigError, OutputError;
    nothing half-written stays.
    """
    facts: dict[str, Any] = {
        "map": str(saved.path.resolve()),
        "source": str(path.resolve()),
        "unit": saved.unit,
        "images": [],
    }
    with export_folder(out, facts, [saved.path, path], LOCALISED) as staged:
        located = []
        frames, length = _frames(path, window)
        with reporter.stage("localisation", length, "images") as bar:
            before: Place | None = None
            for name, frame in frames:
                place = saved.localise(frame.image, intrinsics=intrinsics, near=before)
                before = place if isinstance(place, Place) else None
                located.append(Located(name, frame.timestamp_s, place, saved.unit))
                bar.advance()
        if not located:
            raise InputError(f"{path}: expected images, got none")
        facts["images"] = [one.facts() for one in located]
        facts["counts"] = Counter(image["state"] for image in facts["images"])
        found = [(one.timestamp_s, one.place) for one in located if isinstance(one.place, Place)]
        poses = np.array([p.world_from_cam for _, p in found]).reshape(-1, 4, 4)
        times_s = np.array([t for t, _ in found])
        states: list[State] = ["tracked"] * len(found)
        write_tum(staged / POSES, Trajectory(times_s, poses, tuple(states), np.zeros(len(found), bool)))
    return located


def _frames(path: Path, window: SourceConfig) -> tuple[Iterator[tuple[str, Frame]], int | None]:
    """(name, frame) of every image, and how many there are."""
    if is_file(path) and path.suffix.lower() in IMAGE_SUFFIXES:
        return iter([(path.name, Frame(0, 0.0, read_rgb(path)))]), 1
    source = open_source(path, window, want_semantic=False)
    files: dict[int, Path] = getattr(source, "files", {})

    def named() -> Iterator[tuple[str, Frame]]:
        for frame in source.frames():
            file = files.get(frame.index)
            yield video_frame_name(frame.index) if file is None else file.name, frame

    return named(), source.length
