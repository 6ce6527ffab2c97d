"""``mastd3r save``: a run's keyframes as a map; ``mastd3r localise``: where in it images were taken."""

from __future__ import annotations

import argparse
from typing import get_args

from rich.console import Console
from rich.text import Text

from ..config import SourceConfig, SourceKind
from .options import numbers_of, path
from .screen import screen

SHOWN = 10  # images that the terminal names
INTRINSICS_HELP = "lens of the images, pixels, if it is not the map's: a focal length, or all of it as for run"


def save_parser(p: argparse.ArgumentParser) -> None:
    """Words and options of ``mastd3r save``."""
    p.add_argument("run", type=path, help="run folder")
    p.add_argument("--map", type=path, required=True, help="folder to write; an earlier map there is replaced")
    p.add_argument("--source", type=path, help="where the photographs are now (default: where the run read them)")
    p.add_argument("--quiet", action="store_true", help="no progress bars, no warnings")
    p.set_defaults(act=save)


def localise_parser(p: argparse.ArgumentParser) -> None:
    """Words and options of ``mastd3r localise``."""
    p.add_argument("map", type=path, help="folder of mastd3r save")
    p.add_argument("source", type=path, help="image, folder of images, video, or sequence of a dataset")
    p.add_argument("--out", type=path, required=True, help="folder to write: poses.txt, localised.json")
    p.add_argument("--intrinsics", metavar="F|FX,FY,CX,CY[,...]", help=INTRINSICS_HELP)
    p.add_argument("--kind", choices=get_args(SourceKind), help="layout of the source (default: found by looking)")
    for name in ("start", "end", "stride"):
        p.add_argument(f"--{name}", type=int, help="which images, as for run")
    p.add_argument("--quiet", action="store_true", help="no progress bars, no warnings")
    p.set_defaults(act=localise)


def save(args: argparse.Namespace, console: Console) -> int:
    """``mastd3r save``."""
    from ..pipeline import save_map

    saved = save_map(args.run, args.map, source=args.source)
    screen().print(f"wrote {args.map}: {len(saved.poses)} keyframes", soft_wrap=True, markup=False)
    return 0


def localise(args: argparse.Namespace, console: Console) -> int:
    """``mastd3r localise``."""
    from ..offline.localise import localise_source
    from ..pipeline import load_map
    from .commands import reporter_of

    window = {k: getattr(args, k) for k in ("start", "end", "stride", "kind") if getattr(args, k) is not None}
    given = () if args.intrinsics is None else numbers_of(args.intrinsics)
    saved = load_map(args.map)
    located = localise_source(saved, args.source, args.out, SourceConfig(**window), given, reporter_of(args, console))
    for one in located[:SHOWN]:
        screen().print(Text(f"{one.name}: {one.said}"), soft_wrap=True)
    if len(located) > SHOWN:
        screen().print(f"and {len(located) - SHOWN} more", markup=False)
    found = sum(one.place.is_found for one in located)
    screen().print(f"found {found} of {len(located)}; wrote {args.out}", soft_wrap=True, markup=False)
    return 0
