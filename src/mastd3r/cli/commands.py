"""What each command of the command line does."""

from __future__ import annotations

import _thread
import argparse
import logging
import os
import shutil
import tempfile
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn, get_args

import numpy as np
import yaml
from rich.console import Console
from rich.logging import RichHandler
from rich.table import Table

from .. import __version__
from ..config import Config, SourceKind, config_from_dict, config_from_yaml, config_to_yaml, with_override
from ..errors import ConfigError
from .bench import bench_parser
from .download import download_parser
from .weights import weights_parser

INTRINSICS_HELP = "a calibrated camera in pixels of the full-size image, OpenCV's distortion; or dataset: its own"
DEMO_SEED = 0
DEMO_STEPS, DEMO_GAUSSIANS = 1200, 30000  # small enough for three minutes on two cores


def dispatch(words: list[str]) -> int:
    """Parse and run one command; returns the exit code."""
    parser = _parser()
    args = parser.parse_args(words)
    console = Console(stderr=True)
    logging.basicConfig(
        level=_log_level(args),
        format="%(message)s",
        handlers=[RichHandler(console=console, show_path=False, show_time=False)],
        force=True,
    )
    args.words = ["mastd3r", *words]
    code: int = args.act(args, console)
    return code


def _log_level(args: argparse.Namespace) -> int:
    """--quiet leaves stderr to the one line that says why a run failed; run.json has the warnings."""
    if args.verbose:
        return logging.INFO
    return logging.CRITICAL if getattr(args, "quiet", False) else logging.WARNING


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, as everything else does."""

    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message}; see {self.prog} --help")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="mastd3r", description="Trajectory, static map and clean splat from a video.")
    parser.add_argument("--version", action="version", version=__version__)
    parser.add_argument("-v", "--verbose", action="store_true", help="say more")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _run_parser(commands.add_parser("run", help="a video, image folder or TUM-layout folder to a run folder"))
    demo = commands.add_parser("demo", help="make a small clip with a moving object and run the whole job on it")
    demo.add_argument("--out", type=Path, default=Path("runs/demo"), help="run folder (default runs/demo)")
    demo.add_argument("--frames", type=int, default=90, help="frames of the clip (default 90)")
    demo.set_defaults(act=_demo)
    _eval_parser(commands.add_parser("eval", help="score a run, or another system's trajectory, against truth"))
    export = commands.add_parser("export", help="write a run's trajectory or splat in another format")
    export.add_argument("run", type=Path)
    export.add_argument("--to", choices=("tum", "kitti", "colmap", "spz", "flight", "depth"), required=True)
    export.add_argument(
        "--out", type=Path, required=True, help="file (tum, kitti, spz, flight: .mp4) or folder (colmap, depth)"
    )
    export.set_defaults(act=_export)
    view = commands.add_parser("view", help="open a run's report in the browser")
    view.add_argument("run", type=Path)
    view.set_defaults(act=_view)
    bench_parser(commands.add_parser("bench", help="run a suite of experiments and make its tables"))
    weights_parser(commands.add_parser("weights", help="list, download and check the weights of the networks"))
    download_parser(commands.add_parser("download", help="list and bring the public datasets"))
    doctor = commands.add_parser("doctor", help="what this machine has, and what runs would choose")
    doctor.set_defaults(act=_doctor)
    return parser


def _eval_parser(p: argparse.ArgumentParser) -> None:
    p.add_argument("paths", type=Path, nargs="+", metavar="[RUN] SEQUENCE", help="no RUN with --trajectory")
    p.add_argument("--trajectory", type=Path, metavar="FILE", help="poses that another system has written")
    p.add_argument("--format", choices=("tum", "kitti", "euroc"), help="of that file")
    p.add_argument("--out", type=Path, metavar="FILE", help="with --trajectory: write the figures as JSON")
    p.set_defaults(act=_eval)


def _run_parser(p: argparse.ArgumentParser) -> None:
    p.add_argument("source", type=Path, help="video, folder of images, or sequence of a dataset (mastd3r download)")
    p.add_argument("--out", type=Path, required=True, help="run folder")
    p.add_argument("--config", type=Path, help="YAML file with options that differ from the defaults")
    p.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="any option of config.yaml")
    p.add_argument("--pointmaps", choices=("auto", "geometric", "mast3r", "depth"))
    p.add_argument("--semantics", choices=("auto", "none", "dinov2", "maps"))
    p.add_argument("--maps", type=Path, help="folder of P(movable) maps, named like the frames or by timestamp")
    p.add_argument("--correction", choices=("none", "coarse", "fine", "coarse-to-fine"))
    p.add_argument("--map-loss", choices=("plain", "mask", "uncertainty", "full"))
    p.add_argument("--no-map", action="store_true", help="trajectory, masks and cloud only")
    p.add_argument("--intrinsics", metavar="FX,FY,CX,CY[,K1[,K2,P1,P2[,K3[,K4,K5,K6]]]]|dataset", help=INTRINSICS_HELP)
    p.add_argument("--kind", choices=get_args(SourceKind), help="layout of the source (default: found by looking)")
    p.add_argument("--realtime", action="store_true", help="start the map while tracking, in a process of its own")
    p.add_argument("--start", type=int, help="first frame, from 0")
    p.add_argument("--end", type=int, help="one past the last frame")
    p.add_argument("--stride", type=int, help="every n-th frame")
    p.add_argument("--seed", type=int)
    p.add_argument("--quiet", action="store_true", help="no progress bars, no warnings")
    p.add_argument("--end-with-stdin", action="store_true", help=argparse.SUPPRESS)  # for runs of a bench
    p.set_defaults(act=_run)


def config_from_args(args: argparse.Namespace) -> Config:
    """Defaults, then the file, then --set, then the named options."""
    config = config_from_yaml(args.config) if args.config else Config()
    for item in args.set:
        config = with_override(config, item)
    for name in ("pointmaps", "semantics", "correction", "seed"):
        if getattr(args, name) is not None:
            config = replace(config, **{name: getattr(args, name)})
    window = {k: getattr(args, k) for k in ("start", "end", "stride", "kind") if getattr(args, k) is not None}
    config = replace(config, source=replace(config.source, **window))
    if args.map_loss is not None:
        config = replace(config, mapping=replace(config.mapping, loss=args.map_loss))
    if args.realtime and args.no_map:
        raise ConfigError("--realtime: expected a map to be made, got --no-map")
    if args.realtime:
        config = replace(config, mapping=replace(config.mapping, realtime=True))
    if args.no_map:
        config = replace(config, mapping=replace(config.mapping, enabled=False))
    if args.maps is not None and config.semantics == "auto":
        config = replace(config, semantics="maps")
    if args.intrinsics == "dataset":
        config = replace(config, camera=replace(config.camera, intrinsics=(), from_dataset=True))
    elif args.intrinsics is not None:
        given = _numbers(args.intrinsics)
        config = replace(config, camera=replace(config.camera, intrinsics=given, from_dataset=False))
    return config


def _numbers(text: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(x) for x in text.replace(",", " ").split())
    except ValueError as e:
        raise ConfigError(f"--intrinsics: expected fx,fy,cx,cy and OpenCV's distortion, got {text!r}") from e
    if not numbers:
        raise ConfigError("--intrinsics: expected fx,fy,cx,cy and OpenCV's distortion, got nothing")
    return numbers


def _run(args: argparse.Namespace, console: Console) -> int:
    if args.end_with_stdin:
        threading.Thread(target=_interrupt_when_stdin_closes, daemon=True).start()
    config = config_from_args(args)
    return _run_and_show(args.source, args.out, config, args.words, console, quiet=args.quiet, maps=args.maps)


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
    from ..progress import Silent, Terminal

    reporter = Silent() if quiet else Terminal(console)
    result = reconstruct(source, out, config, maps=maps, command=words, reporter=reporter)
    Console().print(_table(result.metrics))
    Console().print(f"Open [bold]{result.path / 'report.html'}[/bold]")
    return 0


def _table(metrics: dict[str, Any]) -> Table:
    from ..export.metric_names import described, in_order, shown

    table = Table(show_header=False)
    for key, value in in_order(metrics):
        table.add_row(described(key), shown(key, value))
    return table


def _demo(args: argparse.Namespace, console: Console) -> int:
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


def _eval(args: argparse.Namespace, console: Console) -> int:
    from ..evaluation.evaluate import evaluate
    from ..export.files import write_json
    from ..export.read_run import read_run
    from ..sources import open_source

    if args.trajectory is not None:
        return _eval_trajectory(args)
    if len(args.paths) != 2 or args.format or args.out:
        got = "--format or --out without it" if args.format or args.out else f"{len(args.paths)} path(s)"
        raise ConfigError(f"eval: expected RUN SEQUENCE, or --trajectory FILE --format KIND SEQUENCE, got {got}")
    run, sequence = args.paths
    recorded = read_run(run)
    config = config_from_dict(yaml.safe_load(recorded.config) or {}) if recorded.config else Config()
    source = open_source(sequence, config.source)
    found = evaluate(run, source.truth(), source.frames()).metrics
    metrics = {**recorded.metrics, **found}
    write_json(run / "metrics.json", metrics)
    Console().print(_table(metrics))
    return 0


def _eval_trajectory(args: argparse.Namespace) -> int:
    """Another system's poses, scored as our own are; rows that have no time are the frames' in order."""
    from ..evaluation.evaluate import evaluate_trajectory
    from ..export.files import write_json
    from ..export.trajectory_files import read_trajectory
    from ..sources import open_source

    if len(args.paths) != 1 or args.format is None:
        got = f"{len(args.paths)} paths and --format {args.format}"
        raise ConfigError(f"eval --trajectory: expected --format tum, kitti or euroc and one SEQUENCE, got {got}")
    source = open_source(args.paths[0], Config().source)
    times_s = np.array([f.timestamp_s for f in source.frames()])
    found = evaluate_trajectory(read_trajectory(args.trajectory, args.format, times_s), source.truth(), times_s)
    Console().print(_table(found.metrics))
    if args.out is not None:
        write_json(args.out, found.metrics)
    return 0


def _export(args: argparse.Namespace, console: Console) -> int:
    from ..export.formats import export_run

    if args.to in ("spz", "flight", "depth"):
        from ..offline.renders import export_splat

        written = export_splat(args.run, args.to, args.out)
    else:
        written = export_run(args.run, args.to, args.out)
    Console().print(f"wrote {written}")
    return 0


def _view(args: argparse.Namespace, console: Console) -> int:
    import webbrowser

    from ..export.read_run import read_run

    report = read_run(args.run).path / "report.html"
    if not report.is_file():
        raise ConfigError(f"{report}: expected the report of a complete run, got none")
    Console().print(f"opening {report}")
    webbrowser.open(report.resolve().as_uri())
    return 0


def _doctor(args: argparse.Namespace, console: Console) -> int:
    from ..export.machine import machine_info
    from ..mapping.rasterise import map_device
    from ..parts import chosen_pointmaps

    table = Table(show_header=False)
    for key, value in machine_info().items():
        table.add_row(key, str(value))
    Console().print(table)
    kind, why = chosen_pointmaps(Config())
    device, reason = map_device("auto")
    Console().print(f"pointmaps auto: {kind} ({why}) · map auto: {device} ({reason})")
    Console().print("[dim]effective defaults:[/dim]\n" + config_to_yaml(Config()))
    return 0
