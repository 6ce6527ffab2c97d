"""Checkpoints: objects on disk that a killed run goes on from. What has not changed is not written again.

A checkpoint is one small file, ``state-N.ckpt``, and arrays in ``arrays-M.bin``, which only grows: an array is known by
its digest and stored once. A state is written whole or not at all, after the arrays that it names, and the one before
stays until then. Everything is checked by digests when it is read, and nothing but our own plain data is ever made of
it: a checkpoint is not code.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import os
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..reading.files import is_dir
from ..types import WorkFrame
from .files import replacing, writing

log = logging.getLogger(__name__)
FORMAT = 2  # of the files, and of what is in them
MAGIC = b"mastd3r checkpoint\n"
IN_BAND_BYTES = 2048  # an array that is smaller stands in the state itself
GARBAGE_RATIO, GARBAGE_BYTES = 2.0, 2**26  # file size over what is used, and at least so much: written anew
PACKAGE = __name__.partition(".")[0]
OURS: dict[str, set[str] | None] = {  # module of ours: classes that may be made
    "config": None,  # None: all that it defines
    "dynamics.config": None,
    "types": None,
    "dynamics.appearance": {"AppearanceClassifier"},
    "dynamics.filter": {"FilterMemory", "_Arrival"},
    "dynamics.motion_test": {"Past"},
    "features.learned": {"FeatureMemory"},
    "graph.bundle_adjustment": {"SolveReport"},
    "graph.factors": None,
    "graph.intrinsics": {"Intrinsics"},
    "graph.keyframe_graph": None,
    "offline.final_solve": {"FinalFrame"},
    "offline.checkpoints": {"Memory", "JobMemory"},
    "tracking.memory": {"TrackingMemory"},
    "tracking.state": {"Status", "TrackedFrame", "TrackingState"},
}
OTHERS = {
    ("numpy", "ndarray"), ("numpy", "dtype"), ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.numeric", "_frombuffer"), ("numpy.core.multiarray", "_reconstruct"),
    ("numpy.core.numeric", "_frombuffer"), ("numpy._core.multiarray", "scalar"), ("numpy.core.multiarray", "scalar"),
    ("collections", "deque"), ("collections", "OrderedDict"),
}  # fmt: skip


@dataclass(frozen=True)
class _Blob:
    """Where an array lies in the file."""

    offset: int
    length: int
    digest: bytes


class CheckpointStore:
    """Writes and reads the checkpoints of one run in a folder of its own. ``version`` is the program's."""

    def __init__(self, folder: Path, version: str) -> None:
        self.folder, self.version = folder, version
        self._number, self._file = 0, 0  # of the next state, and of the file of arrays
        self._known: dict[bytes, _Blob] = {}
        self._end = 0  # bytes in the file of arrays
        self._frames: dict[int, tuple[WorkFrame, _Blob]] = {}  # by id: frames do not change

    def save(self, memory: Any) -> None:
        """Write a checkpoint. Raises OutputError; what was there before is then still good."""
        with writing(self.folder):
            if self._number == 0:  # none that is good was found
                remove_checkpoints(self.folder)
            self.folder.mkdir(exist_ok=True)
        used: list[_Blob] = []
        with writing(self.folder), open(self._arrays(), "ab") as file:
            file.truncate(self._end)
            body = self._pickled(memory, file, used)
            file.flush()
            os.fsync(file.fileno())
        head = {
            "format": FORMAT,
            "version": self.version,
            "arrays": self._arrays().name,
            "blobs": [[b.offset, b.length, b.digest.hex()] for b in used],
            "body": hashlib.sha256(body).hexdigest(),
        }
        text = json.dumps(head).encode()
        with replacing(self._state(self._number)) as part, open(part, "wb") as file:
            file.write(MAGIC + len(text).to_bytes(8, "little") + text + hashlib.sha256(text).digest() + body)
            file.flush()
            os.fsync(file.fileno())
        self._number += 1
        self._tidy({b.digest: b.length for b in used})

    def load(self) -> Any | None:
        """The newest good checkpoint; None where there is none. What is damaged, or of another version, is said."""
        for path in sorted(self.folder.glob("state-*.ckpt"), key=_number_of, reverse=True):
            try:
                memory = self._read(path)
            except (InputError, OSError, ValueError, TypeError, KeyError, pickle.UnpicklingError, EOFError) as e:
                log.warning("%s: not used: %s", path.name, " ".join(str(e).split()))
                continue
            self._number = _number_of(path) + 1
            return memory
        return None

    def remove(self) -> None:
        """Nothing of it is needed any more."""
        with writing(self.folder):
            remove_checkpoints(self.folder)

    # -- writing ---------------------------------------------------------------------------------------------

    def _arrays(self) -> Path:
        return self.folder / f"arrays-{self._file}.bin"

    def _state(self, number: int) -> Path:
        return self.folder / f"state-{number}.ckpt"

    def _stored(self, data: Any, file: Any, used: list[_Blob]) -> int:
        """The place among ``used`` of some bytes, which are written where they are not there yet."""
        digest = hashlib.blake2b(data, digest_size=16).digest()
        blob = self._known.get(digest)
        if blob is None:
            blob = self._known[digest] = _Blob(self._end, len(data), digest)
            file.write(data)
            self._end += len(data)
        used.append(blob)
        return len(used) - 1

    def _pickled(self, memory: Any, file: Any, used: list[_Blob]) -> bytes:
        """``memory`` without its arrays and frames; those are in ``file``, in the order of ``used``."""
        out, arrays, frames = io.BytesIO(), list[Any](), dict[int, int]()

        def keep(buffer: pickle.PickleBuffer) -> bool:
            raw = buffer.raw()
            if raw.nbytes < IN_BAND_BYTES:
                return True
            arrays.append(raw)
            return False

        def frame_at(frame: WorkFrame) -> int:
            if id(frame) not in frames:
                known = self._frames.get(id(frame))
                if known is None or known[1].digest not in self._known:
                    at = self._stored(pickle.dumps(frame, 5), file, used)
                    self._frames[id(frame)] = frame, used[at]
                else:
                    used.append(known[1])
                    at = len(used) - 1
                frames[id(frame)] = at
            return frames[id(frame)]

        _Pickler(out, frame_at, keep).dump(memory)
        order = [self._stored(raw, file, used) for raw in arrays]
        self._frames = {k: v for k, v in self._frames.items() if k in frames}
        return pickle.dumps((order, out.getvalue()), 5)

    def _tidy(self, live: dict[bytes, int]) -> None:
        """Remove states before the last two, and begin a new file of arrays where most of this one is not used."""
        for path in self.folder.glob("state-*.ckpt"):
            if _number_of(path) < self._number - 2:
                path.unlink()
        for path in self.folder.glob("arrays-*.bin"):
            if _number_of(path) < self._file - 1:
                path.unlink()
        if self._end > GARBAGE_RATIO * sum(live.values()) + GARBAGE_BYTES:
            self._file, self._end = self._file + 1, 0
            self._known, self._frames = {}, {}

    # -- reading ---------------------------------------------------------------------------------------------

    def _read(self, path: Path) -> Any:
        with open(path, "rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise InputError("expected a checkpoint, got another file")
            length = int.from_bytes(file.read(8), "little")
            text, digest, body = file.read(min(length, 2**30)), file.read(32), file.read()
        if hashlib.sha256(text).digest() != digest:
            raise InputError("expected a whole checkpoint, got a damaged one")
        head = json.loads(text)
        if head["version"] != self.version:
            raise InputError(f"expected one of version {self.version}, got version {head['version']}")
        if head["format"] != FORMAT:
            raise InputError(f"expected one in format {FORMAT}, got format {head['format']}")
        if hashlib.sha256(body).hexdigest() != head["body"]:
            raise InputError("expected a whole checkpoint, got a damaged one")
        arrays = Path(str(head["arrays"])).name
        blobs: list[bytearray] = []
        with open(self.folder / arrays, "rb") as file:
            for offset, size, known in head["blobs"]:
                file.seek(offset)
                data = bytearray(file.read(size))
                if hashlib.blake2b(data, digest_size=16).hexdigest() != known:
                    raise InputError(f"expected the arrays of {arrays}, got damaged ones")
                blobs.append(data)
        order, inner = _Unpickler(io.BytesIO(body), [], []).load()
        self._file = _number_of(Path(arrays)) + 1  # what follows is written beside what has been read
        return _Unpickler(io.BytesIO(inner), blobs, [blobs[n] for n in order]).load()


def remove_checkpoints(folder: Path) -> None:
    """Remove the files of checkpoints, and the folder if that was all. Raises OSError."""
    if not is_dir(folder):
        return
    for path in (*folder.glob("state-*.ckpt*"), *folder.glob("arrays-*.bin")):
        path.unlink()
    if not any(folder.iterdir()):
        folder.rmdir()


def _number_of(path: Path) -> int:
    digits = path.stem.rpartition("-")[2]
    return int(digits) if digits.isdigit() else -1


class _Pickler(pickle.Pickler):
    """Frames by their place among the blobs, arrays beside the stream."""

    def __init__(
        self, file: Any, frame_at: Callable[[WorkFrame], int], keep: Callable[[pickle.PickleBuffer], bool]
    ) -> None:
        super().__init__(file, 5, buffer_callback=keep)
        self._frame_at = frame_at

    def persistent_id(self, obj: Any) -> int | None:
        return self._frame_at(obj) if isinstance(obj, WorkFrame) else None


class _Unpickler(pickle.Unpickler):
    """Makes plain data of ours and of NumPy's, and nothing else."""

    def __init__(self, file: Any, blobs: list[bytearray], buffers: list[bytearray]) -> None:
        super().__init__(file, buffers=buffers)
        self._blobs = blobs
        self._frames: dict[int, WorkFrame] = {}

    def persistent_load(self, at: int) -> WorkFrame:
        if at not in self._frames:
            frame = _Unpickler(io.BytesIO(self._blobs[at]), [], []).load()
            if not isinstance(frame, WorkFrame):
                raise InputError(f"expected a frame, got {type(frame).__name__}")
            self._frames[at] = frame
        return self._frames[at]

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in OTHERS:
            return super().find_class(module, name)
        package, _, inner = module.partition(".")
        names = OURS.get(inner, set())
        if package == PACKAGE and (names is None or name in names):
            found = super().find_class(module, name)
            if isinstance(found, type) and found.__module__ == module:
                return found
        raise InputError(f"expected plain data, got {module}.{name}")
