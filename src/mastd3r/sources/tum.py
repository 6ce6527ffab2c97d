"""A folder in the TUM RGB-D layout as a source."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..config import SourceConfig
from ..errors import InputError
from ..reading.files import is_file, short, whole_json, whole_text
from ..types import Frame, Truth
from .checks import check_same_size, window
from .image_files import read_depth_m, read_probability
from .notes import Notes
from .photographs import BrokenBeside, Photographs
from .semantic_maps import match_maps, nearest_time
from .sequence import calibration_for

Array = NDArray[Any]
POSE_ROW = "timestamp_s tx ty tz qx qy qz qw"
FARTHEST = 1e9  # metres; beyond, a number is no position
TUM_DEPTH_SCALE = 5000.0  # units of a 16-bit depth file a metre, where info.json does not tell


@dataclass(frozen=True)
class Row:
    """One line of a list."""

    line: int  # counted from 1, for messages
    timestamp_s: float
    words: tuple[str, ...]


class TumSource:
    """Colour, depth, semantic maps and truth of one TUM-layout folder, associated by time."""

    kind = "tum"
    most_absent_ratio = 0.0  # of the listed files, that may be absent

    def __init__(
        self,
        folder: Path,
        config: SourceConfig,
        *,
        want_depth: bool = False,
        want_semantic: bool = True,
        semantic_dir: Path | None = None,
        published: tuple[float, ...] = (),
        lens_size: tuple[int, int] | None = None,
        found: str = "",
    ) -> None:
        """Reads the lists, checks that the listed images exist. Raises InputError, ConfigError.

        ``published`` is the calibration where info.json has none, of pictures of ``lens_size``; ``found`` says what
        was found, for the notes.
        """
        self.name = folder.resolve().name
        self._notes = Notes()
        self.notes: list[str] = self._notes
        if found:
            self._notes.put("found", f"{self.kind}: {found}")
        self._folder = folder
        self._want_depth, self._want_semantic = want_depth, want_semantic
        self._info = _read_info(folder / "info.json", self._notes, needed=want_depth)
        self._rows = self._present(file_rows(folder / "rgb.txt"), folder / "rgb.txt")
        _check_ascending(self._rows, folder / "rgb.txt")
        self._chosen = window(config, len(self._rows), str(folder / "rgb.txt"))
        self.length: int | None = len(self._chosen)
        self._times = np.array([r.timestamp_s for r in self._rows])
        for i in self._chosen:
            if not is_file(self._image(i)):
                row = self._rows[i]
                raise InputError(
                    f"{folder / 'rgb.txt'} line {row.line}: expected an image file, got no {short(row.words[0])}"
                )
        self.files = {i: self._image(i) for i in self._chosen}
        self._photographs = Photographs(self.files, self._notes)
        self.size = self._photographs.size
        self.calibration = self._intrinsics() or calibration_for(self.size, lens_size, published, self._notes)
        self._depth = self._associated("depth.txt", needed=want_depth)
        self._depth_scale = self._units_per_metre() if self._depth else TUM_DEPTH_SCALE
        if semantic_dir is not None:
            stems = {i: self._image(i).stem for i in self._chosen}
            times = {i: float(self._times[i]) for i in self._chosen}
            self._semantic = match_maps(semantic_dir, stems, times, self._notes)
        else:
            self._semantic = self._associated("semantic.txt")
        self.has_depth, self.has_semantic = bool(self._depth), bool(self._semantic)
        self._true = self._read_truth()  # now: what is wrong with it is told before anything is computed

    def frames(self) -> Iterator[Frame]:
        """Frame after frame; depth and semantic only if wanted. What is broken is left out and noted.

        Raises InputError at a map that is none, and where the size changes.
        """
        holes, given, broken_depth = 0, 0, BrokenBeside(self._notes, "depth files")
        broken_maps = BrokenBeside(self._notes, "maps")
        for i, image in self._photographs.images():
            depth, semantic = None, None
            if self._want_depth and i in self._depth:
                with broken_depth.noted(self._depth[i]):
                    depth, bad = read_depth_m(self._depth[i], self._depth_scale)
                    check_same_size(depth, str(self._depth[i]), self.size, f"its image {self._image(i).name}")
                    holes += bad
                    if bad:
                        self._notes.put("holes", f"depth: {holes} values that are not finite are taken as none")
            if self._want_semantic and i in self._semantic:
                with broken_maps.noted(self._semantic[i]):
                    semantic = read_probability(self._semantic[i])
            given += 1
            yield Frame(i, float(self._times[i]), image, depth, semantic)
        self.length = given

    def image_at(self, timestamp_s: float) -> Array | None:
        """One photograph by its time, see ``Photographs.at``."""
        return self._photographs.at({i: float(self._times[i]) for i in self._chosen}, timestamp_s)

    def truth(self) -> Truth | None:
        """Poses of groundtruth.txt, masks of mask.txt, focal length of info.json.

        Masks are keyed by the timestamp of the frame that they belong to. None where the folder has none of
        the three.
        """
        return self._true

    def _read_truth(self) -> Truth | None:
        times, poses = self._poses()
        moving = {float(self._times[i]): str(p) for i, p in self._associated("mask.txt").items()}
        focal = self._number("fx") or (self.calibration[0] if self.calibration else None)
        if len(times) == 0 and not moving and focal is None:
            return None
        return Truth(times, poses, moving, focal)

    def _poses(self) -> tuple[Array, Array]:
        return _read_poses(self._folder / "groundtruth.txt", self._notes)

    def _image(self, i: int) -> Path:
        return self._folder / self._rows[i].words[0]

    def _present(self, rows: list[Row], path: Path) -> list[Row]:
        """The rows whose files are there, where some may be absent. Raises InputError where too many are."""
        if not self.most_absent_ratio:
            return rows
        there = [row for row in rows if is_file(self._folder / row.words[0])]
        absent = len(rows) - len(there)
        if absent > self.most_absent_ratio * len(rows):
            raise InputError(f"{path}: expected files beside its {len(rows)} lines, {absent} of them are not there")
        if absent:
            self._notes.put(f"absent {path.name}", f"{path.name}: {absent} of {len(rows)} files are absent, left out")
        return there

    def _associated(self, list_name: str, needed: bool = False) -> dict[int, Path]:
        """Frame index -> file of a list such as depth.txt, by nearest time within 20 ms.

        Raises InputError for a list that cannot be read, and is ``needed``; others are left out with a note.
        """
        path = self._folder / list_name
        if not os.path.lexists(path):
            return {}
        try:
            rows = sorted(self._present(file_rows(path), path), key=lambda r: r.timestamp_s)
        except InputError as e:
            if needed:
                raise
            self._notes.put(list_name, f"{list_name} is left out: {e}")
            return {}
        at = nearest_time(np.array([r.timestamp_s for r in rows]), self._times[list(self._chosen)])
        found = {i: self._folder / rows[k].words[0] for i, k in zip(self._chosen, at, strict=True) if k >= 0}
        self._notes.put(list_name, f"{list_name}: belongs to {len(found)} of {len(self._chosen)} frames")
        return found

    def _units_per_metre(self) -> float:
        scale = self._number("depth_scale")
        if scale is None:
            self._notes.put("scale", f"info.json tells no depth_scale: {TUM_DEPTH_SCALE:g} units a metre assumed")
            return TUM_DEPTH_SCALE
        return scale

    def _intrinsics(self) -> tuple[float, ...]:
        """fx, fy, cx, cy and ``distortion`` (OpenCV's) of info.json; empty where it has not all four."""
        four = [self._number(key) for key in ("fx", "fy", "cx", "cy")]
        if any(v is None for v in four):
            return ()
        distortion = self._info.get("distortion", [])
        if not isinstance(distortion, list) or not all(_is_number(v) for v in distortion):
            self._left_out(f"expected distortion as a list of numbers, got {short(repr(distortion))}")
            return ()
        return (*(v for v in four if v is not None), *(float(v) for v in distortion))

    def _number(self, key: str) -> float | None:
        value = self._info.get(key)
        if value is None:
            return None
        if not _is_number(value) or not value > 0:
            self._left_out(f"expected {key} above 0, got {short(repr(value))}")
            return None
        return float(value)

    def _left_out(self, why: str) -> None:
        if self._want_depth:  # the scale of its depth is in there
            raise InputError(f"{self._folder / 'info.json'}: {why}")
        self._notes.put("info", f"info.json is not used as a whole: {why}")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < FARTHEST


def _read_info(path: Path, notes: Notes, needed: bool) -> dict[str, Any]:
    """info.json; nothing, with a note, where it cannot be read and is not ``needed``."""
    try:
        return whole_json(path, "JSON") if os.path.lexists(path) else {}
    except InputError as e:
        if needed:
            raise
        notes.put("info", f"info.json is left out: {e}")
        return {}


def _rows_of(path: Path, words: int, what: str, left_out: list[int] | None = None) -> list[Row]:
    """Lines of a TUM list: a time, then ``words`` words (1: the rest of the line).

    Raises InputError for a line that is something else; with ``left_out``, its number is put there instead.
    """
    text = whole_text(path, "a readable text file")
    rows: list[Row] = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        parts = re.split(r"[,\s]+", line.strip(), maxsplit=1 if words == 1 else 0)
        try:
            time_s = float(parts[0])
        except ValueError:
            time_s = np.nan
        if len(parts) >= words + 1 and np.isfinite(time_s):
            rows.append(Row(number, time_s, tuple(p.strip() for p in parts[1 : words + 1])))
        elif left_out is None:
            raise InputError(f"{path} line {number}: expected '{what}', got {short(line.strip())!r}")
        else:
            left_out.append(number)
    if not rows and left_out is None:
        raise InputError(f"{path}: expected lines of '{what}', got none")
    return rows


def file_rows(path: Path) -> list[Row]:
    """Lines 'timestamp_s filename' of a list. Raises InputError."""
    return _rows_of(path, 1, "timestamp_s filename")


def _check_ascending(rows: list[Row], path: Path) -> None:
    for before, row in pairwise(rows):
        if row.timestamp_s <= before.timestamp_s:
            raise InputError(
                f"{path} line {row.line}: expected a time after {before.timestamp_s:.6f} s "
                f"(line {before.line}), got {row.timestamp_s:.6f} s"
            )


def _read_poses(path: Path, notes: Notes) -> tuple[Array, Array]:
    """groundtruth.txt as (n,) float64 ascending seconds and (n, 4, 4) float64 world_from_cam; n may be 0.

    Truth never stops a run: a row that is no pose, or repeats a time, is left out with a note.
    """
    if not os.path.lexists(path):
        return np.empty(0), np.empty((0, 4, 4))
    left_out: list[int] = []
    try:
        rows = _rows_of(path, 7, POSE_ROW, left_out)
    except InputError as e:
        notes.put("truth", f"truth is left out: {e}")
        return np.empty(0), np.empty((0, 4, 4))
    found: dict[float, list[float]] = {}
    for row in rows:
        try:
            values = [float(w) for w in row.words]
        except ValueError:
            values = [np.nan]
        sound = np.isfinite(values).all() and max(map(abs, values)) < FARTHEST and np.linalg.norm(values[3:]) > 1e-6
        if sound and row.timestamp_s not in found:
            found[row.timestamp_s] = values
        else:
            left_out.append(row.line)
    if left_out:
        first = f"{path.name} line {min(left_out)}"
        notes.put("truth", f"truth: {len(left_out)} rows are no poses ({POSE_ROW}), or repeat a time, from {first} on")
    times = np.array(sorted(found))
    poses = np.array([found[t] for t in times]).reshape(-1, 7)
    world_from_cam = np.tile(np.eye(4), (len(times), 1, 1))
    world_from_cam[:, :3, 3] = poses[:, :3]
    if len(times):
        world_from_cam[:, :3, :3] = Rotation.from_quat(poses[:, 3:]).as_matrix()
    return times, world_from_cam
