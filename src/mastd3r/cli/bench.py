"""What ``mastd3r bench`` does: run a suite's missing entries, then write its tables and plots."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from ..errors import InputError
from .batch import check_ray_options, cluster_for, ray_options
from .options import path
from .screen import screen

if TYPE_CHECKING:
    from ..experiments.store import Store
    from ..experiments.suite import Entry, SequenceSpec, Suite
    from ..tasks.processes import Limits


def bench_parser(p: argparse.ArgumentParser) -> None:
    """Fill in the parser of ``bench``."""
    p.add_argument("suite", help="tum-dynamic, bonn, kitti, correction, loss, local, or a YAML file of your own")
    p.add_argument(
        "--data", type=path, default=Path("datasets"), help="folder that holds the sequences (default datasets)"
    )
    p.add_argument("--out", type=path, help="where results go and stay (default runs/bench-SUITE)")
    p.add_argument("--jobs", type=int, metavar="N", help="runs at once, each on its share of the cores (default 1)")
    p.add_argument("--memory-mib", type=float, metavar="M", help="for all of them (default: 80 %% of the machine's)")
    ray_options(p)
    p.add_argument("--seeds", type=int, nargs="+", metavar="N", help="instead of the suite's")
    p.add_argument("--sequences", nargs="+", metavar="NAME", help="some of the suite's; for local, folders of --data")
    p.add_argument("--only", metavar="PATTERN", help="run entries whose sequence/variant/seed fits, such as 'jam/*/0'")
    p.add_argument("--retry", action="store_true", help="run entries again that have failed")
    p.add_argument("--list", action="store_true", help="show the entries and their state, run nothing")
    p.set_defaults(act=_bench)


def _bench(args: argparse.Namespace, console: Console) -> int:
    from ..experiments.store import Store
    from ..experiments.suite import entries_of, load_suite, sequences_of
    from ..tasks.processes import limits

    suite = load_suite(args.suite)
    check_ray_options(args)
    allowed = limits(args.jobs, args.memory_mib)
    sequences = sequences_of(suite, args.data, args.sequences)
    chosen = entries_of(suite, sequences, args.seeds, args.only)
    folders = {s.name: found for s in sequences if (found := s.find(args.data)) is not None}
    store = Store(args.out or Path("runs") / f"bench-{suite.name}")
    if args.list:
        return _show_list(chosen, folders, store)
    store.prepare()
    todo = [e for e in chosen if e.sequence.name in folders and _is_missing(store.get(e), args.retry)]
    _run(todo, len(chosen), folders, store, allowed, args, console)
    written = _write(suite, sequences, folders, args, store)
    _say_what_is_missing(written, console)
    screen().print(f"wrote {store.out / 'table.md'} and {store.out / 'table.html'}", soft_wrap=True, markup=False)
    if not folders:
        raise InputError(f"--data {args.data}: expected sequences of {suite.name}, got none; see {store.out}/table.md")
    return 0


def _is_missing(record: dict[str, Any] | None, retry: bool) -> bool:
    return record is None or (retry and record["status"] == "failed")


def _show_list(chosen: list[Entry], folders: dict[str, Path], store: Store) -> int:
    table = Table("", "sequence/variant/seed", "state", "needs [MiB]", "took [s]")
    needs = store.needs(chosen)
    for number, entry in enumerate(chosen, 1):
        record = store.get(entry)
        state = record["status"] if record else "to run" if entry.sequence.name in folders else "sequence missing"
        took = f"{record['wall_s']:.0f}" if record else ""
        table.add_row(str(number), entry.label, state, f"{needs[entry.id]:.0f}", took)
    screen().print(table)
    return 0


def _run(
    todo: list[Entry],
    chosen: int,
    folders: dict[str, Path],
    store: Store,
    allowed: Limits,
    args: argparse.Namespace,
    console: Console,
) -> None:
    from ..experiments.execute import run_entries
    from ..export.metric_names import summary_line

    cluster = cluster_for(args, store.runs) if args.ray is not None and todo else None
    where = f"{allowed.jobs} at once within {allowed.memory_mib:.0f} MiB" if cluster is None else cluster.said
    console.print(f"{len(todo)} of {chosen} entries to run, {where}", highlight=False, markup=False, soft_wrap=True)
    count = 0

    def done(entry: Entry, record: dict[str, Any]) -> None:
        nonlocal count
        count += 1
        said = summary_line(record["metrics"]) if record["status"] == "complete" else f"failed: {record['error']}"
        line = f"{count}/{len(todo)} {entry.label} ({record['wall_s']:.0f} s): {said}"
        console.print(line, markup=False, highlight=False, soft_wrap=True)

    run_entries(todo, folders, store, allowed, done=done, elsewhere=cluster)


def _write(
    suite: Suite, sequences: tuple[SequenceSpec, ...], folders: dict[str, Path], args: argparse.Namespace, store: Store
) -> dict[str, Any]:
    """results.json, tables and plots of everything that has run, whatever --only chose."""
    from ..experiments.plots import plots_of
    from ..experiments.render import as_html, as_markdown
    from ..experiments.store import read_results, results_of
    from ..experiments.suite import entries_of
    from ..export.files import write_json, write_text

    records = [r for e in entries_of(suite, sequences, args.seeds) if (r := store.get(e)) is not None]
    results = results_of(suite, sequences, folders, _command(args), records)
    write_json(store.out / "results.json", results)
    results = read_results(store.out / "results.json")  # what is drawn is what is kept
    plots = plots_of(results)
    for name, svg in plots.items():
        write_text(store.out / name, svg)
    write_text(store.out / "table.md", as_markdown(results, tuple(plots)))
    write_text(store.out / "table.html", as_html(results, tuple(plots.values())))
    return results


def _command(args: argparse.Namespace) -> str:
    """The command that makes the whole table; folders by the names that any machine may have."""
    words = ["mastd3r", "bench", Path(args.suite).name, "--data", "DATA", "--out", "OUT"]
    for option in ("sequences", "seeds"):
        if (values := getattr(args, option)) is not None:
            words += [f"--{option}", *map(str, values)]
    return shlex.join(words)


def _say_what_is_missing(results: dict[str, Any], console: Console) -> None:
    from ..experiments.render import absent, failures

    for line in absent(results):
        console.print(f"missing: {line}", markup=False, soft_wrap=True)
    for line in failures(results):
        console.print(f"failed: {line}", markup=False, soft_wrap=True)
