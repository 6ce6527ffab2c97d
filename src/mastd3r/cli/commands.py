"""What each command of the command line does. Whatever is heavy is loaded by the command that needs it."""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
import threading
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from ..config import Config, config_to_yaml, ranges
from ..errors import ConfigError, InputError
from ..registry import Range
from .batch import segments_of
from .options import checked_minutes, config_from_args
from .screen import screen
from .signals import end_this_command

if TYPE_CHECKING:
    from ..offline.reconstruction import Reconstruction
    from ..offline.segmented import Segments
    from ..progress import Reporter

DEMO_SEED, DEMO_FRAMES = 0, Range(30, 10_000)
DEMO_STEPS, DEMO_GAUSSIANS = 850, 30000  # of the 75 seconds on two cores, half


def run(args: argparse.Namespace, console: Console) -> int:
    """``mastd3r run``."""
    if args.end_with_stdin:
        threading.Thread(target=_interrupt_when_stdin_closes, daemon=True).start()
    config = config_from_args(args)
    if args.segment:
        from ..pipeline import track_piece

        track_piece(args.source, args.out, config, maps=args.maps, command=args.words)
        return 0
    return _run_and_show(args.source, config, args, console, segments_of(args))


def scale(args: argparse.Namespace, console: Console) -> int:
    """``mastd3r scale``."""
    from ..pipeline import load

    facts = load(args.run).measure_scale(args.by)
    screen().print(f"{facts['said']}; exports of {args.run} are in metres now", soft_wrap=True, markup=False)
    return 0


def resume(args: argparse.Namespace, console: Console) -> int:
    """``mastd3r resume``."""
    from ..pipeline import resume as go_on

    show(go_on(args.run, reporter=reporter_of(args, console)))
    return 0


def train_map(args: argparse.Namespace, console: Console) -> int:
    """``mastd3r map``."""
    from ..pipeline import load

    minutes = None if args.minutes is None else checked_minutes(args.minutes, "--minutes")
    run = load(args.run)
    reporter = reporter_of(args, console)
    metrics = run.train_map(minutes, args.quality, source=args.source, reporter=reporter)
    screen().print(_table(metrics))
    _open(run.path)
    return 0


def reporter_of(args: argparse.Namespace, console: Console) -> Reporter:
    """Bars, unless ``--quiet`` is said; ``demo`` has no such option."""
    from ..progress import Silent
    from .terminal import Terminal

    return Silent() if getattr(args, "quiet", False) else Terminal(console)


def _interrupt_when_stdin_closes() -> None:
    """Whoever started this run holds the other end: when that process is gone, this one ends as on Ctrl-C."""
    while os.read(0, 1024):
        pass
    end_this_command()


def _run_and_show(
    source: Path,
    config: Config,
    args: argparse.Namespace,
    console: Console,
    segments: Segments | None = None,
) -> int:
    """``args`` are those of ``run``, or of ``demo``, which has fewer."""
    from ..pipeline import reconstruct

    result = reconstruct(
        source,
        args.out,
        config,
        maps=getattr(args, "maps", None),
        map=getattr(args, "map", None),
        overwrite=args.overwrite,
        command=args.words,
        reporter=reporter_of(args, console),
        segments=segments,
    )
    show(result)
    return 0


def show(result: Reconstruction) -> None:
    """What came of a run."""
    if result.continues:
        screen().print(result.continues["said"], style="bold", soft_wrap=True, markup=False)
    if result.observability.get("said"):
        screen().print(result.observability["said"], style="bold", soft_wrap=True, markup=False)
    screen().print(_table(result.metrics))
    if result.scale.get("said"):
        screen().print(f"{result.scale['said']}; all lengths are metres", soft_wrap=True, markup=False)
    _open(result.path)
    if result.scale.get("refused"):
        raise InputError(
            f"{result.scale['refused']}; the run is complete, its lengths are map units: mastd3r scale {result.path} "
            "tries another way"
        )


