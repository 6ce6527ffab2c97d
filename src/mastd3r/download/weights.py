"""Weights on this machine: where they lie and whether they are right. ``weights_download`` brings them there.

    HOME/weights/NAME/          the files, and weights.json: where they came from, their sizes and checksums
    HOME/licences.json          which licences were agreed with

HOME is MASTD3R_HOME, else the cache folder of the platform. Files that a user has placed there by hand count.
"""

from __future__ import annotations

import json
import os
import re
import sys
import tempfile
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from ..errors import ConfigError, InputError, OutputError
from ..reading.files import check_plain, entries_of, is_dir, is_file, whole_json
from .fetch import human_bytes, sha256_of
from .weights_known import KNOWN, Known, Origin

RECORD = "weights.json"
TENSORS = (".safetensors", ".pth", ".pt")
NAMELESS = {"model", "pytorch_model", "checkpoint", "weights"}  # file names that do not say what is in them
BY_HAND = "placed by hand"


@dataclass(frozen=True)
class Entry:
    """One line of the list."""

    name: str
    what: str
    licence: str
    size_bytes: int | None
    state: Literal["installed", "incomplete", "absent"]
    folder: Path


@dataclass(frozen=True)
class Checked:
    """What became of one file's check."""

    path: Path
    size_bytes: int
    sha256: str
    expected: str | None  # None: nothing to compare with
    recorded: bool  # its checksum was written down now, for the next check

    @property
    def right(self) -> bool:
        """False where the file is not what was released or fetched."""
        return self.expected in (None, self.sha256)


def home() -> Path:
    """Folder of everything that is fetched: MASTD3R_HOME, else ``mastd3r`` in the platform's cache folder."""
    if chosen := os.environ.get("MASTD3R_HOME"):
        return Path(chosen).expanduser()
    if sys.platform == "win32":
        cache = os.environ.get("LOCALAPPDATA") or _user() / "AppData" / "Local"
    elif sys.platform == "darwin":
        cache = _user() / "Library" / "Caches"
    else:
        cache = os.environ.get("XDG_CACHE_HOME") or _user() / ".cache"
    return Path(cache) / "mastd3r"


def _user() -> Path:
    """The user's own folder; that of the system for the time being, for a user without (in containers)."""
    return Path(own) if (own := os.path.expanduser("~")) != "~" else Path(tempfile.gettempdir())


def folder_of(name: str) -> Path:
    """Where the weights of that name lie, or would."""
    return home() / "weights" / name


def entries() -> list[Entry]:
    """The known weights, then those that a user has added."""
    added = sorted(p.parent.name for p in folder_of("").glob(f"*/{RECORD}") if p.parent.name not in KNOWN)
    return [_entry(name) for name in (*KNOWN, *added)]


def _entry(name: str) -> Entry:
    known, folder, files = KNOWN.get(name), folder_of(name), _present(name)
    size = known.origins[0].files[-1].size_bytes if known else None
    if files is not None:
        size = sum(p.stat().st_size for p in files)
    begun = is_dir(folder) and any(p.suffix in (*TENSORS, ".part") for p in folder.iterdir())
    what = known.what if known else f"from {read_record(folder).get('origin', 'an unknown place')}"
    licence = known.licence.title if known else "see its page"
    state: Literal["installed", "incomplete", "absent"] = "installed" if files else "incomplete" if begun else "absent"
    return Entry(name, what, licence, size, state, folder)


def installed(what: str) -> bool:
    """Whether ``path`` would give them; sizes are compared, checksums are not."""
    return own_path(what) is not None or _present(name_of(what)) is not None


def path(what: str) -> Path:
    """A name, hub id or path as what a loader wants: a file, or for DINOv2 a folder. Never touches the net.

    Raises InputError that says how to get the weights and what to place where, ConfigError for what is no name.
    """
    if (own := own_path(what)) is not None:
        return own
    name = name_of(what)
    files = _present(name)
    if files is None:
        raise InputError(absent(name))
    known = KNOWN.get(name)
    alone = len(files) == 1 if known is None else known.form == "file"
    return files[0] if alone else folder_of(name)


def check(what: str) -> list[Checked]:
    """Checksums of weights by name, or of a file or folder, against the released ones or those of the first download.

    A checksum that is seen for the first time in the weights folder is recorded. Raises InputError, OutputError.
    """
    files: list[Path]
    if (own := own_path(what)) is not None:
        files = [own] if is_file(own) else [p for p in entries_of(own) if p.suffix in TENSORS]
    else:
        folder = folder_of(name_of(what))
        # A file of the wrong size is not present, but is what a check is there to find.
        expected = read_record(folder).get("files") or [f.name for o in origins_of(folder.name) for f in o.files]
        files = [folder / n for n in expected if is_file(folder / n)]
        if not any(p.suffix in TENSORS for p in files):
            raise InputError(absent(folder.name))
    if not files:
        raise InputError(f"{own}: expected weights ({', '.join(TENSORS)}), got none")
    return [_check(file) for file in files]


