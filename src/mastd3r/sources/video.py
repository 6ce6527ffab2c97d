"""A video file as a source, decoded by PyAV one frame at a time."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from ..config import SourceConfig
from ..errors import InputError
from ..reading.files import resolved, why
from ..reading.pictures import check_pixels
from ..types import Frame, Truth
from .checks import check_same_size, check_window, window
from .grey_levels import GreyRange, range_of, spread
from .image_files import read_probability
from .interlacing import deinterlaced, interlacing_of
from .notes import Notes
from .photographs import BrokenBeside
from .semantic_maps import match_maps
from .turns import UPRIGHT, turn_of_frame, turned

Array = NDArray[Any]
FALLBACK_FPS = Fraction(30)
GREY = "gray16le"
LOCAL_ONLY = {"protocol_whitelist": "file"}  # a playlist reads nothing from the net
# Texts that are no UTF-8 are let be; since PyAV 19 they always are, and its ``open`` takes no such word.
BAD_METADATA: dict[str, Any] = {"metadata_errors": "replace"} if int(av.__version__.split(".")[0]) < 19 else {}
ATTACHED_PICTURE = 0x400  # libavformat's AV_DISPOSITION_ATTACHED_PIC


@dataclass(frozen=True)
class _Contents:
    """What the file's packets say, before anything is decoded."""

    times_s: Array  # (n,) float64 ascending presentation times, one a packet
    timed: bool  # the file has presentation times; else they are counted
    frame_s: float  # usual (median) time between frames
    cut_before_s: float | None  # the end that the header promises, where the file stops before it
    doubtful: int | None  # presentation stamp of a last packet that may be only half there
    pixel_aspect: Fraction  # width of a pixel over its height
    field_order: int  # libavcodec's, 0 where it is unknown


@dataclass(frozen=True)
class _Decoded:
    index: int
    timestamp_s: float
    frame: Any  # av.VideoFrame


@dataclass(frozen=True)
class _Loss:
    """A packet that does not decode."""

    timestamp_s: float | None


