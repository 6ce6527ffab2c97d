"""What a suite's entries left behind: one JSON each, written whole or not at all."""

from __future__ import annotations

import shlex
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import yaml

from ..config import config_to_yaml
from ..errors import InputError
from ..export.claim import claim_shelf
from ..export.files import write_json, writing
from ..export.machine import machine_info
from ..export.read_run import read_json
from ..reading.files import is_file, whole_json
from ..registry import LARGEST
from ..tasks.lock import alone_in
from ..tasks.process import Ended
from .suite import Entry, SequenceSpec, Suite

PATH_POINTS = 150  # of a path that is kept for the plots


class Store:
    """The folder of one bench: entries/*.json, runs/<entry>, results.json, table.md, table.html, plots."""

    def __init__(self, out: Path) -> None:
        self.out, self.entries, self.runs = out, out / "entries", out / "runs"

    def prepare(self) -> None:
        """Make the folders. Raises OutputError for a folder with other files in it."""
        claim_shelf(self.out, self.entries.name, "an earlier bench")
        with writing(self.out):
            self.entries.mkdir(exist_ok=True)
            self.runs.mkdir(exist_ok=True)

    def locked(self) -> AbstractContextManager[int | None]:
        """Hold the folder against a second bench, see ``alone_in``. Raises OutputError."""
        return alone_in(self.out, "bench")

    def get(self, entry: Entry) -> dict[str, Any] | None:
        """What is recorded of an entry, or None: it has not run, or its file is not one of ours."""
        path = self.entries / f"{entry.id}.json"
        if not is_file(path):
            return None
        try:
            data = read_json(path)
        except InputError:
            return None  # half a file from outside: the entry runs again
        return data if data.get("id") == entry.id and data.get("status") in ("complete", "failed") else None

    def put(self, entry: Entry, record: dict[str, Any]) -> None:
        """Record an entry. Raises OutputError."""
        write_json(self.entries / f"{entry.id}.json", {**described(entry), **record})

    def run_folder(self, entry: Entry) -> Path:
        """Where the run itself writes."""
        return self.runs / entry.id

    def needs(self, entries: Sequence[Entry]) -> dict[str, float]:
        """MiB that entries need, by id: the most that their like has been seen to take, or what the suite declares."""
        seen: dict[tuple[Any, Any], float] = {}
        for path in self.entries.glob("*.json"):
            try:
                record = read_json(path)
            except InputError:  # half a file from outside: as if it were not there
                continue
            key, peak = (record.get("sequence"), record.get("variant")), _peak_mib(record)
            if peak and record.get("status") == "complete" and all(isinstance(k, str) for k in key):
                seen[key] = max(peak, seen.get(key, 0.0))
        return {e.id: seen.get((e.sequence.name, e.variant.name), e.variant.memory_mib) for e in entries}


def _peak_mib(record: dict[str, Any]) -> float:
    metrics = record.get("metrics")
    peak = metrics.get("peak_rss_mib") if isinstance(metrics, dict) else None
    return float(peak) if isinstance(peak, int | float) and 0 < peak < LARGEST else 0.0


def described(entry: Entry) -> dict[str, Any]:
    """What an entry is, before it has run."""
    return {
        "id": entry.id,
        "sequence": entry.sequence.name,
        "dataset": entry.sequence.dataset,
        "variant": entry.variant.name,
        "seed": entry.seed,
        "config": yaml.safe_load(config_to_yaml(entry.config)),
    }


def command_of(entry: Entry, folder: str, out: str) -> list[str]:
    """The command that does the same by hand."""
    sets = [word for item in entry.overrides for word in ("--set", item)]
    return ["mastd3r", "run", folder, "--out", out, *sets]


