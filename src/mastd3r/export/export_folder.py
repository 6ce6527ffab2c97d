"""The folder that an export or a saved map is: whole or not at all, and never at the cost of anybody's files."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError, OutputError
from ..reading.files import whole_json
from .claim import ANOTHER, refuse_inputs
from .files import write_json, writing


@dataclass(frozen=True)
class FolderKind:
    """How a folder of ours is known again: one kind never takes the place of another."""

    record: str  # its JSON file: what it is, and the files that it wrote
    made_by: str
    said: str  # in messages


EXPORT = FolderKind("export.json", "mastd3r export", "an earlier export")


@contextmanager
def export_folder(
    out: Path, facts: Mapping[str, Any], inputs: Sequence[Path], kind: FolderKind = EXPORT
) -> Iterator[Path]:
    """A new folder beside ``out`` for the body to write in; it takes the place of ``out`` once the body is done.

    Where the body stops, nothing of it stays. ``out`` may be missing, empty, or an earlier folder of the same ``kind``
    with nothing added. ``facts`` go to its record, as they are when the body is done; ``inputs`` are what is read.
    Raises OutputError, before anything is written, for any other folder, a symbolic link, and one that holds an input
    or lies in one.
    """
    with writing(out):
        refuse_inputs(out, inputs)
        _check(out, kind)
        out.parent.mkdir(parents=True, exist_ok=True)
        staged = out.with_name(f".{out.name}.{os.getpid()}.part")
        staged.mkdir()
        try:
            yield staged
            files = sorted(_walked(staged))
            write_json(staged / kind.record, {"made_by": kind.made_by, **facts, "files": files})
            _replace(out, staged)
        except BaseException:
            with suppress(OSError):
                shutil.rmtree(staged)
            raise


def _check(out: Path, kind: FolderKind) -> None:
    """Raise OutputError for a place where something else than an earlier folder of this kind is."""
    if out.name in ("", ".."):  # what takes its place is made beside it
        raise OutputError(f"{out}: expected a folder with a name of its own, got none; {ANOTHER}")
    if out.is_symlink() or (out.exists() and not out.is_dir()):
        what = "a symbolic link" if out.is_symlink() else "a file"
        raise OutputError(f"{out}: expected to write a folder, got {what}; {ANOTHER}")
    if not out.exists() or not any(out.iterdir()):
        return
    ours = _files_of(out, kind)
    first = next((p for p in _walked(out) if p not in ours), None)
    if first is not None:
        raise OutputError(f"{out}: expected an empty folder or {kind.said}, got one with {first}; {ANOTHER}")


def _walked(out: Path) -> Iterator[str]:
    """Its files, links among them, one by one: what is asked for may be somebody's whole home. Raises OSError."""

    def unreadable(error: OSError) -> None:
        raise error

    for folder, folders, names in os.walk(out, onerror=unreadable):
        folders.sort()
        linked = [name for name in folders if (Path(folder) / name).is_symlink()]
        yield from ((Path(folder) / name).relative_to(out).as_posix() for name in sorted(names + linked))


def _files_of(out: Path, kind: FolderKind) -> set[str]:
    """Files that an earlier one wrote; empty where there was none."""
    try:
        record = whole_json(out / kind.record)
    except InputError:
        return set()
    if record.get("made_by") != kind.made_by or not isinstance(record.get("files"), list):
        return set()
    return {kind.record, *map(str, record["files"])}


def _replace(out: Path, staged: Path) -> None:
    """``staged`` takes the place of ``out``, which ``_check`` has let pass."""
    before = staged.with_suffix(".before")
    if out.exists():
        os.replace(out, before)
    try:
        os.replace(staged, out)
    except BaseException:
        if before.exists():
            os.replace(before, out)
        raise
    if before.exists():
        shutil.rmtree(before)