class VideoSource:
    """The frames of one video file at their true presentation times, upright."""

    kind = "video"
    has_depth = False
    calibration: tuple[float, ...] = ()

    def __init__(
        self,
        path: Path,
        config: SourceConfig,
        *,
        want_semantic: bool = True,
        semantic_dir: Path | None = None,
    ) -> None:
        """Reads the packets' times and decodes the first frame. Raises InputError, ConfigError."""
        check_window(config)
        self.name = path.stem
        self._notes = Notes()
        self.notes: list[str] = self._notes
        self._path = path
        self._contents = _read_contents(path)
        count = len(self._contents.times_s)
        self._chosen = window(config, count, str(path))
        self.length: int | None = len(self._chosen)
        head = self._decoded(note_end=False)
        first = next(head, None)
        if first is None:
            raise InputError(f"{path}: expected a video, got {count} frames of which none can be decoded")
        self._turn = turn_of_frame(first.frame)
        frames = (d.frame for d in chain([first], head))
        with _converting(path):
            self._interlacing = interlacing_of(frames, self._contents.field_order)
            self._grey = self._grey_range() if _is_deep_grey(first.frame) else None
            height, width = self._rgb(first.frame).shape[:2]
        if self._interlacing is not None:
            self._notes.put("interlaced", self._interlacing.note)
        self.size = (width, height)
        self._semantic: dict[int, Path] = {}
        if semantic_dir is not None:
            times = {i: float(self._contents.times_s[i]) for i in self._chosen}
            self._semantic = match_maps(semantic_dir, {}, times, self._notes)
        self.has_semantic = bool(self._semantic)
        self._want_semantic = want_semantic

    def frames(self) -> Iterator[Frame]:
        """Frame after frame. Broken ones are left out and noted. Raises InputError where the size changes."""
        given, broken_maps = 0, BrokenBeside(self._notes, "maps")
        decoded: Iterator[_Decoded] = self._decoded(note_end=True)
        if self._interlacing is not None:
            decoded = deinterlaced(decoded, self._interlacing)
        while True:
            with _converting(self._path):
                d = next(decoded, None)
                image = None if d is None or d.index not in self._chosen else self._rgb(d.frame)
            if d is None:
                break
            if image is None:
                continue
            where = f"{self._path} frame {d.index} at {d.timestamp_s:.3f} s"
            check_same_size(image, where, self.size, "the first frame")
            semantic = None
            if self._want_semantic and d.index in self._semantic:
                with broken_maps.noted(self._semantic[d.index]):
                    semantic = read_probability(self._semantic[d.index])
            given += 1
            yield Frame(d.index, d.timestamp_s, image, semantic=semantic)
        self.length = given

    def image_at(self, timestamp_s: float) -> Array | None:
        """One frame by its time, (h, w, 3) uint8 RGB, the nearest of the file; None where none decodes.

        It is decoded from the key frame before it; fields of interlaced video are not taken apart.
        """
        contents = self._contents
        at = int(np.abs(contents.times_s - timestamp_s).argmin())
        with _opened(self._path) as (container, stream):
            try:
                if contents.timed:
                    container.seek(int(contents.times_s[at] / stream.time_base), stream=stream)
                for counted, frame in enumerate(container.decode(stream)):
                    if self._placed(frame, counted).index >= at:
                        return self._rgb(frame)
            except av.FFmpegError:
                return None
        return None

    def truth(self) -> Truth | None:
        """A video knows nothing about itself."""
        return None

    def _rgb(self, frame: Any) -> Array:
        """The decoded frame as it is shown: square pixels, upright, (h, w, 3) uint8."""
        aspect = self._contents.pixel_aspect
        width = round(frame.width * aspect)
        if width != frame.width:
            self._notes.put("aspect", f"pixels are {aspect} as wide as high: stretched to {width}x{frame.height}")
            frame = frame.reformat(width=width, height=frame.height, format="rgb24" if self._grey is None else GREY)
        image: Array
        if self._grey is None:
            image = frame.to_ndarray(format="rgb24")
        else:
            image = np.repeat(self._grey.as_8_bit(frame.to_ndarray(format=GREY))[..., None], 3, axis=2)
        if self._turn != UPRIGHT:
            self._notes.put("turn", "turned upright as the video's rotation metadata says")
        return turned(image, self._turn)

    def _grey_range(self) -> GreyRange | None:
        """The levels that the window's frames use, by some of them; None where they are read as any other video."""
        levels = (f.to_ndarray(format=GREY) for f in _frames_at(self._path, self._contents, spread(self._chosen)))
        found = range_of(levels)
        if found is not None:
            self._notes.put("grey", found.note)
        return None if found is None or found.whole else found

    def _decoded(self, note_end: bool) -> Iterator[_Decoded]:
        """All frames that decode whole, from the first of the file to the last of the window.

        From a broken packet's time on, frames are left out up to the next key frame: they build on what is
        lost.
        """
        last: _Decoded | None = None
        broken_s: list[float] = []
        building_on_s: float | None = None  # time of the loss that later frames may build on
        counted = 0
        with _opened(self._path) as (container, stream):
            for item in _frames_and_losses(container, stream, self._contents.doubtful):
                if isinstance(item, _Loss):
                    at = self._contents.times_s[0] if item.timestamp_s is None else item.timestamp_s
                    building_on_s = at if building_on_s is None else max(at, building_on_s)
                    broken_s.append(at)
                    continue
                d = self._placed(item, counted)
                counted += 1
                if building_on_s is not None and d.timestamp_s >= building_on_s and item.key_frame:
                    building_on_s = None
                if item.is_corrupt or (building_on_s is not None and d.timestamp_s >= building_on_s):
                    broken_s.append(d.timestamp_s)
                    continue
                if last is not None and d.timestamp_s <= last.timestamp_s:
                    self._notes.put("doubled", "frames without a presentation time of their own are left out")
                    continue
                if d.index > self._chosen[-1]:
                    note_end = False
                    break
                last = d
                yield d
        if broken_s:
            at, lost = min(broken_s), len(broken_s)
            self._notes.put("broken", f"video is broken at {at:.3f} s: frames left out because of it: {lost}")
        if note_end and last is not None:
            self._note_cut(last)

    def _placed(self, frame: Any, counted: int) -> _Decoded:
        """Index and time of a frame; in a file without presentation times, by counting."""
        contents = self._contents
        if not contents.timed or frame.pts is None:
            return _Decoded(counted, counted * contents.frame_s, frame)
        t = float(frame.pts * frame.time_base)
        at = int(np.searchsorted(contents.times_s, t - 1e-6).clip(0, len(contents.times_s) - 1))
        return _Decoded(at, t, frame)

    def _note_cut(self, last: _Decoded) -> None:
        """Tell where a file stops before the end that its header promises."""
        end_s = self._contents.cut_before_s
        if end_s is None or self._chosen[-1] + self._chosen.step < len(self._contents.times_s):
            return
        self._notes.put(
            "cut",
            f"video is cut short: it stops after frame {last.index} ({last.timestamp_s:.3f} s), "
            f"its header promises {end_s:.3f} s",
        )


@contextmanager
def _converting(path: Path) -> Iterator[None]:
    """Raises InputError for sizes and formats that FFmpeg decodes, and then does not convert."""
    try:
        yield
    except av.FFmpegError as e:
        got = " ".join(str(e).split())
        raise InputError(f"{path}: expected pictures that can be shown as RGB, got some that cannot ({got})") from e


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """The container and its first real video stream. Raises InputError."""
    try:
        container = av.open(str(resolved(path)), container_options=LOCAL_ONLY, **BAD_METADATA)
    except av.FFmpegError as e:
        raise InputError(f"{path}: {_why_not(path)}") from e
    with container:
        if container.format.name == "image2" or container.format.name.endswith("_pipe"):
            raise InputError(f"{path}: expected a video or a folder of images, got a single image")
        stream = next((s for s in container.streams.video if s.codec_context and not _is_picture(s)), None)
        if stream is None:
            raise InputError(
                f"{path}: expected a video, got a {container.format.name} file without moving pictures that can be read"
            )
        check_pixels((stream.codec_context.width, stream.codec_context.height), str(path))
        yield container, stream