def record_of(entry: Entry, run: Path, ended: Ended, *, jobs: int) -> dict[str, Any]:
    """One entry's JSON from its run folder: the figures, or the one line that says why there are none."""
    told = _read(run / "run.json")
    found = _read(run / "metrics.json")
    complete = ended.exit_code == 0 and told.get("status") == "complete" and bool(found)
    machine = told.get("machine") or machine_info()
    record: dict[str, Any] = {
        "status": "complete" if complete else "failed",
        "error": None if complete else _why(ended, told),
        "exit_code": ended.exit_code,
        "command": shlex.join(command_of(entry, entry.sequence.folder or entry.sequence.name, "RUN")),
        "metrics": found if complete else {},
        "wall_s": round(ended.wall_s, 1),
        "jobs": jobs,
        "date": time.strftime("%Y-%m-%d"),
        "machine": {**machine, "accelerator": told.get("accelerator")},
        **{key: told.get(key) for key in ("source", "timings_s", "choices")},
    }
    if complete and is_file(run / "aligned.txt"):
        record["path"] = thinned(run / "aligned.txt")
    return record


def thinned(path: Path) -> list[str]:
    """Rows of aligned.txt, without times, at most so many, in four decimals: "x y z true_x true_y true_z"."""
    rows = [line.split()[1:] for line in path.read_text().splitlines() if not line.startswith("#")]
    step = max(1, -(-len(rows) // PATH_POINTS))
    return [" ".join(f"{float(v):.4f}" for v in row) for row in rows[::step]]


def results_of(
    suite: Suite, sequences: tuple[SequenceSpec, ...], folders: dict[str, Path], command: str, records: list[Any]
) -> dict[str, Any]:
    """results.json: everything that tables and plots are made of, and nothing twice.

    ``folders`` has those of the sequences that are there. A path is kept for the first seed only, and of a
    configuration what is not the same in all; ``config`` holds the rest.
    """
    first = min((r["seed"] for r in records), default=0)
    common = _common([r["config"] for r in records]) if records else {}
    kept = [
        {k: v for k, v in r.items() if k != "choices" and (k != "path" or r["seed"] == first)}
        | {"config": _without(r["config"], common)}
        for r in records
    ]
    return {
        "suite": suite.name,
        "definition": suite.raw,
        "sequences": [s.name for s in sequences],
        "missing": [s.name for s in sequences if s.name not in folders],
        "composed": [s.name for s in sequences if s.name in folders and _is_composed(folders[s.name])],
        "command": command,
        "config": common,
        "entries": kept,
    }


def read_results(path: Path) -> dict[str, Any]:
    """results.json with the whole configuration in every entry again. Raises InputError."""
    results = read_json(path)
    if not {"suite", "definition", "sequences", "missing", "command", "config", "entries"} <= set(results):
        raise InputError(f"{path}: expected the results.json of a bench, got {', '.join(results) or 'nothing'}")
    whole = [{**e, "config": _joined(results["config"], e["config"])} for e in results["entries"]]
    return {**results, "entries": whole}


def _is_composed(folder: Path) -> bool:
    """True where a folder's info.json says that people were put into its pictures."""
    return _read(folder / "info.json").get("composed") is True


def _common(configs: list[dict[str, Any]]) -> dict[str, Any]:
    """What all of them have."""
    found: dict[str, Any] = {}
    for key, value in configs[0].items():
        values = [c.get(key) for c in configs]
        if isinstance(value, dict):
            found[key] = _common([v for v in values if isinstance(v, dict)])
        elif all(v == value for v in values):
            found[key] = value
    return found


def _without(config: dict[str, Any], common: dict[str, Any]) -> dict[str, Any]:
    left: dict[str, Any] = {}
    for key, value in config.items():
        if isinstance(value, dict):
            if own := _without(value, common.get(key, {})):
                left[key] = own
        elif key not in common:
            left[key] = value
    return left


def _joined(common: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    joined = {**common, **own}
    for key in set(common) & set(own):
        if isinstance(common[key], dict):
            joined[key] = _joined(common[key], own[key])
    return joined


def _read(path: Path) -> dict[str, Any]:
    if not is_file(path):
        return {}
    try:
        return whole_json(path)
    except InputError:
        return {}  # the run ended while it wrote: the record says that it failed


def _why(ended: Ended, told: dict[str, Any]) -> str:
    own = told.get("reason")
    return str(own) if own and not ended.killed and not ended.said.strip() else ended.reason
