"""What each command of the command line does. Whatever is heavy is loaded by the command that needs it."""

from __future__ import annotations

import _thread
import argparse
import os
import shutil
import tempfile
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from ..config import Config, config_to_yaml
from ..errors import ConfigError
from .options import checked_minutes, config_from_args

DEMO_SEED = 0
DEMO_STEPS, DEMO_GAUSSIANS = 1200, 30000  # small enough for three minutes on two cores


def run(args: argparse.Namespace, console: Console) -> int:
    """``mastd3r run``."""
    if args.end_with_stdin:
        threading.Thread(target=_interrupt_when_stdin_closes, daemon=True).start()
    config = config_from_args(args)
    return _run_and_show(args.source, args.out, config, args.words, console, quiet=args.quiet, maps=args.maps)


def train_map(args: argparse.Namespace, console: Console) -> int:
    """``mastd3r map``."""
    from ..pipeline import load
    from ..progress import Silent
    from .terminal import Terminal

    minutes = None if args.minutes is None else checked_minutes(args.minutes, "--minutes")
    run = load(args.run)
    reporter = Silent() if args.quiet else Terminal(console)
    metrics = run.train_map(minutes, args.quality, source=args.source, reporter=reporter)
    Console().print(_table(metrics))
    Console().print(f"Open [bold]{run.path / 'report.html'}[/bold]", soft_wrap=True)
    return 0


def _interrupt_when_stdin_closes() -> None:
    """Whoever started this run holds the other end: when that process is gone, this one ends as on Ctrl-C."""
    while os.read(0, 1024):
        pass
    _thread.interrupt_main()


def _run_and_show(
    source: Path,
    out: Path,
    config: Config,
    words: list[str],
    console: Console,
    *,
    quiet: bool = False,
    maps: Path | None = None,
) -> int:
    from ..pipeline import reconstruct
    from ..progress import Silent
    from .terminal import Terminal

    reporter = Silent() if quiet else Terminal(console)
    result = reconstruct(source, out, config, maps=maps, command=words, reporter=reporter)
    if result.observability.get("said"):
        Console().print(f"[bold]{result.observability['said']}[/bold]", soft_wrap=True)
    Console().print(_table(result.metrics))
    Console().print(f"Open [bold]{result.path / 'report.html'}[/bold]", soft_wrap=True)
    return 0


def _table(metrics: dict[str, Any]) -> Table:
    from ..export.metric_names import described, in_order, shown

    table = Table(show_header=False)
    for key, value in in_order(metrics):
        table.add_row(described(key), shown(key, value))
    return table


def demo(args: argparse.Namespace, console: Console) -> int:
    """``mastd3r demo``."""
    from ..sources.synthetic import make_room_clip

    if args.frames < 30:
        raise ConfigError(f"--frames: expected at least 30, got {args.frames}")
    with tempfile.TemporaryDirectory() as folder:
        clip = Path(folder) / "room"
        with console.status("making the clip: a furnished room with a moving ball"):
            make_room_clip(clip, frames=args.frames, seed=DEMO_SEED)
        config = replace(
            Config(), mapping=replace(Config().mapping, iterations=DEMO_STEPS, max_gaussians=DEMO_GAUSSIANS)
        )
        code = _run_and_show(clip, args.out, config, args.words, console)
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
        Console().print(_table(load(run).evaluate(sequence)))
        return 0
    if len(args.paths) != 1 or args.format is None:
        got = f"{len(args.paths)} paths and --format {args.format}"
        raise ConfigError(f"eval --trajectory: expected --format tum, kitti or euroc and one SEQUENCE, got {got}")
    metrics = evaluate_trajectory(args.trajectory, args.format, args.paths[0])
    Console().print(_table(metrics))
    if args.out is not None:
        write_json(args.out, metrics)
    return 0


def export(args: argparse.Namespace, console: Console) -> int:
    """``mastd3r export``."""
    from ..pipeline import load
    from ..progress import Silent
    from .terminal import Terminal

    reporter = Silent() if args.quiet else Terminal(console)
    written = load(args.run).export(args.to, args.out, source=args.source, reporter=reporter)
    Console().print(f"wrote {written}", soft_wrap=True)
    return 0


def view(args: argparse.Namespace, console: Console) -> int:
    """``mastd3r view``."""
    import webbrowser

    from ..pipeline import load

    report = load(args.run).path / "report.html"
    if not report.is_file():
        raise ConfigError(f"{report}: expected the report of a complete run, got none")
    Console().print(f"opening {report}", soft_wrap=True)
    webbrowser.open(report.resolve().as_uri())
    return 0


def doctor(args: argparse.Namespace, console: Console) -> int:
    """``mastd3r doctor``."""
    from ..export.machine import machine_info
    from ..mapping.rasterise import map_device
    from ..parts import chosen_pointmaps
    from ..registry import REGISTRIES

    table = Table(show_header=False)
    for key, value in machine_info().items():
        table.add_row(key, str(value))
    Console().print(table)
    for registry in REGISTRIES:
        parts = "; ".join(f"{e.name} ({e.summary})" for e in registry.entries())
        Console().print(f"{registry.option}: {parts}", highlight=False, markup=False)
    kind, why = chosen_pointmaps(Config())
    device, reason = map_device("auto")
    Console().print(f"pointmaps auto: {kind} ({why}) · map auto: {device} ({reason})")
    Console().print("[dim]effective defaults:[/dim]\n" + config_to_yaml(Config()))
    return 0
