"""Every sequence and twelve variants of it with exact truth: how far a path is off, as a distribution.

usage: python benchmarks/stress.py --data DATA --vary VARY --out DIR [--work DIR] [--keep] [--jobs N] [--frames N]
       [--only SEQUENCE[:VARIANT],…] [--semantics NAME] [--set SECTION.KEY=VALUE …] [--timeout SECONDS] [--list]

VARY is a script: ``VARY SEQUENCE FOLDER VARIANT --seed N --first N --last N`` writes the variant of those frames, in
TUM's layout with groundtruth.txt and info.json, as a folder in FOLDER. The base is its ``stride1``: the frames as they
are, written by the same means. Options are the defaults, so semantic maps are used where a sequence brings them.

An entry is tracking and the joint optimisation in a process of its own (benchmarks/stress_entry.py) and one JSON in
DIR/entries; one that is there with the same configuration is not run again, whatever it says. What goes wrong in an
entry stands in its JSON. DIR/stress.json joins those of this configuration. Variants are made in the work folder and
removed after use.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mastd3r.errors import ConfigError
from mastd3r.export.files import write_json
from mastd3r.export.machine import machine_info

sys.path.insert(0, str(Path(__file__).resolve().parent))
from stress_entry import config_of

# name -> (folder, first frame, one past the last or None)
SEQUENCES: dict[str, tuple[str, int, int | None]] = {
    "kitchen": ("kitchen", 0, 160),
    "kitchen_late": ("kitchen", 240, 400),
    "kitchen_walk": ("kitchen_walk", 0, 120),
    "kitchen_walk_close": ("kitchen_walk_close", 0, 100),
    "lobby": ("lobby", 0, None),
    "lobby_walk": ("lobby_walk", 0, None),
    "cabinet": ("cabinet", 0, None),
    "street": ("street", 0, None),
    "jam": ("jam", 0, None),
    "tsukuba": ("tsukuba", 0, None),
}
BASE = "base"
SINGLES = ("reverse", "mirror", "turned", "stride2", "flicker", "blur", "noise", "drop")
SUMS = ("reverse+blur+flicker", "mirror+drop+noise", "turned+flicker+jpeg", "reverse+mirror+stride2")
VARIANTS = (BASE, *SINGLES, *SUMS)
SEED = 0
DRIVER = Path(__file__).resolve().parent / "stress_entry.py"


@dataclass(frozen=True)
class Entry:
    """One variant of one piece of a sequence, and the options that it runs with: what an entry is known by."""

    sequence: str
    variant: str
    folder: str
    first: int
    last: int | None
    seed: int = SEED
    semantics: str = "auto"
    overrides: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """As a file's name."""
        return f"{self.sequence}--{self.variant}"

    def identity(self) -> dict[str, Any]:
        """As JSON gives it back."""
        return asdict(self) | {"overrides": list(self.overrides)}


def entries(semantics: str = "auto", overrides: Sequence[str] = (), frames: int | None = None) -> list[Entry]:
    """The whole suite. ``frames``: at most so many of every piece, before the variant is made."""
    out = []
    for name, (folder, first, last) in SEQUENCES.items():
        end = last
        if frames is not None:
            end = first + frames if last is None else min(last, first + frames)
        out += [Entry(name, v, folder, first, end, SEED, semantics, tuple(overrides)) for v in VARIANTS]
    return out


def chosen(suite: Sequence[Entry], only: str | None) -> list[Entry]:
    """Those that ``--only`` names. Raises ConfigError for a name that stands for none."""
    if only is None:
        return list(suite)
    names = [words.partition(":")[::2] for words in only.split(",")]
    for sequence, variant in names:
        if not any(e.sequence == sequence and variant in ("", e.variant) for e in suite):
            known = f"{', '.join(SEQUENCES)}, each with :{', :'.join(VARIANTS)}"
            raise ConfigError(f"--only: expected of {known}; got {sequence}{variant and ':'}{variant}")
    return [e for e in suite if any(e.sequence == s and v in ("", e.variant) for s, v in names)]


