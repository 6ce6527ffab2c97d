"""Bringing sequences of a dataset to a folder: fetch, check, unpack beside, move into place.

    TO/DATASET/...              as the archives unpack: what the loaders know
    TO/DATASET/dataset.json     home page, licence, when it was agreed with, and which sequences are whole
    TO/DATASET/archives/        what is being fetched, and archives that hold further sequences

A sequence is whole or it is not there: its files are unpacked into a folder of their own first.
"""

from __future__ import annotations

import difflib
import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ..errors import ConfigError, InputError, OutputError
from ..reading.files import is_dir, is_file, whole_json
from .archives import Damaged, unpack
from .dataset_types import Archive, Dataset, Part, Sequence
from .datasets_known import KNOWN
from .fetch import Progress, Wanted, fetch

RECORD, ARCHIVES, ALL = "dataset.json", "archives", "all"
Accept = Callable[[Dataset], bool]
Watch = Callable[[str], Progress]  # what is being done -> where its progress is told


@dataclass(frozen=True)
class Brought:
    """One sequence that is there now."""

    name: str
    path: Path
    fetched: bool  # False: it was there before


def dataset_of(name: str) -> Dataset:
    """Raises ConfigError for a name that is not known, with the nearest that is."""
    if name in KNOWN:
        return KNOWN[name]
    near = difflib.get_close_matches(name, KNOWN, n=1)
    hint = f"; perhaps you meant {near[0]}" if near else ""
    raise ConfigError(f"{name}: expected one of {', '.join(KNOWN)}, got another dataset{hint}")


def sequences_of(dataset: Dataset, names: Iterable[str]) -> list[Sequence]:
    """Sequences by name, each once; ``all``, and for 7-Scenes a scene, stand for several. Raises ConfigError."""
    chosen: dict[str, Sequence] = {}
    for name in names:
        short = name.strip("/").removeprefix(dataset.prefix)
        inside = [s for n, s in dataset.sequences.items() if short in (ALL, n, n.partition("/")[0])]
        if not inside:
            near = difflib.get_close_matches(short, dataset.sequences, n=3, cutoff=0.5)
            hint = f"perhaps {', '.join(near)}" if near else f"mastd3r download {dataset.name} lists them"
            raise ConfigError(f"{name}: expected a sequence of {dataset.name}, got another; {hint}")
        chosen |= {s.name: s for s in inside}
    return list(chosen.values())


def download(
    dataset: Dataset, names: Iterable[str], to: Path, accept: Accept, *, watch: Watch | None = None
) -> list[Brought]:
    """Bring sequences to ``to``/``dataset.name``; those that are whole are left alone.

    ``accept`` is asked once per folder, before anything is fetched. An archive of one sequence is removed when it is
    unpacked, one that holds others too is kept. Raises ConfigError (no such sequence, licence declined), InputError
    (network, damaged archive: removed, nothing of it is left), OutputError (disk).
    """
    chosen = sequences_of(dataset, names)
    folder = to.expanduser() / dataset.name
    record = _read_record(folder)
    _agree(dataset, folder, record, accept)
    brought = []
    for sequence in chosen:
        there = _is_whole(folder, sequence, record)
        if not there:
            _bring(dataset, sequence, folder, watch)
            record["sequences"][sequence.name] = {"folder": sequence.folder, "unpacked": _now()}
            _write_record(folder, record)
        brought.append(Brought(sequence.name, folder / sequence.folder, not there))
    with suppress(OSError):
        (folder / ARCHIVES).rmdir()  # where it is empty
    return brought


def kept_archives(dataset: Dataset, to: Path) -> list[Path]:
    """Archives that were kept because further sequences can come out of them."""
    names = {a.file_name for a in dataset.archives.values()}
    folder = to.expanduser() / dataset.name / ARCHIVES
    return sorted(p for p in folder.iterdir() if p.name in names) if is_dir(folder) else []


def _bring(dataset: Dataset, sequence: Sequence, folder: Path, watch: Watch | None) -> None:
    """Fetch what a sequence needs and put it into place."""
    for part in sequence.parts:
        archive = dataset.archives[part.archive]
        file = _fetched(dataset, archive, folder / ARCHIVES / archive.file_name, watch)
        try:
            _unpack_part(file, part, folder, watch)
        except Damaged as e:
            file.unlink(missing_ok=True)
            raise InputError(f"{e}; it was removed, the same command fetches it again") from e
        if part.archive not in dataset.shared:
            file.unlink(missing_ok=True)
    if not is_dir(folder / sequence.folder):
        raise InputError(f"{dataset.name} {sequence.name}: expected {sequence.folder} in its archives, got others")


def _fetched(dataset: Dataset, archive: Archive, file: Path, watch: Watch | None) -> Path:
    """The archive's file; one that is there was whole when it got its name."""
    if not is_file(file) or archive.size_bytes not in (None, file.stat().st_size):
        want = Wanted(size_bytes=archive.size_bytes, md5=archive.md5)
        fetch(f"{dataset.root}/{archive.path}", file, want, progress=watch(file.name) if watch else None)
    return file


def _unpack_part(file: Path, part: Part, folder: Path, watch: Watch | None) -> None:
    """Unpack beside, then move into place: what is damaged leaves nothing behind."""
    with _scratch(folder / f".unpacking-{file.name}") as inner:
        unpack(file, inner, part.only, watch(f"unpacking {file.name}") if watch else None)
        if part.nested:
            for nested in sorted(inner.rglob("*.zip")):
                unpack(nested, nested.parent, progress=watch(f"unpacking {nested.name}") if watch else None)
                nested.unlink()
        try:
            _move_into(inner, folder)
        except OSError as e:
            raise OutputError(f"{folder}: expected to write, got {e.strerror or e}") from e


@contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    """An empty folder for the length of a ``with``; what a killed command has left there is removed."""
    try:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    except OSError as e:
        raise OutputError(f"{folder.parent}: expected a folder to write to, got {e.strerror or e}") from e
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _move_into(source: Path, target: Path) -> None:
    """Move all entries; folders that are there are filled, files that are there are replaced. Raises OSError."""
    for entry in source.iterdir():
        place = target / entry.name
        if is_dir(entry) and is_dir(place):
            _move_into(entry, place)
        else:
            os.replace(entry, place)


def _agree(dataset: Dataset, folder: Path, record: dict[str, Any], accept: Accept) -> None:
    """Ask once, and write down home page and licence beside the data. Raises ConfigError where it is no."""
    if record.get("accepted"):
        return
    if not accept(dataset):
        raise ConfigError(f"{dataset.name}: licence not accepted, nothing was fetched")
    record |= {"dataset": dataset.name, "home": dataset.home, "licence": dataset.licence, "accepted": _now()}
    _write_record(folder, record)


def _is_whole(folder: Path, sequence: Sequence, record: dict[str, Any]) -> bool:
    return sequence.name in record["sequences"] and is_dir(folder / sequence.folder)


def _read_record(folder: Path) -> dict[str, Any]:
    record: dict[str, Any] = {}
    with suppress(InputError):
        record = whole_json(folder / RECORD)
    if not isinstance(record.get("sequences"), dict):
        record["sequences"] = {}
    return record


def _write_record(folder: Path, record: dict[str, Any]) -> None:
    part = folder / f"{RECORD}.part"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        part.write_text(json.dumps(record, indent=1), encoding="utf-8")
        os.replace(part, folder / RECORD)
    except OSError as e:
        raise OutputError(f"{folder / RECORD}: expected to write, got {e.strerror or e}") from e


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
