"""A folder of images as a source."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from ..config import SourceConfig
from ..errors import InputError
from ..reading.files import entries_of, is_file
from ..types import Frame, Truth
from .beside import beside_frames
from .checks import window
from .exif_focal import focal_of
from .image_files import IMAGE_SUFFIXES, read_probability
from .notes import Notes
from .photographs import BrokenBeside, Photographs
from .semantic_maps import match_maps

Array = NDArray[Any]
log = logging.getLogger(__name__)
FOLDER_FPS = 30.0  # image files carry no times; one thirtieth of a second a frame is assumed


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key under which img2 stands before img10, and capitals do not matter."""
    parts = re.split(r"(\d+)", name.casefold())
    return tuple((0, int(p), "") if p.isdecimal() else (1, 0, p) for p in parts if p)


def image_files(folder: Path) -> list[Path]:
    """The image files right in ``folder``, hidden ones left out, in natural order."""
    found = [
        p
        for p in entries_of(folder)
        if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".") and is_file(p)
    ]
    return sorted(found, key=lambda p: (natural_key(p.name), p.name))


class ImageFolderSource:
    """The images of one folder in natural order, index / 30 s apart."""

    kind = "images"
    has_depth = False
    calibration: tuple[float, ...] = ()

    def __init__(
        self,
        folder: Path,
        config: SourceConfig,
        *,
        want_semantic: bool = True,
        semantic_dir: Path | None = None,
    ) -> None:
        """Lists the folder and reads the first image for its size. Raises InputError, ConfigError."""
        self.name = folder.resolve().name
        self._notes = Notes()
        self.notes: list[str] = self._notes
        self._files = self._frames_of(image_files(folder))
        if not self._files:
            raise InputError(f"{folder}: expected images ({', '.join(IMAGE_SUFFIXES)}), got none")
        self._chosen = window(config, len(self._files), str(folder))
        self.length: int | None = len(self._chosen)
        self.files = {i: self._files[i] for i in self._chosen}
        self._photographs = Photographs(self.files, self._notes)
        self.size = self._photographs.size
        self._describe()
        self.focal_hint_px, self.focal_source = focal_of([self._files[i] for i in self._chosen], self.size)
        self._semantic: dict[int, Path] = {}
        if semantic_dir is not None:
            stems = {i: self._files[i].stem for i in self._chosen}
            times = {i: i / FOLDER_FPS for i in self._chosen}
            self._semantic = match_maps(semantic_dir, stems, times, self._notes)
        self.has_semantic = bool(self._semantic)
        self._want_semantic = want_semantic

    def frames(self) -> Iterator[Frame]:
        """One image after another, broken ones left out and noted. Raises InputError where the size changes."""
        given, broken_maps = 0, BrokenBeside(self._notes, "maps")
        for i, image in self._photographs.images():
            semantic = None
            if self._want_semantic and i in self._semantic:
                with broken_maps.noted(self._semantic[i]):
                    semantic = read_probability(self._semantic[i])
            given += 1
            yield Frame(i, i / FOLDER_FPS, image, semantic=semantic)
        self.length = given

    def image_at(self, timestamp_s: float) -> Array | None:
        """One photograph by its time, see ``Photographs.at``."""
        return self._photographs.at({i: i / FOLDER_FPS for i in self._chosen}, timestamp_s)

    def truth(self) -> Truth | None:
        """A folder of images knows nothing about itself."""
        return None

    def _frames_of(self, files: list[Path]) -> list[Path]:
        """The files without what lies beside the frames, which is told aloud."""
        beside = beside_frames(files)
        if beside:
            line = (
                f"masks or maps beside the frames are left out: {len(beside)}, the first is {beside[0].name}; masks of "
                "what could move are used with --maps FOLDER"
            )
            self._notes.put("beside", line)
            log.warning("%s: %s", self.name, line)
        return [p for p in files if p not in set(beside)]

    def _describe(self) -> None:
        self._notes.put("times", f"images carry no times: {FOLDER_FPS:g} frames a second assumed")
        kinds = sorted({p.suffix.lower() for p in self._files})
        if len(kinds) > 1:
            self._notes.put("kinds", f"images of several kinds are read as one sequence: {', '.join(kinds)}")
