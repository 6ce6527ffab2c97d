"""The options of ``run`` as a configuration."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path

from ..config import Config, check_config, config_from_yaml, preset, with_override
from ..errors import ConfigError
from ..metric.spec import parsed
from ..reading.files import short, user_path


def path(text: str) -> Path:
    """A path among the words of the command line, ``~`` expanded. Raises ConfigError for one that no file can have."""
    return user_path(text or ".", refusal=ConfigError)


def config_from_args(args: argparse.Namespace) -> Config:
    """Defaults, then the preset, the file, --set, and the named options."""
    config = preset(args.preset) if args.preset else Config()
    if args.config:
        config = config_from_yaml(args.config, config)
    for item in args.set:
        config = with_override(config, item)
    for name in ("pointmaps", "semantics", "correction", "cloud", "masks", "seed"):
        if getattr(args, name) is not None:
            config = replace(config, **{name: getattr(args, name)})
    window = {k: getattr(args, k) for k in ("start", "end", "stride", "kind") if getattr(args, k) is not None}
    config = replace(config, source=replace(config.source, **window))
    if args.map_loss is not None:
        config = replace(config, mapping=replace(config.mapping, loss=args.map_loss))
    for name in ("realtime", "quality", "map_minutes"):
        if args.no_map and getattr(args, name) not in (None, False):
            raise ConfigError(f"--{name.replace('_', '-')}: expected a map to be made, got --no-map")
    if args.no_loops:
        config = replace(config, graph=replace(config.graph, loops=False))
    if args.realtime:
        config = replace(config, mapping=replace(config.mapping, realtime=True))
    if args.quality is not None:
        config = replace(config, mapping=replace(config.mapping, quality=args.quality))
    if args.map_minutes is not None:
        minutes = checked_minutes(args.map_minutes, "--map-minutes")
        config = replace(config, mapping=replace(config.mapping, minutes=minutes))
    if args.no_map:
        config = replace(config, mapping=replace(config.mapping, enabled=False))
    if args.scale is not None:
        config = replace(config, scale=parsed(args.scale).text)
    if args.maps is not None and config.semantics == "auto":
        config = replace(config, semantics="maps")
    if args.intrinsics == "dataset":
        config = replace(config, camera=replace(config.camera, intrinsics=(), from_dataset=True))
    elif args.intrinsics is not None:
        given = numbers_of(args.intrinsics)
        config = replace(config, camera=replace(config.camera, intrinsics=given, from_dataset=False))
    return check_config(config)


def checked_minutes(minutes: float, option: str) -> float:
    """Minutes that a training can be given. Raises ConfigError, naming the option."""
    if not 0 < minutes < math.inf:
        raise ConfigError(f"{option}: expected a finite number of minutes above 0, got {minutes:g}")
    return minutes


def numbers_of(text: str) -> tuple[float, ...]:
    """What ``--intrinsics`` says. Raises ConfigError for what are no numbers."""
    try:
        numbers = tuple(float(x) for x in text.replace(",", " ").split())
    except ValueError as e:
        raise ConfigError(f"--intrinsics: expected fx,fy,cx,cy and OpenCV's distortion, got {short(repr(text))}") from e
    if not numbers:
        raise ConfigError("--intrinsics: expected fx,fy,cx,cy and OpenCV's distortion, got nothing")
    return numbers
