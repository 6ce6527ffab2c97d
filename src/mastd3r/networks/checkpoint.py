"""Weights of MASt3R from a file, without running anything that the file says.

Two formats are read: safetensors, and the archive that ``torch.save`` writes, as released. The latter holds a pickle;
it is read by torch's restricted unpickler, which may build tensors, plain containers and ``argparse.Namespace`` (the
training options beside the weights, of which nothing is used) and refuses everything else. The network is built from
our own constants, never from a text in the file.
"""

from __future__ import annotations

import pickle
import struct
import zipfile
import zlib
from argparse import Namespace
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ..errors import InputError, MissingPackage
from ..reading.files import check_plain
from .mast3r import Mast3r, Mast3rConfig

ARCHIVE_MAGIC = b"PK\x03\x04"
MAX_HEADER_BYTES = 100_000_000  # limit of the safetensors format
ARCHIVE_SUFFIXES = {".pth", ".pt", ".ckpt", ".bin"}
SHOWN_NAMES = 3

# What torch's archive reader and restricted unpickler raise on damaged bytes.
UNREADABLE = (
    pickle.UnpicklingError, zipfile.BadZipFile, zlib.error, struct.error, RuntimeError, ValueError, TypeError, EOFError,
    LookupError, AttributeError, AssertionError, OSError, ImportError, OverflowError, MemoryError,
)  # fmt: skip


class CheckpointError(InputError):
    """A weights file that is damaged, unsafe, or of another network."""


def load_mast3r(path: Path, config: Mast3rConfig | None = None) -> Mast3r:
    """The network with the weights of a file: float32, on the CPU, ready for inference. Sizes: the released ones.

    Raises CheckpointError with one line for anything that is not exactly this network's weights.
    """
    with torch.device("meta"):
        model = Mast3r(config or Mast3rConfig.released())
    model.load_state_dict(accounted_state(model, read_state(path), path), assign=True)
    return model.requires_grad_(False).eval()


def read_state(path: Path) -> dict[str, Tensor]:
    """Name -> tensor of a safetensors file or a torch archive; tensors are floating, dense, finite and on the CPU.

    What the file is, is read from its first bytes; a suffix that says otherwise is refused.
    Raises CheckpointError, and MissingPackage for safetensors without its package.
    """
    kind = _kind(path)
    state = _read_safetensors(path) if kind == "safetensors" else _read_archive(path)
    for name, value in state.items():
        if not isinstance(name, str) or not isinstance(value, Tensor):
            raise CheckpointError(
                f"weights {path}: expected names and tensors, got {type(value).__name__} under {str(name)[:80]!r}"
            )
        if value.layout != torch.strided or not value.is_floating_point() or value.device.type != "cpu":
            raise CheckpointError(
                f"weights {path}: expected a dense floating tensor under {name!r}, got {value.dtype}, {value.layout}"
            )
    return state


def accounted_state(model: nn.Module, state: Mapping[str, Tensor], path: Path) -> dict[str, Tensor]:
    """Every name of ``model`` with its float32 tensor; nothing may be missing, left over, misshapen or not finite.

    Names that share one tensor in the model may be given once; given twice, they must agree. Raises CheckpointError.
    """
    expected = model.state_dict(keep_vars=True)
    groups: dict[int, list[str]] = {}
    for name, value in expected.items():
        groups.setdefault(id(value), []).append(name)
    given = {name: [n for n in group if n in state] for group in groups.values() for name in group}
    missing = [name for name in expected if not given[name]]
    unexpected = [name for name in state if name not in expected]
    shapes = [
        f"{name}: expected {tuple(value.shape)}, got {tuple(state[name].shape)}"
        for name, value in expected.items()
        if name in state and state[name].shape != value.shape
    ]
    faults = [
        _listed("missing", missing),
        _listed("unexpected", unexpected),
        _listed("of another shape", shapes, "; "),
    ]
    if any(faults):
        raise CheckpointError(
            f"weights {path}: expected the {len(expected)} names of MASt3R (ViT-L, catmlp+dpt); "
            + " · ".join(f for f in faults if f)
        )
    result: dict[str, Tensor] = {}
    for group in groups.values():
        value = _float32(state, given[group[0]], path)
        result.update(dict.fromkeys(group, value))
    return result


