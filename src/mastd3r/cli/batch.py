"""What ``mastd3r batch`` does: a run of each of many sources, some at once, each in a folder of its own."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from ..errors import ConfigError, InputError
from ..metric.spec import absolute
from .options import config_from_args, path
from .screen import screen

if TYPE_CHECKING:
    from collections import Counter

    from ..offline.segmented import Segments
    from ..tasks.batch import Batch
    from ..tasks.cluster import Cluster
    from ..tasks.processes import Limits, Processes
    from ..tasks.runner import Change

EXIT_FAULT = 1  # as main.py
RETRIES = 2
SHOWN = 10  # sources of a kind that the terminal names
OWN = ("quiet", "overwrite")  # options of run that batch takes itself


def task_options(p: argparse.ArgumentParser) -> None:
    """How many tasks run at once, and where."""
    p.add_argument(
        "--jobs",
        type=int,
        metavar="N",
        help="at once, each on its share of the cores (default: as many as cores and memory allow)",
    )
    p.add_argument("--memory-mib", type=float, metavar="M", help="for all of them (default: 80 %% of the machine's)")
    p.add_argument(
        "--retries",
        type=int,
        default=RETRIES,
        metavar="N",
        help=f"more attempts at what was killed (default {RETRIES})",
    )

    ray_options(p)


def ray_options(p: argparse.ArgumentParser) -> None:
    """Where tasks run, if not here."""
    p.add_argument("--ray", metavar="auto|HOST:PORT|local", help="on the nodes of a Ray cluster that share --out")
    p.add_argument("--task-cores", type=int, metavar="N", help="with --ray: cores that a task asks for (default 2)")
    p.add_argument(
        "--task-gpus", type=float, metavar="G", help="with --ray: accelerators (default 1 where a node has one, else 0)"
    )


def segment_options(p: argparse.ArgumentParser) -> None:
    """A long video in pieces, and where those are tracked."""
    p.add_argument(
        "--segment-frames",
        type=int,
        metavar="N",
        help="track pieces of N frames by tasks of their own, and join them (default: where memory needs it)",
    )
    task_options(p)


def batch_parser(p: argparse.ArgumentParser, of_run: Sequence[argparse.Action]) -> None:
    """Fill in the parser of ``batch``; ``of_run``: the options that it shares with ``run``."""
    p.add_argument(
        "sources",
        type=path,
        nargs="+",
        metavar="LIST",
        help="text file with a source a line, folder of videos, or sources",
    )
    p.add_argument("--out", type=path, required=True, help="folder for batch.json and a run folder a source")
    task_options(p)
    p.set_defaults(act=_batch, maps=None, of_run=of_run)


def options_of(args: argparse.Namespace, of_run: Sequence[argparse.Action]) -> list[str]:
    """What was said of run's options, as words that mean the same from any folder. Raises ConfigError, InputError."""
    config_from_args(args)  # before anything starts
    words = []
    for action in of_run:
        value = getattr(args, action.dest)
        if action.dest in OWN or value in (None, False, []):
            continue
        option = action.option_strings[-1]
        if value is True:
            words.append(option)
            continue
        for one in value if isinstance(value, list) else [value]:
            said = absolute(one) if action.dest == "scale" else os.path.abspath(one) if isinstance(one, Path) else one
            words.append(f"{option}={said}")
    return words


def _batch(args: argparse.Namespace, console: Console) -> int:
    from ..parts import chosen_pointmaps
    from ..tasks.batch import LOGS, MEMORY_MIB, NETWORK_MIB, Batch, claim_batch, sources_of
    from ..tasks.lock import alone_in

    options = options_of(args, args.of_run)
    allowed = limits_of(args)
    sources, twice = sources_of(args.sources)
    guess_mib = NETWORK_MIB if chosen_pointmaps(config_from_args(args))[0] == "mast3r" else MEMORY_MIB
    said = Said(console, quiet=args.quiet)
    for line in twice[:SHOWN]:
        said.line(line)
    if len(twice) > SHOWN:
        said.line(f"and {len(twice) - SHOWN} more that are named before")
    claim_batch(args.out, sources)
    with alone_in(args.out, "batch") as lock:
        batch = Batch(args.out, sources, options, overwrite=args.overwrite, guess_mib=guess_mib)
        _run(batch, allowed, lock, args, said)
    states = batch.states()
    screen().print(
        f"{states['complete']} of {states.total()} runs complete, see {batch.out / 'batch.json'}", soft_wrap=True
    )
    failed = [run for run in batch.runs.values() if run.state != "complete"]
    if not failed:
        return 0
    fault = next((run for run in failed if run.exit_code == EXIT_FAULT), None)
    if fault is not None:
        from .main import say

        log = batch.out / LOGS / f"{fault.name}.log"
        say(f"batch: {fault.name} ended by a fault of ours: {fault.reason}; its log is {log}")
        return EXIT_FAULT
    more = f" and {len(failed) - 1} more" if len(failed) > 1 else ""
    raise InputError(f"batch: expected every run to be complete, got {failed[0].name} failed{more}: {failed[0].reason}")


