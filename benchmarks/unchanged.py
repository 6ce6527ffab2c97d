"""Does a change of the code leave results as they were, to the byte? Record runs before and after it, then compare.

    python benchmarks/unchanged.py record --data DATA --out before/ [--only NAME …]
    python benchmarks/unchanged.py compare before.json after.json [--only NAME …]
    python benchmarks/unchanged.py hash before/ …

record: the runs, each with its map, and a JSON of the folder's name beside it. hash: that JSON of runs made already.
compare: files are identical or different. Whatever differs, ATE and PSNR may move by 1 % at most, either way; exit
code 1 where one moves further, or where a run, a file or a figure is missing.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# name -> words of the command line; a sequence is found in DATA
RUNS: dict[str, list[str]] = {
    "kitchen": ["run", "kitchen", "--end", "120", "--quiet"],
    "kitchen_walk": ["run", "kitchen_walk", "--end", "80", "--quiet"],
    "street": ["run", "street", "--quiet"],
    "tsukuba": ["run", "tsukuba", "--end", "60", "--quiet"],
    "demo": ["demo"],
}
FILES = ("trajectory.txt", "cloud.ply", "masks/*.png")
BOUND = 0.01  # of a figure's value
Entry = dict[str, Any]


def digest(run: Path, pattern: str) -> str | None:
    """SHA-256 of one file's bytes, or of the names and bytes of all that match, in order; None where there is none."""
    if "*" not in pattern:
        return hashlib.sha256((run / pattern).read_bytes()).hexdigest() if (run / pattern).is_file() else None
    files = sorted(run.glob(pattern))
    whole = hashlib.sha256()
    for file in files:
        data = file.read_bytes()
        whole.update(f"{file.name} {len(data)}\n".encode() + data)
    return whole.hexdigest() if files else None


def entry_of(run: Path) -> Entry:
    """What is kept of one run folder, or the reason why nothing can be."""
    if not (run / "run.json").is_file():
        return {"error": "expected a run folder, got no run.json"}
    record = json.loads((run / "run.json").read_text())
    if record["status"] != "complete":
        return {"error": f"expected a complete run, got {record['status']}: {record.get('reason')}"}
    metrics = json.loads((run / "metrics.json").read_text())
    figures = {k: v for k, v in metrics.items() if k == "ate_rmse_all" or k.startswith("psnr")}
    machine = dict(record["machine"])
    commit, packages = machine.pop("git_commit"), machine.pop("packages")
    files = {pattern: digest(run, pattern) for pattern in FILES}
    return {"commit": commit, "files": files, "figures": figures, "machine": machine, "packages": packages}


def recorded(name: str, data: Path, run: Path) -> Entry:
    """Run one of RUNS into a folder, as a process of its own."""
    words = [*RUNS[name], "--out", str(run)]
    if words[0] == "run":
        words[1] = str(data / words[1])
    command = [sys.executable, "-m", "mastd3r", *words]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    if ended.returncode != 0:
        return {"error": " ".join(ended.stderr.strip().splitlines()[-1:]) or f"exit code {ended.returncode}"}
    return entry_of(run)


def change(before: float | None, after: float | None) -> float:
    """Relative change of a figure; infinite where there is none on one side or a value is not finite."""
    if before is None or after is None or not (math.isfinite(before) and math.isfinite(after)):
        return 0.0 if before is None and after is None else math.inf
    if before == 0:
        return 0.0 if after == 0 else math.inf
    return after / before - 1


def shown(figure: float | None) -> str:
    """A figure as the table has it."""
    return "none" if figure is None else f"{figure:.6g}"


