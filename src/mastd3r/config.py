"""One frozen dataclass a stage; ``Config`` joins them. YAML in and out; unknown keys are refused.

A key that was renamed is taken under its old name for one version, see ``RENAMED``.
"""

from __future__ import annotations

import dataclasses
import difflib
import logging
import types
import typing
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml

from .dynamics.config import OLD_NAMES, DynamicsConfig
from .errors import ConfigError
from .reading.files import short
from .reading.yaml_text import yaml_file, yaml_value
from .registry import (
    ALIGNMENT,
    FEATURES,
    LARGEST,
    MAP_BACKENDS,
    PLACES,
    POINTMAPS,
    SEMANTICS,
    Count,
    NotNegative,
    OneOrMore,
    Positive,
    Range,
    Registry,
    Share,
)

log = logging.getLogger(__name__)

PointmapKind = Annotated[str, POINTMAPS]  # names of a registry: also those that were registered from outside
FeaturesKind = Annotated[str, FEATURES]
SemanticsKind = Annotated[str, SEMANTICS]
PlacesKind = Annotated[str, PLACES]
CorrectionKind = Annotated[str, ALIGNMENT]
MapBackendKind = Annotated[str, MAP_BACKENDS]
MapLossKind = Literal["plain", "mask", "uncertainty", "full"]
MapQualityKind = Literal["draft", "standard", "high"]
SourceKind = Literal[
    "auto", "video", "images", "tum", "bonn", "kitti-raw", "kitti-odometry", "7scenes", "euroc", "replica"
]  # fmt: skip
MapDeviceKind = Literal["auto", "cpu", "cuda"]
PrecisionKind = Literal["auto", "float32", "bfloat16", "float16"]
CloudKind = Literal["sparse", "dense"]
MasksKind = Literal["smoothed", "causal"]
ExecutionKind = Literal["auto", "eager", "graph", "compile"]


@dataclass(frozen=True)
class SourceConfig:
    """Which frames of the source are read."""

    start: Count = 0  # first frame, counted from 0
    end: OneOrMore | None = None  # one past the last frame; None = to the end
    stride: OneOrMore = 1  # every n-th frame
    kind: SourceKind = "auto"  # the layout; auto: found by looking at the files


@dataclass(frozen=True)
class CameraConfig:
    """The lens. Empty = found from the video itself."""

    intrinsics: tuple[float, ...] = ()  # fx fy cx cy [k1 [k2 p1 p2 [k3 [k4 k5 k6]]]], OpenCV, full-size pixels
    from_dataset: bool = False  # True: the calibration that the dataset brings, in place of ``intrinsics``
    estimate_radial: bool = True  # find radial terms and principal point beside the focal length, where the video can


@dataclass(frozen=True)
class TrackingConfig:
    """What is matched, and when a frame becomes a keyframe (III-B, section 3 of docs/joint_optimisation.md)."""

    area_px: Annotated[int, Range(1024, 16_777_216)] = 196608  # pixels of the working image (512 x 384); never enlarged
    cell_px: Annotated[int, Range(2, 256)] = 10  # one matched pixel a cell of this size
    keyframe_motion_ratio: Annotated[float, Range(0, 10, above=True)] = (
        0.1  # upper quartile of image motion since the keyframe / sqrt(width * height)
    )
    first_motion_ratio: Annotated[float, Range(0, 10, above=True)] = (
        0.05  # the median of the same, before lens and structure are started
    )
    keyframe_overlap_ratio: Share = 0.55  # matches left of the most since the keyframe, below: new keyframe
    known_overlap_ratio: Share = 0.8  # share of an older keyframe's points in view, above: it may be used again
    known_motion_ratio: NotNegative = 0.06  # median image motion from an older keyframe / width, below: the same
    min_inlier_ratio: Share = 0.35  # below: the pose is not accepted


@dataclass(frozen=True)
class AlignmentConfig:
    """Coarse-to-fine correction of one pair (III-B)."""

    chamfer_weight: NotNegative = 0.1  # lambda_cham of eq. (12)
    min_matches: Annotated[int, Range(4, LARGEST)] = 40  # weighted matches below which a pair cannot be aligned
    as_printed: bool = False  # True: eq. (11)(12) as printed: 3-D residuals alone, on SE(3), for views with own points