def place_for(args: argparse.Namespace, shared: Path, lock: int | None) -> Processes | Cluster:
    """Where the options say that tasks run; ``shared``: a folder that nodes of a cluster see too.

    Raises ConfigError, and what ``Cluster`` raises.
    """
    from ..tasks.processes import Processes

    if args.ray is None:
        return Processes(limits_of(args), lock)
    return cluster_for(args, shared)


def segments_of(args: argparse.Namespace) -> Segments:
    """How the options of ``run`` cut a long video. Raises ConfigError."""
    from ..offline.segmented import Segments

    limits_of(args)
    elsewhere = None if args.ray is None else partial(cluster_for, args)
    return Segments(args.segment_frames, args.jobs, args.memory_mib, args.retries, elsewhere)


def cluster_for(args: argparse.Namespace, shared: Path) -> Cluster:
    """The cluster that ``--ray`` names. Raises what ``Cluster`` raises."""
    from ..tasks.cluster import Asked, Cluster

    return Cluster(args.ray, shared, Asked(args.task_cores, args.task_gpus), args.jobs)


def limits_of(args: argparse.Namespace) -> Limits:
    """What the options say of how much may run at once on this machine. Raises ConfigError."""
    from ..export.machine import usable_cores
    from ..tasks.processes import limits

    if args.retries < 0:
        raise ConfigError(f"--retries: expected 0 or more, got {args.retries}")
    check_ray_options(args)
    return limits(usable_cores() if args.jobs is None else args.jobs, args.memory_mib)


def check_ray_options(args: argparse.Namespace) -> None:
    """Raises ConfigError for an option that says nothing where tasks run."""
    if args.ray is None and (args.task_cores, args.task_gpus) != (None, None):
        raise ConfigError("--task-cores, --task-gpus: expected --ray with them, got none; --jobs shares this machine")
    if args.ray is not None and args.memory_mib is not None:
        raise ConfigError("--memory-mib: expected tasks on this machine, got --ray; nodes have memory of their own")


def _run(batch: Batch, allowed: Limits, lock: int | None, args: argparse.Namespace, said: Said) -> None:
    from ..tasks.batch import LOGS
    from ..tasks.runner import run_tasks

    tasks = batch.missing()
    kept = len(batch.runs) - len(tasks)
    said.line(f"{len(tasks)} of {len(batch.runs)} runs to do{f', {kept} complete before' if kept else ''}")
    if not tasks:
        return
    for name, need_mib in batch.needs(tasks).items():
        if need_mib > allowed.memory_mib and args.ray is None:
            got = f"{allowed.memory_mib:.0f}"
            raise ConfigError(f"--memory-mib: expected {need_mib:.0f} or more, which {name} may need, got {got}")
    place = place_for(args, batch.out / LOGS, lock)
    said.line(place.said)

    def changed(change: Change) -> None:
        run = batch.note(change)
        said.change(run.name, change, batch.states())

    try:
        run_tasks(tasks, place, batch.needs, changed, retries=args.retries)
    finally:
        batch.stop()


class Said:
    """A line a change, on a terminal and where output goes to a file."""

    def __init__(self, console: Console, *, quiet: bool) -> None:
        self._console, self._quiet = console, quiet

    def line(self, text: str) -> None:
        """One line."""
        if not self._quiet:
            self._console.print(text, markup=False, highlight=False, soft_wrap=True)

    def change(self, name: str, change: Change, states: Counter[str]) -> None:
        """What has become of a task, and how many are how far."""
        node = f" on {change.node}" if change.node else ""
        tried = f" (attempt {change.attempt})" if change.attempt > 1 else ""
        ended = change.ended
        if ended is None:
            what = f"started{node}{tried}"
        elif ended.exit_code == 0:
            peak = "" if ended.peak_mib is None else f", {ended.peak_mib:.0f} MiB"
            what = f"complete in {ended.wall_s:.0f} s{peak}{tried}"
        elif change.state == "again":
            what = f"{ended.reason}{node}; to be tried again"
        else:
            what = f"failed{node}{tried}: {ended.reason}"
        of = states.total()
        self.line(f"[{states['complete'] + states['failed']}/{of}] {name}: {what}")
