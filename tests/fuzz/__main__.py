"""``python -m fuzz``: a round of bad inputs; exit code 1 where a command did what none may do.

Stopped halfway (Ctrl-C, SIGTERM), it prints and writes the counts of what was done, and ends with 130; after a kill
``--out`` has those up to a minute before.
"""

from __future__ import annotations

import argparse
import datetime
import importlib
import json
import pkgutil
import shutil
import signal
import sys
import tempfile
import time
import types
import webbrowser
from collections import Counter
from pathlib import Path
from typing import Any

import miniatures
from fuzz import (  # noqa: F401  they register themselves
    kinds_download,
    kinds_live,
    kinds_many,
    kinds_maps,
    kinds_runs,
    kinds_sources,
    kinds_words,
)
from fuzz.case import KINDS, planned
from fuzz.harness import FAULTS, Outcome, run_case
from fuzz.material import Shared, aside, in_a_child
from mastd3r.export.machine import machine_info

SAVED_EVERY_S = 60.0
STOPPED = 130


def warm() -> None:
    """Load what commands load, so that no case pays for it; viewers end at once, loops begin cold."""
    import mastd3r

    for module in pkgutil.walk_packages(mastd3r.__path__, "mastd3r."):
        if not module.name.endswith(("__main__", "gsplat")):
            importlib.import_module(module.name)
    loop, view = (importlib.import_module(f"mastd3r.{name}") for name in ("live.loop", "cli.view"))
    webbrowser.open = lambda *_, **__: True  # type: ignore[assignment]
    view.time = types.SimpleNamespace(sleep=_ctrl_c)  # whoever looks at a run has seen it at once
    loop.warm_up = lambda *_: True


def _ctrl_c(seconds: float) -> None:
    raise KeyboardInterrupt


def compile_kernels(root: Path, shared: Shared) -> None:
    """Good input once through everything, so that no bad input is charged with compiling: into numba's own cache."""
    depth = miniatures.tum_rgbd(root / "mini", count=12, size=(160, 120)).folder
    runs = [["run", str(depth), "--pointmaps=depth"], ["run", str(room_clip(root / "clip"))]]
    for n, words in enumerate(runs):
        in_a_child([*words, "--no-map", "--out", str(root / f"good-{n}")])
    for name in ("flight.mp4", "depth", "plates", "mesh.ply", "cloud.ply"):
        in_a_child(["export", str(shared.run), "--to", name.partition(".")[0], "--out", str(root / f"good-{name}")])
    in_a_child(["map", str(shutil.copytree(shared.run, root / "copy")), "--minutes", "0.001"])
    in_a_child(["eval", str(shared.run), str(shared.run.parent / "photos")])
    photos = str(shared.run.parent / "photos")
    in_a_child(["localise", str(shared.map), photos, "--out", str(root / "good-places")])
    in_a_child(["run", photos, "--map", str(shared.map), "--no-map", "--out", str(root / "good-in-map")])


def room_clip(folder: Path) -> Path:
    """A short clip in which everything can be tracked."""
    from mastd3r.sources import synthetic

    def make() -> None:
        synthetic.CLIP_FPS = 5.0
        synthetic.make_room_clip(folder, frames=24, width=160, height=120)

    aside(make)
    return folder


