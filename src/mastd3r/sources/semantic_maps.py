"""Maps of P(movable thing) that the user supplies as a folder of files."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..config import Config
from ..errors import InputError
from ..reading.files import entries_of
from ..types import Frame, Source
from .beside import plain_name, without_word
from .image_files import MAP_SUFFIXES
from .notes import Notes

MOST_DIGITS = 18  # of a frame index
ASSOCIATION_S = 0.02  # two files belong to one moment when their times differ by no more


def nearest_time(times_s: np.ndarray, wanted_s: np.ndarray, tolerance_s: float = ASSOCIATION_S) -> np.ndarray:
    """For each wanted time the index of the nearest in the ascending ``times_s``, -1 beyond the tolerance.

    Shapes: (n,) and (m,) float64 seconds to (m,) int64.
    """
    if len(times_s) == 0:
        return np.full(len(wanted_s), -1, np.int64)
    right = np.searchsorted(times_s, wanted_s).clip(0, len(times_s) - 1)
    left = (right - 1).clip(0)
    nearer_left = np.abs(times_s[left] - wanted_s) <= np.abs(times_s[right] - wanted_s)
    best = np.where(nearer_left, left, right)
    # a nanosecond more, so that "20 ms apart" in decimal text is not lost to rounding
    return np.where(np.abs(times_s[best] - wanted_s) <= tolerance_s + 1e-9, best, -1)


def match_maps(folder: Path, stems: Mapping[int, str], times_s: Mapping[int, float], notes: Notes) -> dict[int, Path]:
    """Which file of ``folder`` belongs to which frame index: frame index -> path. Raises InputError.

    Files are .png or .npy, named all in one way: as the frame's own file, with or without a word such as "mask", by
    frame index (counted before --start and --stride) or by timestamp in seconds (nearest within 20 ms). ``stems`` may
    be empty (video). Where some are named with such a word, those alone are maps: the folder may be the frames' own.
    """
    if not os.path.isdir(folder):
        raise InputError(f"{folder}: expected a folder of probability maps, got no such folder")
    files: dict[str, Path] = {}
    for path in entries_of(folder):
        if path.suffix.lower() in MAP_SUFFIXES and not path.name.startswith("."):
            if path.stem in files:
                raise InputError(f"{folder}: expected one map a frame, got {files[path.stem].name} and {path.name}")
            files[path.stem] = path
    if not files:
        raise InputError(f"{folder}: expected probability maps ({', '.join(MAP_SUFFIXES)}), got none")
    way, found = _by_name(files, stems)
    if not found and all(s.isdecimal() and len(s) <= MOST_DIGITS for s in files):
        way, found = _by_index(files, times_s)
    if not found:
        way, found = _by_time(files, times_s)
    if not found:
        example = next(iter(files.values())).name
        raise InputError(f"{folder}: expected maps named as the frames, by frame index or by timestamp, got {example}")
    notes.put("semantic", f"probability maps from {folder.name} by {way}: {len(found)} of {len(times_s)} frames")
    return found


def _by_name(files: Mapping[str, Path], stems: Mapping[int, str]) -> tuple[str, dict[int, Path]]:
    named = {key: p for s, p in files.items() if (key := without_word(s)) is not None}
    belonging = {i: named[key] for i, s in stems.items() if (key := plain_name(s)) in named}
    return "file name", belonging or {i: files[s] for i, s in stems.items() if s in files}


def _by_index(files: Mapping[str, Path], times_s: Mapping[int, float]) -> tuple[str, dict[int, Path]]:
    numbers = {int(s): p for s, p in files.items()}
    return "frame index", {i: numbers[i] for i in times_s if i in numbers}


def _by_time(files: Mapping[str, Path], times_s: Mapping[int, float]) -> tuple[str, dict[int, Path]]:
    stamped: list[tuple[float, Path]] = []
    for stem, path in files.items():
        try:
            stamped.append((float(stem), path))
        except ValueError:
            return "timestamp", {}
    if not all(np.isfinite(t) for t, _ in stamped):
        return "timestamp", {}
    stamped.sort()
    at = nearest_time(np.array([t for t, _ in stamped]), np.array(list(times_s.values()), float))
    return "timestamp", {i: stamped[k][1] for i, k in zip(times_s, at, strict=True) if k >= 0}


class FromSource:
    """The semantic prior that frames carry already, if any."""

    notes: tuple[str, ...] = ()

    def fill(self, frame: Frame) -> Frame:
        """The frame as it is."""
        return frame

    def features(self, frame: Frame) -> Any:
        """None: descriptors are made of the image."""
        return None


def build_none(config: Config, source: Source) -> FromSource:
    """No prior: the source was opened without maps."""
    return FromSource()


def build_maps(config: Config, source: Source) -> FromSource:
    """The source's own maps. Raises InputError where it has none."""
    if not source.has_semantic:
        raise InputError(f"--semantics maps: expected probability maps beside the frames, {source.name} has none")
    return FromSource()
