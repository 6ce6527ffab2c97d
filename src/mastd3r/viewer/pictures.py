"""The picture of any frame of a run folder: the photograph where it still is, else what the folder holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from ..config import SourceConfig, config_from_text
from ..errors import InputError, SlamError
from ..export.read_run import Run
from ..export.run_folder import stamp
from ..reading.files import exists, is_file

Array = NDArray[Any]
ImageAt = Callable[[float], Array | None]  # (h, w, 3) uint8 RGB of a time, None where there is none
VIDEO = "masks.mp4"


@dataclass(frozen=True)
class Picture:
    """One frame, and in words what is shown of it."""

    image: Array | None  # (h, w, 3) uint8 RGB
    mask: Array | None  # (h', w') uint8 P(moving), 255 = certain; None where the image shows it already
    said: str


class Pictures:
    """Files are opened when the first picture is asked for. What is missing or broken is said, never raised."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._photograph: ImageAt | None = None
        self._why_not = ""
        self._video: ImageAt | None = None
        self._opened = False

    def at(self, timestamp_s: float) -> Picture:
        """The picture of the frame of this time."""
        if not self._opened:
            self._open()
            self._opened = True
        missing = [self._why_not] if self._why_not else []
        image = self._asked(self._photograph, timestamp_s, missing)
        if image is not None:
            mask, said = self._mask(timestamp_s)
            return Picture(image, mask, f"photograph{said}")
        image = self._asked(self._video, timestamp_s, missing)
        if image is not None:
            return Picture(image, None, "; ".join([*missing, f"from {VIDEO}, what moves in orange"]))
        image = self._asked(self._render, timestamp_s, missing)
        mask, said = self._mask(timestamp_s)
        what = f"the splat's render of this frame{said}" if image is not None else "no picture of this frame"
        if image is None and mask is not None:
            what = "P(moving) alone, white = moving"
        return Picture(image, mask, "; ".join([*missing, what]))

    def _open(self) -> None:
        from ..sources import open_source  # half a second to load, and the first view does not wait for it

        try:
            path = Path(str((self._run.record.get("source") or {}).get("path") or ""))
            if not path.name or not exists(path):
                raise InputError(f"photographs: expected at source.path of run.json, got no such path as {str(path)!r}")
            source = open_source(path, self._source_config(), want_semantic=False)
            self._photograph = getattr(source, "image_at", None)
            self._why_not = "" if self._photograph else f"photographs of a {source.kind} source cannot be searched"
        except (SlamError, OSError, AttributeError) as e:
            self._why_not = " ".join(str(e).split())
        video, times = self._run.path / VIDEO, self._run.mask_times_s()
        if is_file(video) and len(times):
            self._video = self._video_from(video, float(times[0]))

    def _source_config(self) -> SourceConfig:
        """The window and kind that the run read its source with. Raises ConfigError."""
        return config_from_text(self._run.config, f"{self._run.path}/config.yaml").source

    @staticmethod
    def _video_from(path: Path, first_s: float) -> ImageAt:
        """A video of ours begins at its first frame; it is opened when it is needed."""
        opened: list[ImageAt] = []

        def at(timestamp_s: float) -> Array | None:
            if not opened:
                from ..sources.video import VideoSource  # brings PyAV

                opened.append(VideoSource(path, SourceConfig()).image_at)
            return opened[0](timestamp_s - first_s)

        return at

    def _asked(self, image_at: ImageAt | None, timestamp_s: float, missing: list[str]) -> Array | None:
        """The image, or None and one more line of what is missing."""
        try:
            return None if image_at is None else image_at(timestamp_s)
        except (SlamError, OSError) as e:
            missing.append(" ".join(str(e).split()))
            return None

    def _render(self, timestamp_s: float) -> Array | None:
        file = self._run.path / "renders" / f"{stamp(timestamp_s)}.png"
        return self._run.render(timestamp_s) if is_file(file) else None

    def _mask(self, timestamp_s: float) -> tuple[Array | None, str]:
        """P(moving), and what is to be said of it."""
        if not is_file(self._run.path / "masks" / f"{stamp(timestamp_s)}.png"):
            return None, "; no mask of this frame"
        try:
            return self._run.mask(timestamp_s), ""
        except InputError as e:
            return None, f"; {e}"