def _float32(state: Mapping[str, Tensor], names: list[str], path: Path) -> Tensor:
    """The one tensor behind names that share it."""
    value = state[names[0]].detach().float().contiguous()
    if not torch.isfinite(value).all():
        raise CheckpointError(f"weights {path}: expected finite numbers, got inf or nan in {names[0]}")
    for other in names[1:]:
        if not torch.equal(state[other].float(), value):
            raise CheckpointError(f"weights {path}: expected {names[0]} and {other} to be equal, they differ")
    return value


def _listed(what: str, names: list[str], between: str = ", ") -> str:
    if not names:
        return ""
    more = f"{between}…" if len(names) > SHOWN_NAMES else ""
    return f"{len(names)} {what} ({between.join(n[:120] for n in names[:SHOWN_NAMES])}{more})"


def _kind(path: Path) -> str:
    """ "archive" or "safetensors" by the first bytes."""
    check_plain(path, "weights", CheckpointError)
    try:
        with path.open("rb") as file:
            head = file.read(9)
    except OSError as e:
        raise CheckpointError(f"weights {path}: expected a readable file, got {e.strerror or e}") from e
    kind = ""
    if head.startswith(ARCHIVE_MAGIC):
        kind = "archive"
    elif len(head) == 9 and head[8:] == b"{" and struct.unpack("<Q", head[:8])[0] <= MAX_HEADER_BYTES:
        kind = "safetensors"
    if not kind:
        raise CheckpointError(f"weights {path}: expected safetensors or a torch archive (.pth), got {_guess(head)}")
    suffix = path.suffix.lower()
    if (kind == "safetensors" and suffix in ARCHIVE_SUFFIXES) or (kind == "archive" and suffix == ".safetensors"):
        right = ".safetensors" if kind == "safetensors" else ".pth"
        raise CheckpointError(f"weights {path}: expected what the suffix says, its content is that of {right}")
    return kind


def _guess(head: bytes) -> str:
    if not head:
        return "an empty file"
    if head[:1] == b"\x80":
        return "a bare pickle, which is not read"
    if head.lstrip()[:1] == b"<":
        return "a web page"
    return "a git-lfs pointer" if head.startswith(b"version ") else f"a file that begins with {head[:8]!r}"


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    try:
        from safetensors import SafetensorError
        from safetensors.torch import load_file
    except ImportError as e:
        raise MissingPackage("safetensors weights need a package: pip install 'mastd3r-slam[networks]'") from e
    try:
        return load_file(path)
    except (SafetensorError, *UNREADABLE) as e:
        raise CheckpointError(f"weights {path}: expected a whole safetensors file, got {_one_line(e)}") from e


def _read_archive(path: Path) -> dict[str, Tensor]:
    """The entry "model" of a torch archive, or the archive itself where it is a plain state."""
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(i.file_size for i in archive.infolist()) > path.stat().st_size:
                raise CheckpointError(
                    f"weights {path}: expected parts as they are, as torch writes them, got packed ones"
                )
            damaged = archive.testzip()  # torch does not compare checksums
    except UNREADABLE as e:
        raise CheckpointError(f"weights {path}: expected a whole torch archive, got {_one_line(e)}") from e
    if damaged is not None:
        raise CheckpointError(f"weights {path}: expected a whole torch archive, got wrong bytes in its part {damaged}")
    try:
        with _only_namespace_allowed():
            content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as e:
        raise CheckpointError(
            f"weights {path}: refused, nothing was run: expected tensors and plain containers only, got {_asked_for(e)}"
        ) from e
    except UNREADABLE as e:
        raise CheckpointError(f"weights {path}: expected a torch archive of weights, got {_one_line(e)}") from e
    if isinstance(content, dict) and isinstance(content.get("model"), dict):
        content = content["model"]
    if not isinstance(content, dict):
        raise CheckpointError(f"weights {path}: expected a dictionary of tensors, got {type(content).__name__}")
    return dict(content)


@contextmanager
def _only_namespace_allowed() -> Iterator[None]:
    """What this process has allowed the unpickler elsewhere does not count here."""
    before: list[Any] = torch.serialization.get_safe_globals()
    torch.serialization.clear_safe_globals()
    torch.serialization.add_safe_globals([Namespace])
    try:
        yield
    finally:
        torch.serialization.clear_safe_globals()
        torch.serialization.add_safe_globals(before)


def _asked_for(error: Exception) -> str:
    """The part of torch's long message that names the refused object."""
    for line in str(error).splitlines():
        if "GLOBAL" in line or "Unsupported" in line or "Can only" in line or "Trying to" in line:
            return " ".join(line.split())[:200]
    return _one_line(error)


def _one_line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}"[:200] if text else type(error).__name__