def _check(file: Path) -> Checked:
    size, found = file.stat().st_size, sha256_of(file)
    record = read_record(file.parent)
    written = record.get("files", {}).get(file.name, {}).get("sha256")
    expected = _released(file) or written
    new = written is None and expected in (None, found) and file.parent.parent == folder_of("")
    if new:
        write_record(file.parent, record.get("origin", BY_HAND), {file.name: (size, found)}, record)
    return Checked(file, size, found, expected, new)


def _released(file: Path) -> str | None:
    """Released checksum of a file in a known folder, or of a name that says what is in it."""
    inside = file.parent.parent == folder_of("")
    if not inside and file.stem in NAMELESS:
        return None
    among = origins_of(file.parent.name) if inside else [o for k in KNOWN.values() for o in k.origins]
    return next((f.sha256 for o in among for f in o.files if f.name == file.name), None)


def _present(name: str) -> list[Path] | None:
    """All files of some weights, tensors first, where each is there with its right size."""
    folder = folder_of(name)
    recorded = {n: r.get("bytes") for n, r in read_record(folder).get("files", {}).items()}
    ways = [{f.name: f.size_bytes or recorded.get(f.name) for f in o.files} for o in origins_of(name)]
    for way in ways or [recorded]:
        sizes = {n: (folder / n).stat().st_size for n in way if is_file(folder / n)}
        if way and len(sizes) == len(way) and all(way[n] in (None, size) for n, size in sizes.items()):
            return sorted((folder / n for n in way), key=lambda p: (p.suffix not in TENSORS, p.name))
    return None


def absent(name: str, *, network: bool = True) -> str:
    """How to get weights that are not there, in one line."""
    known, folder = KNOWN.get(name), folder_of(name)
    if known is None:
        return f"{name}: expected weights in {folder}, got none; mastd3r weights list shows what there is"
    origin, got = known.origins[0], "none"
    for file in (f for o in known.origins for f in o.files):
        size = (folder / file.name).stat().st_size if is_file(folder / file.name) else None
        if size is not None and file.size_bytes not in (None, size):
            got = f"{file.name} of {size} bytes instead of {file.size_bytes}"
    what = " and ".join(f.name + (f" ({human_bytes(f.size_bytes)})" if f.size_bytes else "") for f in origin.files)
    place = f"place {what} from {origin.page} in {folder}"
    if not network:
        return f"without a network, {place}"
    return f"{name}: expected its weights, got {got}; run mastd3r weights download {name}, or {place}"


def origins_of(name: str) -> tuple[Origin, ...]:
    """None for weights that only the user knows."""
    known: Known | None = KNOWN.get(name)
    return known.origins if known else ()


def own_path(what: str) -> Path | None:
    """A path that a user has given; names go first."""
    if what in KNOWN or (is_name(what) and is_dir(folder_of(what))):
        return None
    given = os.path.expanduser(what)
    if not os.path.exists(given):
        return None
    if not (os.path.isfile(given) or os.path.isdir(given)):
        check_plain(Path(given), "a file or folder of weights")
    return Path(given)


def is_name(text: str) -> bool:
    """Whether weights may be called so: it becomes the name of a folder."""
    return re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,199}", text) is not None


def name_of(what: str) -> str:
    """The folder name of a name or hub id. Raises ConfigError."""
    for known in KNOWN.values():
        if what == known.name or any(what == o.hub_id for o in known.origins):
            return known.name
    name = what.replace("/", "--") if what.count("/") == 1 else what
    if not is_name(name):
        raise ConfigError(f"{what}: expected {grammar()}, or a path that exists")
    return name


def grammar() -> str:
    """What a user may write to name weights."""
    return f"one of {', '.join(KNOWN)}, a hub id OWNER/NAME, a URL"


def read_record(folder: Path) -> dict[str, Any]:
    """weights.json: {"origin", "recorded", "files": {name: {"bytes", "sha256"}}}; empty where there is none."""
    return read_json(folder / RECORD)


def write_record(
    folder: Path, origin: str, files: dict[str, tuple[int, str]], old: dict[str, Any] | None = None
) -> None:
    """Write weights.json, its files added to those of ``old``. Raises OutputError."""
    kept = (old or {}).get("files", {})
    new = {name: {"bytes": size, "sha256": sha256} for name, (size, sha256) in files.items()}
    write_json(folder / RECORD, {"origin": origin, "recorded": now(), "files": {**kept, **new}})


def read_json(file: Path) -> dict[str, Any]:
    """An empty mapping where there is no such file. Raises InputError for a damaged one."""
    if not os.path.lexists(file):
        return {}
    try:
        data = whole_json(file)
    except InputError as e:
        raise InputError(f"{e}; remove it") from e
    files = data.get("files", {})
    if not isinstance(files, dict) or not all(isinstance(f, dict) for f in files.values()):
        raise InputError(f"{file}: expected the record of some weights, got something else; remove it")
    return data


def write_json(file: Path, data: dict[str, Any]) -> None:
    """Whole or not at all. Raises OutputError."""
    part = file.with_name(file.name + ".new")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")
        os.replace(part, file)
    except OSError as e:
        raise OutputError(f"{file}: expected to write, got {e.strerror or e}") from e


def now() -> str:
    """UTC, to the second."""
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