def main(words: Sequence[str] | None = None) -> int:
    """Run what is missing; stress.json is rewritten after every entry."""
    args = _parser().parse_args(words)
    try:
        config_of(args.semantics, args.set)
        suite = entries(args.semantics, args.set, args.frames)
        wanted = chosen(suite, args.only)
        if not args.vary.is_file():
            raise ConfigError(f"--vary: expected a script, got {args.vary}")
    except ConfigError as e:
        print(e, file=sys.stderr)
        return 2
    if args.list:
        print("\n".join(f"{e.sequence}:{e.variant}{', done' if kept(args.out, e) else ''}" for e in wanted))
        return 0
    missing = {e.folder for e in wanted if not (args.data / e.folder).is_dir()}
    for folder in sorted(missing):
        print(f"{args.data / folder} is not there, its entries are left out", file=sys.stderr)
    (args.out / "entries").mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix="stress-")) if args.work is None else args.work
    to_run = [e for e in wanted if e.folder not in missing and kept(args.out, e) is None]
    with ThreadPoolExecutor(args.jobs) as pool:
        for done, (entry, record) in enumerate(pool.map(lambda e: (e, run_one(e, args, work)), to_run), 1):
            write_json(args.out / "stress.json", joined(args.out, suite))
            shown = {k: record[k] for k in ("ate_rmse_all", "path_length", "refused", "error", "wall_s") if k in record}
            print(f"{done}/{len(to_run)} {entry.sequence}:{entry.variant}", shown, flush=True)
    write_json(args.out / "stress.json", joined(args.out, suite))
    if args.work is None and not args.keep:
        shutil.rmtree(work)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder that holds the sequences")
    parser.add_argument("--vary", type=Path, required=True, help="the script that makes variants")
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--work", type=Path, default=None, help="where variants and runs go; default: a temporary one")
    parser.add_argument("--keep", action="store_true", help="keep variants and run folders in the work folder")
    parser.add_argument("--jobs", type=int, default=1, help="entries at a time")
    parser.add_argument("--frames", type=int, default=None, help="at most so many frames of every sequence")
    parser.add_argument("--only", default=None, metavar="SEQUENCE[:VARIANT],…")
    parser.add_argument("--semantics", default="auto")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--timeout", type=float, default=3600, metavar="SECONDS", help="most that an entry may take")
    parser.add_argument("--list", action="store_true", help="show the entries and run none")
    return parser


def kept(out: Path, entry: Entry) -> dict[str, Any] | None:
    """What stands in the entry's file; None where there is none, or one of another configuration."""
    file = out / "entries" / f"{entry.name}.json"
    if not file.is_file():
        return None
    found: dict[str, Any] = json.loads(file.read_text())
    return found if found["configuration"] == entry.identity() else None


def joined(out: Path, suite: Sequence[Entry]) -> dict[str, Any]:
    """All entries of the suite that have run, in its order; the lines on what a run chose stay with the entry."""
    found = {f"{e.sequence}:{e.variant}": kept(out, e) for e in suite}
    return {name: {k: v for k, v in e.items() if k != "choices"} for name, e in found.items() if e is not None}


def run_one(entry: Entry, args: argparse.Namespace, work: Path) -> dict[str, Any]:
    """Make the variant, run it, keep what came of it; never raises for what goes wrong in either."""
    place = work / entry.name
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    record: dict[str, Any] = {"configuration": entry.identity()}
    began = time.perf_counter()
    error = _called(_vary_words(entry, args, place), args.timeout)
    if error is not None:
        record["error"] = f"making the variant: {error}"
    else:
        result = place / "result.json"
        error = _called(_driver_words(entry, place), args.timeout)
        record |= {"error": error} if error is not None else json.loads(result.read_text())
    info = machine_info()
    record |= {"with_variant_s": round(time.perf_counter() - began, 1), "date": time.strftime("%Y-%m-%d")}
    record |= {key: info[key] for key in ("git_commit", "processor", "cores")}
    write_json(args.out / "entries" / f"{entry.name}.json", record)
    if not args.keep:
        shutil.rmtree(place, ignore_errors=True)
    return record


def _vary_words(entry: Entry, args: argparse.Namespace, place: Path) -> list[str]:
    variant = "stride1" if entry.variant == BASE else entry.variant
    words = [str(args.vary), str(args.data / entry.folder), str(place / "variant"), variant, "--seed", str(entry.seed)]
    words += ["--first", str(entry.first)]
    return words if entry.last is None else [*words, "--last", str(entry.last)]


def _driver_words(entry: Entry, place: Path) -> list[str]:
    made = [p for p in (place / "variant").glob("*") if p.is_dir()] or [place / "variant"]
    words = [str(DRIVER), str(made[0]), str(place / "run"), str(place / "result.json"), "--semantics", entry.semantics]
    return [*words, *(w for o in entry.overrides for w in ("--set", o))]


def _called(words: Sequence[str], timeout_s: float) -> str | None:
    """Run a Python script; None where it ended well, or one line on how it ended."""
    try:
        ended = subprocess.run(
            [sys.executable, *words], capture_output=True, text=True, check=False, timeout=timeout_s
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return f"timeout: not done after {timeout_s:.0f} s"
    said = (ended.stderr.strip().splitlines() or ["no message"])[-1]
    return None if ended.returncode == 0 else f"exit code {ended.returncode}: {said}"


if __name__ == "__main__":
    sys.exit(main())
