"""The words of the command line: commands, options, their texts; choices are those of the registries."""

from __future__ import annotations

import argparse
import difflib
import re
from pathlib import Path
from typing import NoReturn, get_args

from .. import __version__
from ..config import PRESETS, CloudKind, Config, MapLossKind, MapQualityKind, MasksKind, SourceKind
from ..errors import ConfigError
from ..export.kinds import KINDS
from ..metric.spec import FORMS
from ..reading.files import short
from ..registry import ALIGNMENT, POINTMAPS, SEMANTICS, Registry
from . import commands
from .batch import batch_parser, segment_options
from .bench import bench_parser
from .compile import PARTS, compile_kernels
from .download import download_parser
from .live import finish_parser, live_parser
from .maps import localise_parser, save_parser
from .options import path
from .view import view_parser
from .weights import weights_parser

MOST_SHOWN = 400  # characters of what argparse says
INTRINSICS_HELP = "a calibrated camera in pixels of the full-size image, OpenCV's distortion; or dataset: its own"
QUALITY_HELP = (
    "image width, steps and number of Gaussians of the map, more on an accelerator than on the CPU "
    f"(default {Config().mapping.quality})"
)
OVERWRITE_HELP = "remove an earlier run in --out at once (default: it is replaced once the new one is complete)"
MINUTES_HELP = "train the map for so long, instead of for the number of steps of its quality (the default)"


