"""``mastd3r live``: a camera while it runs; ``mastd3r finish``: the rest of it afterwards."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, get_args

from rich.console import Console

from ..config import PRESETS, MapQualityKind, SourceKind
from ..errors import ConfigError
from ..registry import ALIGNMENT
from .options import config_from_args, path
from .screen import screen
from .view import told_at

if TYPE_CHECKING:
    from ..live.browser import BrowserView

CAMERA_HELP = (
    "0 (a camera of this machine) or its device; a URL (rtsp, http, udp, ...); - for raw frames or y4m on standard "
    "input; a ROS bag or MCAP file; a video, folder or dataset, played at its own pace"
)
# by --set, or not at all
NOT_LIVE = ("pointmaps", "semantics", "maps", "cloud", "masks", "scale", "seed", "map_loss", "map_minutes")
PIXEL_FORMATS = ("bgr24", "rgb24", "gray8")


def live_parser(p: argparse.ArgumentParser) -> None:
    """Words and options of ``mastd3r live``."""
    p.add_argument("camera", metavar="CAMERA", help=CAMERA_HELP)
    p.add_argument("--out", type=path, required=True, help="run folder")
    p.add_argument("--overwrite", action="store_true", help="remove an earlier run in --out at once, its frames too")
    p.add_argument("--record", action="store_true", help="keep the frames that are tracked, for mastd3r finish")
    p.add_argument("--seconds", type=float, metavar="S", help="end so long after the first frame (default: Ctrl-C)")
    p.add_argument("--size", metavar="WxH", help="of raw frames on standard input; without it, y4m")
    p.add_argument("--pixel-format", choices=PIXEL_FORMATS, help="of raw frames (default bgr24)")
    p.add_argument("--fps", type=float, help="of raw frames: their times (default: when they come)")
    p.add_argument("--topic", help="of a bag (default: its only one with images)")
    p.add_argument("--pace", type=float, metavar="FPS", help="play files at so many frames a second, not their own")
    p.add_argument("--timeout", type=float, metavar="S", help="without a frame, after which it is lost (default 10)")
    p.add_argument("--reconnect", type=float, metavar="S", help="look for a lost camera for so long (default: not)")
    p.add_argument("--config", type=path, help="YAML file with options that differ from the defaults")
    p.add_argument("--preset", choices=tuple(PRESETS), help="many options at once")
    p.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="any option of config.yaml")
    p.add_argument("--correction", choices=ALIGNMENT.choices, help="as for run")
    p.add_argument("--intrinsics", metavar="FX,FY,CX,CY[,...]|dataset", help="as for run")
    p.add_argument("--quality", choices=get_args(MapQualityKind), help="of the map that finish makes")
    p.add_argument("--no-map", action="store_true", help="finish makes no map")
    p.add_argument("--no-loops", action="store_true", help="as for run")
    p.add_argument("--kind", choices=get_args(SourceKind), help="of a folder that is played")
    for name in ("start", "end", "stride"):
        p.add_argument(f"--{name}", type=int, help="of frames that are played, as for run")
    p.add_argument("--view", action="store_true", help="show it in the browser while it runs (extra [view])")
    p.add_argument("--no-browser", action="store_true", help="with --view: say the address, open nothing")
    p.add_argument("--quiet", action="store_true", help="no progress, no warnings")
    p.set_defaults(act=live, realtime=False, **dict.fromkeys(NOT_LIVE))


def finish_parser(p: argparse.ArgumentParser) -> None:
    """Words and options of ``mastd3r finish``."""
    p.add_argument("run", type=path, help="folder of a live run with --record; options are those that it had")
    p.add_argument("--quiet", action="store_true", help="no progress bars, no warnings")
    p.set_defaults(act=finish)


def live(args: argparse.Namespace, console: Console) -> int:
    """``mastd3r live``."""
    from ..live import CameraOptions, run_live
    from .commands import reporter_of, show

    given = {"timeout_s": args.timeout, "reconnect_s": args.reconnect}
    options = CameraOptions(
        size=None if args.size is None else _size(args.size),
        pixel_format=args.pixel_format,
        fps=args.fps,
        topic=args.topic,
        pace_fps=args.pace,
        **{k: v for k, v in given.items() if v is not None},
    )
    config = config_from_args(args)
    with _in_browser(args, console) as view:
        result = run_live(
            args.camera,
            args.out,
            config,
            options=options,
            record=args.record,
            seconds=args.seconds,
            overwrite=args.overwrite,
            command=args.words,
            reporter=reporter_of(args, console),
            view=view,
        )
    show(result)
    if args.record:
        screen().print(f"mastd3r finish {args.out} makes the rest", soft_wrap=True, markup=False)
    return 0


@contextmanager
def _in_browser(args: argparse.Namespace, console: Console) -> Iterator[BrowserView | None]:
    """What shows the run while it runs, where that was asked for."""
    if not args.view:
        yield None
        return
    from ..live.browser import BrowserView
    from ..viewer.scene import Scene
    from ..viewer.server import address, open_server

    server = open_server(f"live {args.camera}")
    told_at(address(server), args, console)
    scene = Scene(server)
    view = BrowserView(scene)
    try:
        yield view
    finally:
        view.close()
        scene.close()


def finish(args: argparse.Namespace, console: Console) -> int:
    """``mastd3r finish``."""
    from ..pipeline import finish_live
    from .commands import reporter_of, show

    show(finish_live(args.run, reporter=reporter_of(args, console)))
    return 0


def _size(text: str) -> tuple[int, int]:
    """Raises ConfigError."""
    found = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", text)
    if found is None:
        raise ConfigError(f"--size: expected WxH in pixels, such as 640x480, got {text!r}")
    return int(found[1]), int(found[2])
