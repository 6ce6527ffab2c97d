"""The folder that an export writes: whole or not at all, and never at the cost of anybody's files."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ..errors import InputError, OutputError
from ..reading.files import whole_json
from .claim import ANOTHER, refuse_inputs
from .files import write_json, writing

RECORD = "export.json"  # of an export: what it is, and the files that it wrote
MADE_BY = "mastd3r export"


@contextmanager
def export_folder(out: Path, facts: Mapping[str, Any], inputs: Sequence[Path]) -> Iterator[Path]:
    """A new folder beside ``out`` for the body to write in; it takes the place of ``out`` once the body is done.

    Where the body stops, nothing of it stays. ``out`` may be missing, empty, or an earlier export with nothing added.
    ``facts`` go to its export.json; ``inputs`` are what is read. Raises OutputError, before anything is written, for
    any other folder, a symbolic link, and one that holds an input or lies in one.
    """
    with writing(out):
        refuse_inputs(out, inputs)
        _check(out)
        out.parent.mkdir(parents=True, exist_ok=True)
        staged = out.with_name(f".{out.name}.{os.getpid()}.part")
        staged.mkdir()
        try:
            yield staged
            files = sorted(p.relative_to(staged).as_posix() for p in staged.rglob("*") if p.is_file())
            write_json(staged / RECORD, {"made_by": MADE_BY, **facts, "files": files})
            _replace(out, staged)
        except BaseException:
            with suppress(OSError):
                shutil.rmtree(staged)
            raise


def _check(out: Path) -> None:
    """Raise OutputError for a place where something else than an earlier export is."""
    if out.is_symlink() or (out.exists() and not out.is_dir()):
        what = "a symbolic link" if out.is_symlink() else "a file"
        raise OutputError(f"{out}: expected to write a folder, got {what}; {ANOTHER}")
    if not out.exists() or not any(out.iterdir()):
        return
    ours = _files_of(out)
    added = [p for p in sorted(out.rglob("*")) if not p.is_dir() and p.relative_to(out).as_posix() not in ours]
    if added:
        first = added[0].relative_to(out).as_posix()
        raise OutputError(f"{out}: expected an empty folder or an earlier export, got one with {first}; {ANOTHER}")


def _files_of(out: Path) -> set[str]:
    """Files that an earlier export wrote; empty where there was none."""
    try:
        record = whole_json(out / RECORD)
    except InputError:
        return set()
    if record.get("made_by") != MADE_BY or not isinstance(record.get("files"), list):
        return set()
    return {RECORD, *map(str, record["files"])}


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
