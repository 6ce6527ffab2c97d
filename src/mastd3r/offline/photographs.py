"""The photographs of a run that has ended, read again from where they are, each with its name and pose."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.opencv_lens import OpenCvLens
from ..camera.pinhole import Camera
from ..errors import InputError, OutputError
from ..export.files import write_bytes, writing
from ..export.frame_names import names_below, video_frame_name
from ..export.read_run import Run
from ..export.run_folder import stamp
from ..reading.files import whole_bytes
from ..sources.image_files import stored_as_read
from ..types import Source, Trajectory

Array = NDArray[Any]
log = logging.getLogger(__name__)
JPEG_QUALITY = 95
WRITTEN_AS_THEY_ARE = (".png", ".jpg", ".jpeg")  # others, such as WebP, become PNG: COLMAP does not read them


@dataclass(frozen=True)
class Photograph:
    """One photograph of a run."""

    name: str  # below the folder of images, with forward slashes
    timestamp_s: float
    image: Array  # (h, w, 3) uint8 RGB
    world_from_cam: Array  # (4, 4)
    file: Path | None  # where exactly these pixels are stored; None where reading changed them, and for a video


def check_size(run: Run, source: Source, lens: Camera | OpenCvLens) -> None:
    """Raise InputError for a source whose images are not of the size that the run's lens is for."""
    if source.size != (lens.width, lens.height):
        raise InputError(
            f"{source.name}: expected photographs of {lens.width}x{lens.height}, as the run in {run.path} has, got "
            f"{source.size[0]}x{source.size[1]}"
        )


def photographs(run: Run, trajectory: Trajectory, source: Source, lens: Camera | OpenCvLens) -> Iterator[Photograph]:
    """The photographs of the poses in ``trajectory``, in order of time.

    Raises InputError for a source whose images have another size than the lens, or that lacks some of them.
    """
    check_size(run, source, lens)
    poses = {stamp(float(t)): p for t, p in zip(trajectory.timestamps_s, trajectory.world_from_cam, strict=True)}
    names = _Names(run, source)
    for frame in source.frames():
        at = stamp(frame.timestamp_s)
        if at in poses:
            name, file = names.of(frame.index, at), names.files.get(frame.index)
            as_it_is = file is not None and name.endswith(file.suffix) and stored_as_read(file)
            yield Photograph(name, float(at), frame.as_taken.image, poses.pop(at), file if as_it_is else None)
    if poses:
        first = next(iter(poses))
        raise InputError(
            f"{source.name}: expected the frames of the run in {run.path}, got none for {len(poses)} of its poses, the "
            f"first at {first} s"
        )


class _Names:
    """Names of frames: those of run.json, else those of the source's files; a video's are counted."""

    def __init__(self, run: Run, source: Source) -> None:
        self.files: dict[int, Path] = getattr(source, "files", {})
        self._by_time = run.record.get("files") or {}
        self._by_index = names_below(self.files)
        self._told = False
        if "files" not in run.record:
            log.warning("%s/run.json names no files (an older run): images are named as the source's are", run.path)

    def of(self, index: int, at: str) -> str:
        """Name of the frame with this index and written time."""
        name = str(self._by_time.get(at) or self._by_index.get(index) or video_frame_name(index))
        if name.lower().endswith(WRITTEN_AS_THEY_ARE):
            return name
        if not self._told:
            log.warning("images of a kind that COLMAP cannot read become PNG: %s is %s.png", name, name)
            self._told = True
        return f"{name}.png"


def write_photograph(path: Path, image: Array, file: Path | None = None) -> None:
    """Write an image (h, w, 3) uint8 RGB, or (h, w), as its suffix says, or the bytes of ``file``. Raises OutputError.

    Folders above are made.
    """
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    if file is not None:
        write_bytes(path, _bytes_of(file))
        return
    pixels = np.ascontiguousarray(image[..., ::-1]) if image.ndim == 3 else image
    suffix = path.suffix.lower()
    done, data = cv2.imencode(suffix, pixels, [] if suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise OutputError(f"{path}: expected an image that {path.suffix} can hold, got shape {image.shape}")
    write_bytes(path, data.tobytes())


def _bytes_of(file: Path) -> bytes:
    return whole_bytes(file, "a readable image")