FORMS_SHOWN = ", ".join(FORMS.values())
SCALE_HELP = f"everything in metres, taken from {FORMS_SHOWN} (default: map units)"
MASKS_HELP = (
    "of the second pass: from frames before and after, or causal: from those before alone, which costs less "
    f"(default {Config().masks})"
)
PRESET_HELP = "many options at once; fast: a first look; quality: dense cloud, finest map; paper: everything as printed"
CLOUD_HELP = f"dense: depth of every keyframe pixel too, as cloud_dense.ply (default {Config().cloud})"


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, as everything else does."""

    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{short(message, MOST_SHOWN)}{self._near(message)}; see {self.prog} --help")

    def _near(self, message: str) -> str:
        """What was perhaps meant, of the commands, choices and options there are."""
        unknown = re.search(r"unrecognized arguments: (--?[\w-]+)|invalid choice: '([^']*)'", message)
        if unknown is None:
            return ""
        word = unknown[1] or unknown[2]
        near = difflib.get_close_matches(word, self._options() if unknown[1] else self._choices(message), n=1)
        return f"; perhaps you meant {near[0]}" if near else ""

    def _options(self) -> list[str]:
        own = [word for action in self._actions for word in action.option_strings]
        commands = [c for a in self._actions if isinstance(a.choices, dict) for c in a.choices.values()]
        return own + [word for command in commands for word in command._options()]

    def _choices(self, message: str) -> list[str]:
        named = [a for a in self._actions if a.choices and message.startswith(f"argument {_name_of(a)}:")]
        return [str(choice) for action in named for choice in action.choices or ()]


def _name_of(action: argparse.Action) -> str:
    return "/".join(action.option_strings) or str(action.metavar or action.dest)


def parser() -> argparse.ArgumentParser:
    top = _Parser(prog="mastd3r", description="Trajectory, static map and clean splat from a video.")
    top.add_argument("--version", action="version", version=__version__)
    top.add_argument("-v", "--verbose", action="store_true", help="say more")
    known = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _run_parser(known.add_parser("run", help="a video, image folder or TUM-layout folder to a run folder"))
    many = known.add_parser("batch", help="a run of each of many videos, some at once")
    batch_parser(many, _run_options(many))
    again = known.add_parser("resume", help="go on with a run that was stopped, from its last checkpoint")
    again.add_argument("run", type=path, help="run folder; source and options are those that it was started with")
    again.add_argument("--quiet", action="store_true", help="no progress bars, no warnings")
    again.set_defaults(act=commands.resume)
    live_parser(known.add_parser("live", help="track a camera, stream or recording while it runs"))
    finish_parser(known.add_parser("finish", help="offline masks, cloud and map of a live run that kept its frames"))
    _map_parser(known.add_parser("map", help="go on with the map of a run that has ended"))
    save_parser(known.add_parser("save", help="keep the keyframes of a run as a map that images are found in"))
    localise_parser(known.add_parser("localise", help="where in a saved map images were taken"))
    demo = known.add_parser("demo", help="make a small clip with a moving object and run the whole job on it")
    demo.add_argument("--out", type=path, default=Path("runs/demo"), help="run folder (default runs/demo)")
    demo.add_argument("--frames", type=int, default=90, help="frames of the clip (default 90)")
    demo.add_argument("--overwrite", action="store_true", help=OVERWRITE_HELP)
    demo.set_defaults(act=commands.demo)
    _eval_parser(known.add_parser("eval", help="score a run, or another system's trajectory, against truth"))
    _export_parser(known.add_parser("export", help="write a run for other tools"))
    measured = known.add_parser("scale", help="measure metres on a run that has ended: its exports are in metres then")
    measured.add_argument("run", type=path, help="run folder")
    measured.add_argument("by", metavar="BY", help=f"what metres are taken from: {FORMS_SHOWN}")
    measured.set_defaults(act=commands.scale)
    view_parser(known.add_parser("view", help="show a run in the browser"))
    bench_parser(known.add_parser("bench", help="run a suite of experiments and make its tables"))
    weights_parser(known.add_parser("weights", help="list, download and check the weights of the networks"))
    download_parser(known.add_parser("download", help="list and bring the public datasets"))
    ahead = known.add_parser("compile", help="compile the kernels now, which the first run would wait for")
    ahead.add_argument("--part", choices=tuple(PARTS), help="this part alone, in this process")
    ahead.set_defaults(act=compile_kernels)
    doctor = known.add_parser("doctor", help="what this machine has, and what runs would choose")
    doctor.set_defaults(act=commands.doctor)
    for command in known.choices.values():
        command.add_argument("-v", "--verbose", action="store_true", default=argparse.SUPPRESS, help="say more")
    return top


def _map_parser(p: argparse.ArgumentParser) -> None:
    p.add_argument("run", type=path, help="run folder; its splat, poses, renders, figures and report are renewed")
    p.add_argument("--minutes", type=float, metavar="M", help="of training (default: as the run's config.yaml says)")
    p.add_argument(
        "--quality", choices=get_args(MapQualityKind), help="instead of the run's; the map never becomes coarser"
    )
    p.add_argument("--source", type=path, help="where the photographs are now (default: where the run read them)")
    p.add_argument("--quiet", action="store_true", help="no progress bars, no warnings")
    p.set_defaults(act=commands.train_map)


def _export_parser(p: argparse.ArgumentParser) -> None:
    p.add_argument("run", type=path, help="run folder")
    p.add_argument("--to", choices=tuple(KINDS), required=True, help="; ".join(f"{k}: {v}" for k, v in KINDS.items()))
    p.add_argument("--out", type=path, required=True, help="file or folder to write")
    p.add_argument("--source", type=path, help="where the photographs are now (default: where the run read them)")
    p.add_argument(
        "--undistort",
        action=argparse.BooleanOptionalAction,
        help="images of a pinhole, or the lens as it is (default: a pinhole where the lens is bent)",
    )
    p.add_argument("--all-poses", action="store_true", help="interpolated poses too, not only measured ones")
    p.add_argument("--quiet", action="store_true", help="no progress bars, no warnings")
    p.set_defaults(act=commands.export)


def _eval_parser(p: argparse.ArgumentParser) -> None:
    p.add_argument("paths", type=path, nargs="+", metavar="[RUN] SEQUENCE", help="no RUN with --trajectory")
    p.add_argument("--trajectory", type=path, metavar="FILE", help="poses that another system has written")
    p.add_argument("--format", choices=("tum", "kitti", "euroc"), help="of that file")
    p.add_argument("--out", type=path, metavar="FILE", help="with --trajectory: write the figures as JSON")
    p.set_defaults(act=commands.evaluate_run)


def _run_parser(p: argparse.ArgumentParser) -> None:
    p.add_argument("source", type=path, help="video, folder of images, or sequence of a dataset (mastd3r download)")
    p.add_argument("--out", type=path, required=True, help="run folder")
    p.add_argument("--map", type=path, help="go on in a map of mastd3r save: its frame, its lens, its lengths")
    p.add_argument("--maps", type=path, help="folder of P(movable) maps, named like the frames or by timestamp")
    _run_options(p)
    segment_options(p)
    p.add_argument("--end-with-stdin", action="store_true", help=argparse.SUPPRESS)  # for runs that are tasks
    p.add_argument("--segment", action="store_true", help=argparse.SUPPRESS)  # one of those that --segment-frames makes
    p.set_defaults(act=commands.run)


def _run_options(p: argparse.ArgumentParser) -> list[argparse.Action]:
    """The options of a run that mean the same for any source."""
    before = len(p._actions)
    p.add_argument("--overwrite", action="store_true", help=OVERWRITE_HELP)
    p.add_argument("--config", type=path, help="YAML file with options that differ from the defaults")
    p.add_argument("--preset", choices=tuple(PRESETS), help=PRESET_HELP)
    p.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="any option of config.yaml")
    p.add_argument("--pointmaps", choices=POINTMAPS.choices, help=_listed(POINTMAPS))
    p.add_argument("--semantics", choices=SEMANTICS.choices, help=_listed(SEMANTICS))
    p.add_argument("--correction", choices=ALIGNMENT.choices, help=_listed(ALIGNMENT))
    p.add_argument("--map-loss", choices=get_args(MapLossKind), help="which pixels the map learns from (Table V)")
    p.add_argument("--quality", choices=get_args(MapQualityKind), help=QUALITY_HELP)
    p.add_argument("--map-minutes", type=float, metavar="M", help=MINUTES_HELP)
    p.add_argument("--cloud", choices=get_args(CloudKind), help=CLOUD_HELP)
    p.add_argument("--masks", choices=get_args(MasksKind), help=MASKS_HELP)
    p.add_argument("--no-map", action="store_true", help="trajectory, masks and cloud only")
    p.add_argument("--no-loops", action="store_true", help="places that are seen again do not close the trajectory")
    p.add_argument("--scale", metavar="BY", help=SCALE_HELP)
    p.add_argument("--intrinsics", metavar="FX,FY,CX,CY[,K1[,K2,P1,P2[,K3[,K4,K5,K6]]]]|dataset", help=INTRINSICS_HELP)
    p.add_argument("--kind", choices=get_args(SourceKind), help="layout of the source (default: found by looking)")
    p.add_argument("--realtime", action="store_true", help="start the map while tracking, in a process of its own")
    p.add_argument("--start", type=int, help="first frame, from 0")
    p.add_argument("--end", type=int, help="one past the last frame")
    p.add_argument("--stride", type=int, help="every n-th frame")
    p.add_argument("--seed", type=int, help="of everything that is drawn at random (default 0)")
    p.add_argument("--quiet", action="store_true", help="no progress bars, no warnings")
    return p._actions[before:]


def _listed(registry: Registry) -> str:
    """The parts of a registry, for people."""
    return "; ".join(f"{e.name}: {e.summary}" for e in registry.entries()).replace("%", "%%")