def main() -> int:
    """Run the cases, print what is wrong with which seed, and a table; write the same as JSON."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--cases", type=int, default=1000)
    p.add_argument("--seed", type=int, default=0, help="of the whole round")
    p.add_argument("--kind", choices=tuple(KINDS), help="cases of one kind only, --cases of them all kinds would have")
    p.add_argument("--case", type=int, help="the seed that a failure has printed, with --kind: this case alone")
    p.add_argument("--keep", type=Path, help="folder for the files of the cases (default: removed)")
    p.add_argument("--quick", action="store_true", help="leave out what tracks or draws")
    p.add_argument("--out", type=Path, help="JSON with all counts")
    args = p.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    warm()
    plan = planned(args.cases, args.seed, args.kind) if args.case is None else [(args.kind, args.case)]
    tally = Tally(len(plan), args.seed, args.out)
    with tempfile.TemporaryDirectory(prefix="fuzz-") as temporary:
        root = args.keep or Path(temporary)
        shared_at = Path(temporary) / "shared"
        shared_at.mkdir()
        shared = Shared(shared_at, args.quick)
        try:
            if not args.quick:
                compile_kernels(shared_at, shared)
            for name, seed in plan:
                outcome = run_case(name, seed, root, shared, keep=args.keep is not None)
                tally.add(outcome)
                if outcome.faults or args.case is not None:
                    print(outcome, flush=True)
        except KeyboardInterrupt:
            print(f"stopped after {len(tally.done)} of {len(plan)} cases", flush=True)
    if not tally.done:
        return STOPPED
    summary = tally.save()
    print(as_table(summary))
    return STOPPED if len(tally.done) < len(plan) else 1 if summary["faults"]["all"] else 0


class Tally:
    """What is done so far; a file has it too, so that a round which is cut short has not been in vain."""

    def __init__(self, planned_cases: int, seed: int, out: Path | None) -> None:
        self.done: list[Outcome] = []
        self._planned, self._out = planned_cases, out
        machine = machine_info()
        self._made = {"seed": seed, "commit": machine["git_commit"], "date": str(datetime.date.today())}
        self._made["processor"] = f"{machine['processor']}, {machine['cores']} cores"
        self._began = self._saved = time.monotonic()

    def add(self, outcome: Outcome) -> None:
        """One more."""
        self.done.append(outcome)
        if time.monotonic() - self._saved > SAVED_EVERY_S:
            self.save()

    def save(self) -> dict[str, Any]:
        """Write the counts, and give them."""
        self._saved = time.monotonic()
        summary = {"made": self._made, "planned": self._planned, **summed(self.done, self._saved - self._began)}
        if self._out is not None:
            part = self._out.with_name(f"{self._out.name}.part")
            part.write_text(json.dumps(summary, indent=1))
            part.replace(self._out)
        return summary


def summed(done: list[Outcome], wall_s: float) -> dict[str, Any]:
    """Counts by kind and fault, exit codes, and the extremes."""
    kinds = {k: Counter(f for o in done if o.kind == k for f in o.faults) for k in {o.kind: None for o in done}}
    total = Counter(f for o in done for f in o.faults)
    return {
        "cases": len(done),
        "faults": {**{f: total[f] for f in FAULTS}, "all": sum(bool(o.faults) for o in done)},
        "exit codes": dict(sorted(Counter(str(o.code) for o in done).items())),
        "longest_s": round(max(o.wall_s for o in done), 2),
        "longest_cpu_s": round(max(o.cpu_s for o in done), 2),
        "peak_mib": round(max(o.peak_mib for o in done)),
        "wall_s": round(wall_s, 1),
        "slowest": [
            [o.kind, o.seed, round(o.wall_s, 2), round(o.cpu_s, 2)] for o in sorted(done, key=lambda o: -o.wall_s)[:8]
        ],
        "largest": [[o.kind, o.seed, round(o.peak_mib)] for o in sorted(done, key=lambda o: -o.peak_mib)[:8]],
        "kinds": {k: {"cases": sum(o.kind == k for o in done), **{f: c[f] for f in FAULTS}} for k, c in kinds.items()},
        "failed": [{"kind": o.kind, "seed": o.seed, "faults": o.faults, "words": o.words} for o in done if o.faults],
    }


def as_table(summary: dict[str, Any]) -> str:
    """The summary for people."""
    lines = [f"{'kind':22} cases " + " ".join(f"{f:>9}" for f in FAULTS)]
    rows = {**summary["kinds"], "all": {"cases": summary["cases"], **summary["faults"]}}
    lines += [f"{k:22} {c['cases']:5} " + " ".join(f"{c[f]:9}" for f in FAULTS) for k, c in rows.items()]
    codes = ", ".join(f"{code}: {n}" for code, n in summary["exit codes"].items())
    work = f"({summary['longest_cpu_s']} s of work)"
    extremes = (
        f"longest {summary['longest_s']} s {work}, at most {summary['peak_mib']} MiB, all in {summary['wall_s']} s"
    )
    return "\n".join([*lines, f"exit codes {codes}; {extremes}"])


if __name__ == "__main__":
    sys.exit(main())
