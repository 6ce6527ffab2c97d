"""Bringing weights into the weights folder: by name, hub id, URL, or from a file or folder of this machine."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ..errors import ConfigError, InputError
from ..reading.files import entries_of, is_dir, short, whole_json
from .fetch import Progress, Unreachable, Wanted, fetch, local_path
from .weights import (  # fmt: skip
    NAMELESS,
    TENSORS,
    absent,
    check,
    folder_of,
    grammar,
    home,
    installed,
    is_name,
    name_of,
    now,
    own_path,
    path,
    read_json,
    read_record,
    write_json,
    write_record,
)
from .weights_known import KNOWN, Known, KnownFile, Licence, Origin, hub

Accept = Callable[[Licence], bool]
MOST_LISTING_BYTES = 16 * 2**20
Watch = Callable[[str], Progress]  # file name -> where its progress is told


@dataclass(frozen=True)
class _Plan:
    """One way to get some weights."""

    name: str
    origin: str
    files: tuple[tuple[str | Path, KnownFile], ...]  # (where from, what is known of it)


def download(what: str, accept: Accept, *, as_name: str | None = None, watch: Watch | None = None) -> Path:
    """Bring weights by name, hub id, URL, or path of a file or folder into the weights folder; gives ``path`` of them.

    What is there and right is not fetched again. ``accept`` is asked once per licence and machine. Of several origins
    the next is taken only where one does not answer.
    Raises InputError, OutputError, ConfigError (no such thing, or the licence was declined).
    """
    if as_name is not None and not is_name(as_name):
        raise ConfigError(f"--as: expected letters, digits, '.', '_' and '-', got {as_name!r}")
    own = own_path(what)
    loose = own is not None or "://" in what
    if as_name is None and not loose and installed(what) and all(c.right for c in check(what)):
        return path(what)
    known = KNOWN.get(as_name or _guess(what) if loose else name_of(what))
    if known is not None:
        if as_name is not None and not loose:
            raise ConfigError(f"{what}: is {known.name} already, expected no --as")
        _agree(known.licence, accept)
    if loose:
        return _carry_out(_folder_plan(own, as_name) if own and is_dir(own) else _file_plan(what, as_name), watch)
    if known is None:
        return _carry_out(_hub_plan(what, as_name), watch)
    for origin in known.origins:
        try:
            return _carry_out(_known_plan(known, origin), watch)
        except Unreachable as e:
            reason = str(e).partition("; without")[0]
    raise InputError(f"{reason}; {absent(known.name, network=False)}")


def _carry_out(plan: _Plan, watch: Watch | None) -> Path:
    """Fetch every file, write the record, remove what it replaces."""
    folder, arrived = folder_of(plan.name), {}
    for source, file in plan.files:
        want = Wanted(file.sha256, file.size_bytes)
        got = fetch(source, folder / file.name, want, progress=watch(file.name) if watch else None)
        arrived[file.name] = (got.size_bytes, got.sha256)
    replaced = set(read_record(folder).get("files", {})) - set(arrived)
    write_record(folder, plan.origin, arrived)
    for name in replaced:
        with suppress(OSError):
            (folder / name).unlink()
    return path(plan.name)


def _known_plan(known: Known, origin: Origin) -> _Plan:
    """A released file without a checksum of its own is held to the one that the hub lists."""
    listed = {}
    if origin.hub_id and any(f.sha256 is None and f.name.endswith(TENSORS) for f in origin.files):
        listed = {f.name: f for f in _hub_files(origin.hub_id, origin.revision)}
    files = ((origin.url(f.name), listed.get(f.name, f) if f.sha256 is None else f) for f in origin.files)
    return _Plan(known.name, origin.page, tuple(files))


def _hub_plan(hub_id: str, as_name: str | None) -> _Plan:
    """Any other repository of the hub: its tensors, and config.json where it has one."""
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", hub_id):
        raise ConfigError(f"{hub_id}: expected {grammar()}, or a path that exists")
    listed = _hub_files(hub_id, "main")
    chosen = [f for f in listed if f.name.endswith((".safetensors", ".safetensors.index.json"))]
    chosen = chosen or [f for f in listed if f.name.endswith(TENSORS)]
    if not chosen:
        raise InputError(f"{hub()}/{hub_id}: expected weights ({', '.join(TENSORS)}), got none")
    chosen += [f for f in listed if f.name == "config.json"]
    origin = Origin(tuple(chosen), hub_id)
    return _Plan(as_name or name_of(hub_id), origin.page, tuple((origin.url(f.name), f) for f in chosen))


def _folder_plan(folder: Path, as_name: str | None) -> _Plan:
    """A folder as transformers writes it: config.json and the tensors."""
    name = as_name or _guess(str(folder))
    if known := KNOWN.get(name):
        files = [(folder / f.name, f) for f in known.origins[0].files]
    else:
        there = sorted(p for p in entries_of(folder) if p.name == "config.json" or p.name.endswith(TENSORS[0]))
        files = [(p, KnownFile(p.name)) for p in there]
    if not any(f.name.endswith(TENSORS) for _, f in files):
        raise InputError(f"{folder}: expected config.json and *.safetensors, got no tensors")
    return _Plan(name, str(folder), tuple(files))


def _file_plan(source: str, as_name: str | None) -> _Plan:
    """One file, by path or URL."""
    name, file_name = as_name or _guess(source), _file_name(source)
    if not file_name.endswith(TENSORS):
        raise ConfigError(f"{source}: expected a file that ends in {', '.join(TENSORS)}")
    known = KNOWN.get(name)
    if known is not None and known.form == "folder":
        names = " and ".join(f.name for f in known.origins[0].files)
        raise ConfigError(f"{name}: expected a folder with {names}, got one file, {source}")
    return _Plan(name, source, ((source, _released(name, file_name)),))


def _file_name(source: str) -> str:
    local = local_path(source)
    return local.name if local is not None else source.partition("?")[0].rstrip("/").rpartition("/")[2]


def _guess(source: str) -> str:
    """The name under which a loose file or folder is kept: that of the known weights it is, else its own."""
    local, file_name = local_path(source), _file_name(source)
    stem = local.resolve().name if local is not None and is_dir(local) else Path(file_name).stem
    if stem in NAMELESS or not is_name(stem):
        raise ConfigError(f"{source}: expected a name for these weights, for instance --as mast3r")
    return next((k.name for k in KNOWN.values() if any(f.name == file_name for o in k.origins for f in o.files)), stem)


def _released(name: str, file_name: str) -> KnownFile:
    """What one file must be to go under a name: for known weights, the released file of that ending."""
    known = KNOWN.get(name)
    if known is None:
        return KnownFile(file_name)
    files = [f for o in known.origins for f in o.files]
    for fitting in files:
        if fitting.name.endswith(Path(file_name).suffix):
            return fitting
    names = " or ".join(f.name for f in files)
    raise ConfigError(f"{name}: expected {names}, got {file_name}; give other weights another name with --as")


def _hub_files(hub_id: str, revision: str) -> list[KnownFile]:
    """Names, sizes and checksums of a hub repository's top folder. Raises InputError."""
    listing = home() / "listing.json"
    fetch(f"{hub()}/api/models/{hub_id}/revision/{revision}?blobs=true", listing, Wanted(most_bytes=MOST_LISTING_BYTES))
    try:
        data = whole_json(listing)
        files = []
        for entry in data["siblings"]:
            large = entry.get("lfs") or {}
            size, sha256 = large.get("size") or entry.get("size"), large.get("sha256")
            if not isinstance(size, int | None) or not isinstance(sha256, str | None):
                raise TypeError(f"size {short(repr(size))}, sha256 {short(repr(sha256))}")
            files.append(KnownFile(str(entry["rfilename"]), size, sha256))
    except (InputError, KeyError, TypeError, AttributeError) as e:
        raise InputError(f"{hub()}/{hub_id}: expected a list of files, got something else ({e})") from e
    finally:
        listing.unlink(missing_ok=True)
    return [f for f in files if is_name(f.name)]


def _agree(licence: Licence, accept: Accept) -> None:
    """Ask once; the answer is kept in licences.json. Raises ConfigError where it is no."""
    file = home() / "licences.json"
    agreed = read_json(file)
    if licence.key in agreed:
        return
    if not accept(licence):
        raise ConfigError(f"licence {licence.title}: not accepted, nothing was fetched")
    write_json(file, {**agreed, licence.key: {"title": licence.title, "accepted": now()}})
