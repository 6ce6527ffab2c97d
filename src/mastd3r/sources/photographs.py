"""The image files of a sequence: of one size, broken ones left out and counted, deep grey the same in all."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from ..errors import InputError
from .checks import check_same_size
from .grey_levels import WHOLE, range_of, spread
from .image_files import BrokenFile, read_grey_levels, read_rgb
from .notes import Notes

Array = NDArray[Any]
SAME_TIME_S = 1.5e-6  # run folders write six decimals


class Photographs:
    """What folders of images and the layouts of datasets share in reading their frames."""

    def __init__(self, files: Mapping[int, Path], notes: Notes) -> None:
        """``files``: frame index to image, in order. Reads the first that can be read. Raises InputError for none."""
        self._files, self._notes = files, notes
        samples = (read_grey_levels(files[i]) for i in spread(list(files)))
        found = range_of(levels for levels in samples if levels is not None)
        self._grey_range = WHOLE if found is None else found
        if found is not None:
            notes.put("grey", found.note)
        first, image = self._first_readable()
        self.size = (image.shape[1], image.shape[0])  # (width, height)
        self._first = str(files[first])

    def images(self) -> Iterator[tuple[int, Array]]:
        """Frame index and (h, w, 3) uint8 RGB, broken files left out. Raises InputError where the size changes."""
        broken: list[Path] = []
        for i, path in self._files.items():
            try:
                image = read_rgb(path, self._grey_range)
            except BrokenFile:
                broken.append(path)
                line = f"images that cannot be read are left out: {len(broken)} of {len(self._files)}"
                self._notes.put("broken", f"{line}, the first is {broken[0].name}")
                continue
            check_same_size(image, str(path), self.size, self._first)
            yield i, image

    def at(self, times_s: Mapping[int, float], timestamp_s: float) -> Array | None:
        """(h, w, 3) uint8 RGB of the frame at a time, to a microsecond; None where there is none.

        ``times_s``: of every frame, by its index. Raises InputError for a broken file.
        """
        found = (i for i, t in times_s.items() if abs(t - timestamp_s) < SAME_TIME_S)
        index = next(found, None)
        return None if index is None else read_rgb(self._files[index], self._grey_range)

    def _first_readable(self) -> tuple[int, Array]:
        reason = InputError("expected images, got none")
        for i, path in self._files.items():
            try:
                return i, read_rgb(path, self._grey_range)
            except BrokenFile as e:
                reason = e if i == next(iter(self._files)) else reason
        if len(self._files) == 1:
            raise reason
        raise InputError(f"{reason}; none of the {len(self._files)} images can be read") from reason


class BrokenBeside:
    """Depth files or maps beside the frames that cannot be read: their frames have none, and they are counted."""

    def __init__(self, notes: Notes, what: str) -> None:
        self._notes, self._what, self._first, self._count = notes, what, "", 0

    @contextmanager
    def noted(self, path: Path) -> Iterator[None]:
        """What reads the file ``path`` may stop at its being broken."""
        try:
            yield
        except BrokenFile:
            self._first, self._count = self._first or path.name, self._count + 1
            line = f"{self._what} that cannot be read are taken as none: {self._count}, the first is {self._first}"
            self._notes.put(f"broken {self._what}", line)
