"""Names of a run's photographs: the source's own where it is made of image files."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from ..types import Source
from .run_folder import stamp


def names_by_time(source: Source, frames: Iterable[tuple[int, float]]) -> dict[str, str]:
    """Timestamp, as run folders write it, to file name, of (index, timestamp_s) ``frames``; empty for a video.

    Names are relative to the folder that holds all images, with forward slashes.
    """
    names = names_below(getattr(source, "files", {}))
    return {stamp(time_s): names[index] for index, time_s in frames if index in names}


def names_below(files: Mapping[int, Path]) -> dict[int, str]:
    """Names of files by the same keys, relative to the deepest folder that holds them all."""
    if not files:
        return {}
    paths = {key: Path(os.path.abspath(path)) for key, path in files.items()}
    folder = os.path.commonpath([path.parent for path in paths.values()])
    return {key: path.relative_to(folder).as_posix() for key, path in paths.items()}


def video_frame_name(index: int) -> str:
    """Name of an extracted frame; ``index`` counts all frames of the video."""
    return f"frame_{index:06d}.png"