def _open(run: Path) -> None:
    """Where to look now."""
    screen().print("Open", Text(str(run / "report.html"), "bold"), soft_wrap=True)


def _table(metrics: dict[str, Any]) -> Table:
    from ..export.metric_names import described, in_order, shown

    table = Table(show_header=False)
    for key, value in in_order(metrics):
        table.add_row(described(key), Text(shown(key, value)))
    return table


def demo(args: argparse.Namespace, console: Console) -> int:
    """``mastd3r demo``."""
    from ..sources.synthetic import make_room_clip

    DEMO_FRAMES.check(args.frames, "--frames")
    with tempfile.TemporaryDirectory() as folder:
        clip = Path(folder) / "room"
        with console.status("making the clip: a furnished room with a moving ball"):
            make_room_clip(clip, frames=args.frames, seed=DEMO_SEED)
        config = replace(
            Config(), mapping=replace(Config().mapping, iterations=DEMO_STEPS, max_gaussians=DEMO_GAUSSIANS)
        )
        code = _run_and_show(clip, config, args, console)
        shutil.copy(clip / "rgb" / sorted(p.name for p in (clip / "rgb").iterdir())[0], args.out / "first_frame.png")
    return code


def evaluate_run(args: argparse.Namespace, console: Console) -> int:
    """``mastd3r eval``."""
    from ..export.files import write_json
    from ..pipeline import evaluate_trajectory, load

    if args.trajectory is None:
        if len(args.paths) != 2 or args.format or args.out:
            got = "--format or --out without it" if args.format or args.out else f"{len(args.paths)} path(s)"
            raise ConfigError(f"eval: expected RUN SEQUENCE, or --trajectory FILE --format KIND SEQUENCE, got {got}")
        run, sequence = args.paths
        screen().print(_table(load(run).evaluate(sequence)))
        return 0
    if len(args.paths) != 1 or args.format is None:
        got = f"{len(args.paths)} paths and --format {args.format}"
        raise ConfigError(f"eval --trajectory: expected --format tum, kitti or euroc and one SEQUENCE, got {got}")
    metrics = evaluate_trajectory(args.trajectory, args.format, args.paths[0])
    screen().print(_table(metrics))
    if args.out is not None:
        write_json(args.out, metrics)
    return 0


def export(args: argparse.Namespace, console: Console) -> int:
    """``mastd3r export``."""
    from ..pipeline import load

    reporter = reporter_of(args, console)
    options = {"source": args.source, "undistort": args.undistort, "all_poses": args.all_poses}
    run = load(args.run)
    written = run.export(args.to, args.out, reporter=reporter, **options)
    unit = ", in metres" if "metres_per_unit" in run.scale else ""
    screen().print(f"wrote {written}{unit}", soft_wrap=True, markup=False)
    return 0


def doctor(args: argparse.Namespace, console: Console) -> int:
    """``mastd3r doctor``."""
    from ..export.machine import machine_info
    from ..mapping.rasterise import map_device
    from ..parts import chosen_pointmaps
    from ..registry import REGISTRIES

    table = Table(show_header=False)
    for key, value in machine_info().items():
        table.add_row(key, Text(str(value)))
    screen().print(table)
    for registry in REGISTRIES:
        parts = "; ".join(f"{e.name} ({e.summary})" for e in registry.entries())
        screen().print(f"{registry.option}: {parts}", highlight=False, markup=False)
    kind, why = chosen_pointmaps(Config())
    device, reason = map_device("auto")
    screen().print(f"pointmaps auto: {kind} ({why}) · map auto: {device} ({reason})")
    screen().print("[dim]effective defaults:[/dim]\n" + config_to_yaml(Config()))
    screen().print("[dim]numbers may be:[/dim]")
    for key, words in ranges().items():
        screen().print(f"{key}: {words}", highlight=False, markup=False)
    return 0