def _is_picture(stream: Any) -> bool:
    """Cover art of a sound file, and text that the library would draw, are no video."""
    disposition = getattr(stream, "disposition", 0)  # PyAV 14.0 does not tell
    return bool(disposition & ATTACHED_PICTURE) or stream.codec_context.name == "ansi"


def _why_not(path: Path) -> str:
    try:
        with path.open("rb") as f:
            head = f.read(16)
    except OSError as e:
        return f"expected a video, got {why(e)}"
    if not head:
        return "expected a video, got an empty file"
    if head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide"):
        return "expected a whole video, got an mp4/mov file cut short (its index, moov, is missing)"
    return f"expected a video, a folder of images or a TUM-layout folder, got a file beginning {head[:8]!r}"


def _read_contents(path: Path) -> _Contents:
    """Times of all whole packets, without decoding. Raises InputError."""
    with _opened(path) as (container, stream):
        rate = stream.average_rate or stream.guessed_rate or FALLBACK_FPS
        stamps: list[int | None] = []
        tail: Any = None
        for tail in (p for p in _packets(container, stream) if p.size):
            if not _unshown(tail):
                stamps.append(tail.pts)
        if not stamps:
            raise InputError(f"{path}: expected a video, got a file without a whole frame in it")
        timed = None not in stamps
        times = _times_of(stamps, stream.time_base, float(1 / rate))
        steps = np.diff(times) if len(times) > 1 else np.array([float(1 / rate)])
        frame_s, end = float(np.median(steps)), _promised_end_s(container, stream)
        cut = end is not None and end - (times[-1] + frame_s) > max(2 * frame_s, float(steps.max()))
        doubtful = None
        if cut and timed and not tail.is_corrupt and len(stamps) > 1:
            # not every container tells that its last packet is only half there
            doubtful = stamps.pop()
            times = _times_of(stamps, stream.time_base, frame_s)
        aspect = stream.sample_aspect_ratio or Fraction(1)
        shown_px = (round(stream.codec_context.width * aspect), stream.codec_context.height)
        check_pixels(shown_px, f"{path}, stretched as it asks for")
        order = int(getattr(stream.codec_context, "field_order", 0))  # PyAV 14 does not tell
        return _Contents(times, timed, frame_s, end if cut else None, doubtful, aspect, order)


def _times_of(stamps: list[int | None], time_base: Fraction, frame_s: float) -> Array:
    """Ascending seconds; where some packet has no time, all are counted."""
    known = sorted(p for p in stamps if p is not None)
    if len(known) < len(stamps):
        return np.arange(len(stamps)) * frame_s
    return np.array([float(p * time_base) for p in known])


def _promised_end_s(container: Any, stream: Any) -> float | None:
    """Where the header says that the pictures end; None where it speaks of nothing or of the sound too."""
    if stream.duration is not None:
        return float((stream.duration + (stream.start_time or 0)) * stream.time_base)
    tag = re.fullmatch(r"(\d+):(\d+):(\d+\.?\d*)", stream.metadata.get("DURATION", ""))  # Matroska
    if tag is not None:
        return 3600 * int(tag[1]) + 60 * int(tag[2]) + float(tag[3])
    if container.duration is not None and len(container.streams) == 1:
        return float(container.duration + (container.start_time or 0)) / av.time_base
    return None


def _unshown(packet: Any) -> bool:
    return packet.is_corrupt or packet.is_discard


def _packets(container: Any, stream: Any) -> Iterator[Any]:
    """The stream's packets up to the end, or to the place where the file breaks off."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except (StopIteration, av.FFmpegError):
            return
        yield packet


def _frames_and_losses(container: Any, stream: Any, doubtful: int | None) -> Iterator[Any]:
    """Decoded frames in presentation order, and a _Loss for each packet that does not decode."""
    flushed = False
    for packet in _packets(container, stream):
        flushed = packet.size == 0
        loss = _Loss(None if packet.pts is None else float(packet.pts * packet.time_base))
        if packet.is_corrupt or (doubtful is not None and packet.pts == doubtful):
            yield loss
            continue
        try:
            frames = packet.decode()
        except av.FFmpegError:
            yield loss
            continue
        yield from frames
    if not flushed:  # the file broke off; frames that wait in the decoder are whole
        try:
            frames = stream.decode(None)
        except av.FFmpegError:
            return
        yield from frames


def _is_deep_grey(frame: Any) -> bool:
    """Whether pixels have one channel of more than 8 bits, of which other videos keep the upper ones."""
    components = frame.format.components
    return len(components) == 1 and components[0].bits > 8


def _frames_at(path: Path, contents: _Contents, indices: list[int]) -> Iterator[Any]:
    """A decoded frame near each index: the key frame before it, where the container can be searched."""
    with _opened(path) as (container, stream):
        for at_s in contents.times_s[indices]:
            try:
                container.seek(int(at_s / stream.time_base), stream=stream)
                yield next(container.decode(stream))
            except (av.FFmpegError, StopIteration):
                continue