def compared(name: str, before: Entry, after: Entry) -> Iterator[tuple[list[str], bool]]:
    """Rows (run, what, verdict, change, bound) of one run, each with whether it holds."""
    errors = [f"{when}: {e['error']}" for when, e in (("before", before), ("after", after)) if "error" in e]
    if errors:
        yield [name, "run", "missing", "; ".join(errors), "broken"], False
        return
    same = True
    for file in FILES:
        pair = before["files"].get(file), after["files"].get(file)
        verdict = "missing" if None in pair else "identical" if pair[0] == pair[1] else "different"
        same &= verdict == "identical"
        yield [name, file, verdict, "", "broken" if verdict == "missing" else ""], verdict != "missing"
    keys = sorted({*before["figures"], *after["figures"]})
    for key in keys:
        a, b = before["figures"].get(key), after["figures"].get(key)
        moved = change(a, b)
        held = abs(moved) <= BOUND
        verdict = "missing" if a is None or b is None else "identical" if a == b else "different"
        moves = f"{shown(a)} to {shown(b)}: {100 * moved:+.3f} %"
        yield [name, key, verdict, moves, "held" if held else "broken"], held
    if not keys and not same:
        yield [name, "figures", "missing", "files differ and no figure says by how much", "broken"], False


def table(before: dict[str, Entry], after: dict[str, Entry], names: list[str]) -> tuple[list[str], bool]:
    """Lines to print, and whether everything holds."""
    rows, held = [["run", "what", "verdict", "change", f"bound {100 * BOUND:g} %"]], True
    absent: Entry = {"error": "not recorded"}
    for name in names:
        for row, good in compared(name, before.get(name, absent), after.get(name, absent)):
            rows.append(row)
            held &= good
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    for what in ("commit", "machine", "packages"):
        sides = [{json.dumps(e[what]) for n, e in s.items() if n in names and what in e} for s in (before, after)]
        if sides[0] != sides[1] or len(sides[0]) > 1:
            lines.append(f"{what}: {' and '.join(sorted(sides[0]))} before, {' and '.join(sorted(sides[1]))} after")
    files = [row[2] for row in rows[1:] if row[1] in FILES]
    lines.append(f"{files.count('identical')} of {len(files)} files identical, bounds {'held' if held else 'BROKEN'}")
    return lines, held


def beside(folder: Path) -> Path:
    """before/ -> before.json."""
    folder = folder.resolve()
    return folder.parent / f"{folder.name}.json"


def record(data: Path, out: Path, only: list[str] | None) -> bool:
    """Runs into folders of ``out``; the JSON is rewritten after every one. Whether all were made."""
    made: dict[str, Entry] = json.loads(beside(out).read_text()) if beside(out).is_file() else {}
    out.mkdir(parents=True, exist_ok=True)
    good = True
    for name in only or RUNS:
        made[name] = recorded(name, data, out / name)
        beside(out).write_text(json.dumps(made, indent=1) + "\n")
        good &= "error" not in made[name]
        print(name, made[name].get("error", "recorded"), flush=True)
    return good


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    acts = parser.add_subparsers(dest="act", required=True)
    recording, comparing, hashing = (acts.add_parser(name) for name in ("record", "compare", "hash"))
    recording.add_argument("--data", type=Path, required=True, help="folder that holds the sequences")
    recording.add_argument("--out", type=Path, required=True, help="folder of the run folders")
    comparing.add_argument("before", type=Path)
    comparing.add_argument("after", type=Path)
    for one in (recording, comparing):
        one.add_argument("--only", nargs="+", choices=list(RUNS), default=None, metavar="NAME")
    hashing.add_argument("folders", type=Path, nargs="+", metavar="FOLDER", help="holds run folders of the names")
    args = parser.parse_args(arguments)
    if args.act == "record":
        return 0 if record(args.data, args.out, args.only) else 1
    if args.act == "hash":
        for folder in args.folders:
            made = {name: entry_of(folder / name) for name in RUNS if (folder / name).is_dir()}
            beside(folder).write_text(json.dumps(made, indent=1) + "\n")
            print(beside(folder), *(f"{name}: {e.get('error', 'kept')}" for name, e in made.items()), sep="\n  ")
        return 0
    before, after = (json.loads(path.read_text()) for path in (args.before, args.after))
    lines, held = table(before, after, args.only or list(dict.fromkeys([*before, *after])))
    print("\n".join(lines))
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())