@dataclass(frozen=True)
class GraphConfig:
    """Joint optimisation over keyframes."""

    bootstrap_keyframes: Annotated[int, Range(2, LARGEST)] = 5  # keyframes before lens and structure are started
    radial_keyframes: Count = 12  # keyframes before the first radial term is estimated in the window
    lens_keyframes: Count = 48  # keyframes before principal point and higher radial terms are
    neighbours: Count = 6  # previous keyframes that a new one is matched with
    covisible: Count = 4  # older keyframes, seeing the same place, that a new one is matched with
    window: Annotated[int, Range(2, LARGEST)] = 8  # keyframes that move in the windowed optimisation
    window_iterations: OneOrMore = 4
    final_iterations: OneOrMore = 40
    kernel_px: Positive = 0.5  # Cauchy scale of the final optimisation
    steady_speed: NotNegative = 150.0  # weight of a speed that goes on, times the variance of matches; 0: none
    loop_overlap_ratio: Share = 0.5  # predicted share of points in view that makes an old keyframe a candidate
    min_match_ratio: Share = 0.04  # edges with a smaller matched share are dropped
    loops: bool = True  # places seen again, far apart in time, close the trajectory


@dataclass(frozen=True)
class MappingConfig:
    """The Gaussian map (III-C)."""

    enabled: bool = True
    device: MapDeviceKind = "auto"  # auto: the accelerator where gsplat draws on it, the CPU otherwise
    backend: MapBackendKind = "auto"  # what draws the Gaussians; auto: gsplat on an accelerator, numba on the CPU
    loss: MapLossKind = "full"  # plain: no weight; mask: (13)(14); uncertainty: (15)(16); full: (17)
    quality: MapQualityKind = "standard"  # decides whatever of the next four is not given, by the device
    width_px: Annotated[int, Range(0, 16384)] = (
        0  # width of the images that the map is trained on and rendered at; 0: by the quality
    )
    iterations: OneOrMore | None = None  # optimisation steps, one view each; None: by the quality
    max_gaussians: Annotated[int, Range(0, 50_000_000)] = 0  # 0: by the quality
    sh_degree: Annotated[int, Range(0, 3)] | None = (
        None  # 0 to 3: spherical harmonics, colour by direction of view; None: by the quality
    )
    minutes: NotNegative = 0.0  # for the training, instead of a number of steps; 0: as many steps as said
    max_views: OneOrMore = 160  # training views kept in memory
    dynamic_weight: Share = 0.05  # beta of eq. (14)
    hard_weight: bool = False  # True: eq. (14) as printed; False: w = 1 - 0.95 p
    tau_uncertainty_px: Positive = 2.0  # tau_unc, compared with the residual's norm
    lambda_uncertainty: NotNegative = 0.1  # eq. (17)
    paper_loss: bool = False  # True: squared error with the weights as printed; False: L1 + 0.2 D-SSIM
    ssim_share: Share = 0.2  # of D-SSIM in the default loss, the rest is L1; without effect with paper_loss
    exposure: bool = True  # a gain and a bias a colour channel for every training view
    realtime: bool = False  # start the map while tracking runs, in a process of its own
    realtime_steps: Count = 4  # optimisation steps a frame that it may spend meanwhile
    refine_poses: bool = False  # move the training cameras too; then every frame is placed in the map


@dataclass(frozen=True)
class NetworksConfig:
    """The networks behind --pointmaps mast3r and --semantics dinov2. Weights: an installed name, a hub id or a path."""

    mast3r: str = "mast3r"  # a file
    dinov2: str = "dinov2-with-registers-small"  # a folder
    precision: PrecisionKind = "auto"  # of the matrix products; auto: bfloat16 on an accelerator, float32 on the CPU
    execution: ExecutionKind = "auto"  # eager: layer by layer; graph: recorded once a size, CUDA only; compile:
    # torch.compile of MASt3R, minutes at the first frame; auto: graph on an accelerator, eager on the CPU
    depth_sigma_ratio: Annotated[float, Range(0, 10, above=True)] = (
        0.08  # relative 1-sigma of MASt3R's depth of a frame, its scale apart; a run says what
    )
    # it found. Chosen: weights to measure it with were not at hand
    long_side_px: Annotated[int, Range(32, 8192)] = (
        512  # of the image that MASt3R sees, a multiple of 16; it was trained at 512
    )


