"""What the loaders of the public datasets share: a list of files in order of time, and what is known of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..config import SourceConfig
from ..errors import InputError
from ..reading.files import is_file, whole_text
from ..types import Frame, Truth
from .checks import check_same_size, window
from .image_files import read_depth_m, read_probability
from .notes import Notes
from .photographs import BrokenBeside, Photographs
from .semantic_maps import match_maps

Array = NDArray[Any]
ASSUMED_FPS = 30.0  # of datasets whose files carry no times
MOST_DIGITS = 18  # of a number in a file name
RIGID_TOLERANCE = 0.02  # how far printed rotations may be from orthonormal: some were accumulated in float32


@dataclass(frozen=True)
class Wants:
    """What of a source will be read."""

    depth: bool = False
    semantic: bool = True
    semantic_dir: Path | None = None  # the user's own maps


@dataclass(frozen=True)
class Listed:
    """One frame of a dataset: files that are read when its turn comes."""

    timestamp_s: float
    image: Path
    depth: Path | None = None


@dataclass(frozen=True)
class Sequenced:
    """All that a loader found in a folder."""

    kind: str
    name: str
    frames: Sequence[Listed]  # ascending times
    found: str  # what was found and where, for the notes
    truth_times_s: Array = field(default_factory=lambda: np.empty(0))  # (n,) float64
    world_from_cam: Array = field(default_factory=lambda: np.empty((0, 4, 4)))  # (n, 4, 4) float64
    calibration: tuple[float, ...] = ()  # fx fy cx cy and OpenCV's distortion, full-size pixels
    lens_size: tuple[int, int] | None = None  # (width, height) that the calibration is of, where the dataset tells
    units_per_metre: float = 1000.0  # of integer depth files
    no_depth: int | None = None  # the value, beside 0, that means none
    notes: Sequence[str] = ()


class SequenceSource:
    """Frames of a dataset in order, with depth where there is some, and its truth."""

    def __init__(self, found: Sequenced, config: SourceConfig, wants: Wants) -> None:
        """Checks that the chosen files exist, reads the first for its size. Raises InputError, ConfigError."""
        self._found, self._wants = found, wants
        self.kind, self.name = found.kind, found.name
        self._notes = Notes()
        self.notes: list[str] = self._notes
        self._notes.put("found", f"{found.kind}: {found.found}")
        for line in found.notes:
            self._notes.put(line, line)
        self._chosen = window(config, len(found.frames), found.name)
        self.length: int | None = len(self._chosen)
        check_times([found.frames[i].timestamp_s for i in self._chosen], found.name)
        for i in self._chosen:
            _check_there(found.frames[i].image, "an image")
        self.files = {i: found.frames[i].image for i in self._chosen}
        self._photographs = Photographs(self.files, self._notes)
        self.size = self._photographs.size
        self.calibration = calibration_for(self.size, found.lens_size, found.calibration, self._notes)
        self.has_depth = any(found.frames[i].depth is not None for i in self._chosen)
        self._semantic: dict[int, Path] = {}
        if wants.semantic_dir is not None:
            stems = {i: found.frames[i].image.stem for i in self._chosen}
            times = {i: found.frames[i].timestamp_s for i in self._chosen}
            self._semantic = match_maps(wants.semantic_dir, stems, times, self._notes)
        self.has_semantic = bool(self._semantic)

    def frames(self) -> Iterator[Frame]:
        """Frame after frame; depth and semantic only if wanted. What is broken is left out and noted.

        Raises InputError at a map that is none, and where the size changes.
        """
        given, broken_depth = 0, BrokenBeside(self._notes, "depth files")
        broken_maps = BrokenBeside(self._notes, "maps")
        for i, image in self._photographs.images():
            listed = self._found.frames[i]
            depth, semantic = None, None
            if self._wants.depth and listed.depth is not None:
                with broken_depth.noted(listed.depth):
                    depth, _ = read_depth_m(listed.depth, self._found.units_per_metre, self._found.no_depth)
                    check_same_size(depth, str(listed.depth), self.size, f"its image {listed.image.name}")
            if self._wants.semantic and i in self._semantic:
                with broken_maps.noted(self._semantic[i]):
                    semantic = read_probability(self._semantic[i])
            given += 1
            yield Frame(i, listed.timestamp_s, image, depth, semantic)
        self.length = given

    def image_at(self, timestamp_s: float) -> Array | None:
        """One photograph by its time, see ``Photographs.at``."""
        return self._photographs.at({i: self._found.frames[i].timestamp_s for i in self._chosen}, timestamp_s)

    def truth(self) -> Truth | None:
        """Camera poses and focal length; None where the dataset has neither."""
        found = self._found
        if len(found.truth_times_s) == 0 and not self.calibration:
            return None
        focal = self.calibration[0] if self.calibration else None
        return Truth(found.truth_times_s, found.world_from_cam, {}, focal)


def truth_or_note(read: Callable[[], tuple[Array, Array]], notes: list[str]) -> tuple[Array, Array]:
    """Times (n,) and poses (n, 4, 4) as ``read`` gives them; none, and a note, where they cannot be read.

    Truth never stops a run.
    """
    try:
        return read()
    except InputError as e:
        notes.append(f"truth is left out: {e}")
        return np.empty(0), np.empty((0, 4, 4))


def calibration_for(
    size: tuple[int, int], lens_size: tuple[int, int] | None, calibration: tuple[float, ...], notes: Notes
) -> tuple[float, ...]:
    """The calibration, or none with a note where pictures are not of its size: nobody knows how they were resized."""
    if not calibration or lens_size in (None, size):
        return calibration
    of, there = (f"{s[0]}x{s[1]}" for s in (lens_size or size, size))
    notes.put("lens", f"the dataset's lens is of {of} pixels, the pictures are {there}: it is not used")
    return ()


def check_times(times_s: Sequence[float], where: str) -> None:
    """Refuse times that do not ascend. Raises InputError."""
    steps = np.diff(np.asarray(times_s, float))
    if len(steps) and not (steps > 0).all():
        at = int(np.argmin(steps > 0))
        raise InputError(f"{where}: expected ascending times, got {times_s[at + 1]:.6f} s after {times_s[at]:.6f} s")


def numbered(folder: Path, prefix: str, suffix: str, what: str) -> dict[int, Path]:
    """Files ``prefix`` NUMBER ``suffix`` of a folder by number, ascending. Raises InputError for none."""
    found: dict[int, Path] = {}
    for path in folder.glob(f"{prefix}*{suffix}"):
        digits = path.name[len(prefix) : len(path.name) - len(suffix)]
        if digits.isdecimal() and len(digits) <= MOST_DIGITS:
            found[int(digits)] = path
    if not found:
        raise InputError(f"{folder}: expected {what} {prefix}NNNNNN{suffix}, got none")
    return dict(sorted(found.items()))


def without_gaps(files: dict[int, Path], count: int, what: str, where: Path) -> list[Path]:
    """The files 0 ... count-1. Raises InputError that names the first one that is missing."""
    missing = [i for i in range(count) if i not in files]
    if missing:
        raise InputError(
            f"{where}: expected {count} {what}, got {count - len(missing)}; the first that is missing is {missing[0]}"
        )
    return [files[i] for i in range(count)]


def read_lines(path: Path) -> list[tuple[int, str]]:
    """Lines that are not empty or comments, each with its number from 1. Raises InputError."""
    text = whole_text(path, "a text file")
    lines = [(n, line.strip()) for n, line in enumerate(text.splitlines(), 1)]
    return [(n, line) for n, line in lines if line and not line.startswith("#")]


def read_numbers(path: Path, columns: int, what: str, separator: str | None = None, at_least: bool = False) -> Array:
    """A table of (rows, columns) float64. ``at_least``: further columns are left out. Raises InputError."""
    rows = []
    for number, line in read_lines(path):
        words = line.split(separator)
        enough = len(words) >= columns if at_least else len(words) == columns
        try:
            row = [float(w) for w in words[:columns]] if enough else []
        except ValueError:
            row = []
        if not row or not np.isfinite(row).all():
            more = " or more" if at_least else ""
            raise InputError(
                f"{path} line {number}: expected {what} ({columns}{more} numbers), got {len(words)} words, "
                f"{line[:60]!r}"
            )
        rows.append(row)
    if not rows:
        raise InputError(f"{path}: expected lines of {what} ({columns} numbers), got none")
    return np.array(rows)


def read_keyed(path: Path, wanted: dict[str, int]) -> dict[str, Array]:
    """Lines 'KEY: numbers' of a calibration file: the wanted keys and their counts. Raises InputError."""
    found: dict[str, Array] = {}
    for number, line in read_lines(path):
        key, _, text = line.partition(":")
        if key not in wanted:
            continue
        try:
            values = np.array([float(w) for w in text.split()])
        except ValueError:
            values = np.empty(0)
        if len(values) != wanted[key] or not np.isfinite(values).all():
            raise InputError(f"{path} line {number}: expected {wanted[key]} numbers after {key}:, got {text.strip()!r}")
        found[key] = values
    missing = [key for key in wanted if key not in found]
    if missing:
        raise InputError(f"{path}: expected a line '{missing[0]}: ...', got none")
    return found


def rigid(matrix: Array, where: str) -> Array:
    """(3, 4) or (4, 4) numbers as (4, 4) float64; the rotation is checked, not changed. Raises InputError."""
    full = np.eye(4)
    full[:3] = np.asarray(matrix, float)[:3]
    rotation = full[:3, :3]
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if not off < RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
        raise InputError(f"{where}: expected a rotation and a position, got a matrix that is {off:.3g} off a rotation")
    return full


def rigid_all(matrices: Array, where: Path) -> Array:
    """(n, 12) or (n, 16) numbers, a pose a line, as (n, 4, 4). Raises InputError."""
    rows = np.asarray(matrices, float).reshape(len(matrices), -1, 4)
    return np.stack([rigid(row, f"{where} pose {i + 1}") for i, row in enumerate(rows)])


def _check_there(path: Path, what: str) -> None:
    if not is_file(path):
        raise InputError(f"{path}: expected {what}, got no such file")