HOLDOUT_EVERY = 8  # frames 0, 8, 16 … of those read are never shown to the map


@dataclass(frozen=True)
class Config:
    """Everything that decides a run, beside the source itself."""

    pointmaps: PointmapKind = "auto"
    features: FeaturesKind = "auto"  # sparse, where dense flow ends: after a jump, across a loop, over wide baselines
    semantics: SemanticsKind = "auto"
    places: PlacesKind = "auto"  # what a place is recognised by; auto: the pointmap network's tokens where it has them
    correction: CorrectionKind = "coarse-to-fine"
    cloud: CloudKind = "sparse"  # dense: depth of every keyframe pixel too, as cloud_dense.ply; a minute or two
    masks: MasksKind = "smoothed"  # of the second pass; causal: they know the frames before alone, cheaper
    scale: str = ""  # what metres are taken from, as --scale says it (metric/spec.py); empty: lengths stay map units
    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    source: SourceConfig = field(default_factory=SourceConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    dynamics: DynamicsConfig = field(default_factory=DynamicsConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    networks: NetworksConfig = field(default_factory=NetworksConfig)


PRESETS: dict[str, tuple[str, ...]] = {  # name -> what it changes of the defaults, as ``with_override`` takes it
    "fast": ("masks=causal", "mapping.quality=draft"),  # a first look
    "quality": ("cloud=dense", "mapping.quality=high"),  # what there is time for overnight
    "paper": (  # every equation as printed
        "dynamics.variant=paper",
        "alignment.as_printed=true",
        "mapping.paper_loss=true",
        "mapping.hard_weight=true",
    ),
}

RENAMED = {f"dynamics.{old}": f"dynamics.{new}" for old, new in OLD_NAMES.items()}  # old dotted key -> new


def config_from_dict(data: dict[str, Any], base: Config | None = None) -> Config:
    """``base`` (the defaults) with nested mappings of changes. Raises ConfigError for unknown keys and wrong types."""
    return _merged(base or Config(), data)


def preset(name: str) -> Config:
    """The defaults with what a preset of ``PRESETS`` changes. Raises ConfigError for another name."""
    if name not in PRESETS:
        raise ConfigError(f"preset: expected one of {', '.join(PRESETS)}, got {name!r}")
    config = Config()
    for item in PRESETS[name]:
        config = with_override(config, item)
    return config


def config_from_yaml(path: Path, base: Config | None = None) -> Config:
    """Read a YAML file of overrides of ``base`` (the defaults). Raises ConfigError."""
    return _config_of(yaml_file(path, "config file", ConfigError), f"config file {path}", base)


def config_from_text(text: str, where: str) -> Config:
    """A whole config.yaml that was read before; ``where`` for messages. Raises ConfigError."""
    return _config_of(yaml_value(text, where, ConfigError), where, None)


def _config_of(data: Any, where: str, base: Config | None) -> Config:
    if data is not None and not isinstance(data, dict):
        raise ConfigError(f"{where}: expected key: value pairs, got {type(data).__name__}")
    return config_from_dict(data or {}, base)


def with_override(config: Config, dotted: str) -> Config:
    """Apply one ``section.key=value``; the value is read as YAML. Raises ConfigError."""
    key, eq, text = dotted.partition("=")
    if not eq:
        raise ConfigError(f"--set: expected section.key=value, got {short(repr(dotted))}")
    nested: Any = yaml_value(text, f"--set {short(key)}", ConfigError, "a YAML value")
    for part in reversed(key.split(".")):
        nested = {part: nested}
    return _merged(config, nested)


def check_config(config: Config) -> Config:
    """The same. Raises ConfigError for a value of the wrong type or out of its range, however it came there."""
    return _merged(config, dataclasses.asdict(config))


def ranges(section: Any = None, where: str = "") -> dict[str, str]:
    """What the numbers among the options may be, in words, by dotted key."""
    section = section or Config()
    out: dict[str, str] = {}
    for name, hint in typing.get_type_hints(type(section), include_extras=True).items():
        value = getattr(section, name)
        if is_dataclass(value):
            out |= ranges(value, f"{where}{name}.")
        for part in (hint, *typing.get_args(hint)):
            for rule in getattr(part, "__metadata__", ()):
                if isinstance(rule, Range):
                    out[where + name] = str(rule)
    return out


def config_to_yaml(config: Config) -> str:
    """The whole effective configuration as YAML text."""
    return yaml.safe_dump(_plain(dataclasses.asdict(config)), sort_keys=False)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, tuple) else value


def _merged(config: Config, data: Any) -> Config:
    merged: Config = _merge(config, _with_new_names(data), "")
    return merged


def _with_new_names(data: Any, where: str = "") -> Any:
    """``data`` with every key of ``RENAMED`` under its new name. Raises ConfigError where both names are given."""
    if not isinstance(data, dict):
        return data
    out: dict[Any, Any] = {}
    moved: list[tuple[str, Any]] = []
    for key, value in data.items():
        old = f"{where}{key}"
        if old in RENAMED:
            _say_renamed(old)
            moved.append((old, value))
        else:
            out[key] = _with_new_names(value, f"{old}.")
    for old, value in moved:
        *sections, last = RENAMED[old].removeprefix(where).split(".")
        place = out
        for section in sections:
            place = place.setdefault(section, {})
            if not isinstance(place, dict):
                raise ConfigError(f"config {where}{section}: expected key: value pairs, got {short(repr(place))}")
        if last in place:
            raise ConfigError(f"config: expected {RENAMED[old]} or its old name {old}, got both")
        place[last] = value
    return out


@cache
def _say_renamed(old: str) -> None:
    """Once a process: a suite reads its settings many times over."""
    log.warning("config: %s is now %s; the old name goes with the next version", old, RENAMED[old])


def _merge(obj: Any, data: Any, where: str) -> Any:
    if not isinstance(data, dict):
        raise ConfigError(
            f"config {where.rstrip('.') or 'top level'}: expected key: value pairs, got {short(repr(data))}"
        )
    hints = typing.get_type_hints(type(obj), include_extras=True)
    names = [f.name for f in fields(obj)]
    changes: dict[str, Any] = {}
    for key, value in data.items():
        if key not in names:
            near = difflib.get_close_matches(str(key), names, n=1)
            hint = f"; perhaps you meant {where}{near[0]}" if near else f"; known: {', '.join(names)}"
            raise ConfigError(f"config: unknown key {where}{short(str(key))}{hint}")
        current = getattr(obj, key)
        if is_dataclass(current):
            changes[key] = _merge(current, value, f"{where}{key}.")
        else:
            changes[key] = _checked(value, hints[key], where + str(key))
    return replace(obj, **changes)


def _chosen(value: Any, hint: Any, where: str) -> Any:
    """A value of a registry's names, within a range, or of a Literal."""
    if typing.get_origin(hint) is Annotated:
        rule: Registry | Range = hint.__metadata__[0]
        if isinstance(rule, Range):
            value = _checked(value, hint.__origin__, where)
            rule.check(value, f"config {where}")
            return value
        return rule.check(value, where=f"config {where}")
    options = typing.get_args(hint)
    if value not in options:
        raise ConfigError(f"config {where}: expected one of {', '.join(map(str, options))}, got {short(repr(value))}")
    return value


def _checked(value: Any, hint: Any, where: str) -> Any:
    origin = typing.get_origin(hint)
    if origin in (Annotated, Literal):
        return _chosen(value, hint, where)
    if origin in (typing.Union, types.UnionType):
        if value is None:
            return None
        return _checked(value, next(a for a in typing.get_args(hint) if a is not type(None)), where)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise ConfigError(f"config {where}: expected a list, got {short(repr(value))}")
        return tuple(_checked(v, typing.get_args(hint)[0], where) for v in value)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return _as_float(value, where)
    if not isinstance(value, hint) or (hint is int and isinstance(value, bool)):
        raise ConfigError(f"config {where}: expected {hint.__name__}, got {short(repr(value))}")
    return value


def _as_float(value: int, where: str) -> float:
    try:
        return float(value)
    except OverflowError as e:
        raise ConfigError(f"config {where}: expected a number, got one of {len(str(abs(value))[:20])}+ digits") from e
