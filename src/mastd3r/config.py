"""One frozen dataclass a stage; ``Config`` joins them. YAML in and out; unknown keys are refused."""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal

import yaml

from .dynamics.config import DynamicsConfig
from .errors import ConfigError

PointmapKind = Literal["auto", "geometric", "mast3r", "depth"]
SemanticsKind = Literal["auto", "none", "dinov2", "maps"]
CorrectionKind = Literal["none", "coarse", "fine", "coarse-to-fine"]
MapLossKind = Literal["plain", "mask", "uncertainty", "full"]
SourceKind = Literal[
    "auto", "video", "images", "tum", "bonn", "kitti-raw", "kitti-odometry", "7scenes", "euroc", "replica"
]  # fmt: skip
MapDeviceKind = Literal["auto", "cpu", "cuda"]
PrecisionKind = Literal["auto", "float32", "bfloat16", "float16"]
ExecutionKind = Literal["auto", "eager", "graph", "compile"]


@dataclass(frozen=True)
class SourceConfig:
    """Which frames of the source are read."""

    start: int = 0  # first frame, counted from 0
    end: int | None = None  # one past the last frame; None = to the end
    stride: int = 1  # every n-th frame
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

    area_px: int = 196608  # pixels of the working image (512 x 384); never enlarged
    cell_px: int = 10  # one matched pixel a cell of this size
    keyframe_motion_ratio: float = 0.1  # upper quartile of image motion since the keyframe / sqrt(width * height)
    first_motion_ratio: float = 0.05  # the median of the same, before lens and structure are started
    keyframe_overlap_ratio: float = 0.55  # matches left of the most since the keyframe, below: new keyframe
    known_overlap_ratio: float = 0.8  # share of an older keyframe's points in view, above: it may be used again
    known_motion_ratio: float = 0.06  # median image motion from an older keyframe / width, below: the same
    min_inlier_ratio: float = 0.35  # below: the pose is not believed


@dataclass(frozen=True)
class AlignmentConfig:
    """Coarse-to-fine correction of one pair (III-B)."""

    chamfer_weight: float = 0.1  # lambda_cham of eq. (12)
    min_matches: int = 40  # weighted matches below which a pair cannot be aligned
    as_printed: bool = (
        False  # True: eq. (11)(12) with 3-D residuals alone, on SE(3), for views with points of their own
    )


@dataclass(frozen=True)
class GraphConfig:
    """Joint optimisation over keyframes."""

    bootstrap_keyframes: int = 5  # keyframes before lens and structure are started
    radial_keyframes: int = 12  # keyframes before the first radial term is estimated in the window
    lens_keyframes: int = 48  # keyframes before principal point and higher radial terms are
    neighbours: int = 6  # previous keyframes that a new one is matched with
    covisible: int = 4  # older keyframes, seeing the same place, that a new one is matched with
    window: int = 8  # keyframes that move in the windowed optimisation
    window_iterations: int = 4
    final_iterations: int = 40
    kernel_px: float = 0.5  # Cauchy scale of the final optimisation
    loop_overlap_ratio: float = 0.5  # predicted share of points in view that makes an old keyframe a candidate
    min_match_ratio: float = 0.04  # edges with a smaller matched share are dropped


@dataclass(frozen=True)
class MappingConfig:
    """The Gaussian map (III-C)."""

    enabled: bool = True
    device: MapDeviceKind = "auto"  # auto: the accelerator where gsplat draws on it, the CPU otherwise
    loss: MapLossKind = "full"  # plain: no weight; mask: (13)(14); uncertainty: (15)(16); full: (17)
    width_px: int = 320  # width of the images that the map is trained on and rendered at
    iterations: int = 3000  # optimisation steps, one view each
    max_views: int = 160  # training views kept in memory
    max_gaussians: int = 60000
    dynamic_weight: float = 0.05  # beta of eq. (14)
    hard_weight: bool = False  # True: eq. (14) as printed; False: w = 1 - 0.95 p
    tau_uncertainty_px: float = 2.0  # tau_unc, compared with the residual's norm
    lambda_uncertainty: float = 0.1  # eq. (17)
    paper_loss: bool = False  # True: squared error with the weights as printed; False: L1 + 0.2 D-SSIM
    ssim_share: float = 0.2  # of D-SSIM in the default loss, the rest is L1; without effect with paper_loss
    exposure: bool = True  # a gain and a bias a colour channel for every training view
    sh_degree: int = 0  # 0 to 3: spherical harmonics, colour that depends on the direction of view
    realtime: bool = False  # start the map while tracking runs, in a process of its own
    realtime_steps: int = 4  # optimisation steps a frame that it may spend meanwhile
    refine_poses: bool = True  # move the training cameras through the render gradient


@dataclass(frozen=True)
class NetworksConfig:
    """The networks behind --pointmaps mast3r and --semantics dinov2. Weights: an installed name, a hub id or a path."""

    mast3r: str = "mast3r"  # a file
    dinov2: str = "dinov2-with-registers-small"  # a folder
    precision: PrecisionKind = "auto"  # of the matrix products; auto: bfloat16 on an accelerator, float32 on the CPU
    execution: ExecutionKind = "auto"  # eager: layer by layer; graph: recorded once a size, CUDA only; compile:
    # torch.compile of MASt3R, minutes at the first frame; auto: graph on an accelerator, eager on the CPU
    depth_sigma_ratio: float = 0.08  # relative 1-sigma of MASt3R's depth of a frame, its scale apart; a run says what
    # it found. Chosen: weights to measure it with were not at hand
    long_side_px: int = 512  # of the image that MASt3R sees, a multiple of 16; it was trained at 512


HOLDOUT_EVERY = 8  # frames 0, 8, 16 … of those read are never shown to the map


@dataclass(frozen=True)
class Config:
    """Everything that decides a run, beside the source itself."""

    pointmaps: PointmapKind = "auto"
    semantics: SemanticsKind = "auto"
    correction: CorrectionKind = "coarse-to-fine"
    features: str = "orb"
    places: str = "auto"
    seed: int = 0
    source: SourceConfig = field(default_factory=SourceConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    dynamics: DynamicsConfig = field(default_factory=DynamicsConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    networks: NetworksConfig = field(default_factory=NetworksConfig)


def config_from_dict(data: dict[str, Any]) -> Config:
    """Build a Config from nested mappings. Raises ConfigError for unknown keys and wrong types."""
    return _build(Config, data, "")


def config_from_yaml(path: Path) -> Config:
    """Read a YAML file of overrides. Raises ConfigError."""
    try:
        data = yaml.safe_load(path.read_text()) or {}
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as e:
        raise ConfigError(f"config file {path}: expected readable YAML, got {_one_line(e)}") from e
    if not isinstance(data, dict):
        raise ConfigError(f"config file {path}: expected key: value pairs, got {type(data).__name__}")
    return config_from_dict(data)


def with_override(config: Config, dotted: str) -> Config:
    """Apply one ``section.key=value``; the value is read as YAML. Raises ConfigError."""
    key, eq, text = dotted.partition("=")
    if not eq:
        raise ConfigError(f"--set: expected section.key=value, got {dotted!r}")
    try:
        nested: Any = yaml.safe_load(text)
    except yaml.YAMLError as e:
        raise ConfigError(f"--set {key}: expected a YAML value, got {text!r} ({_one_line(e)})") from e
    for part in reversed(key.split(".")):
        nested = {part: nested}
    return _merge(config, nested, "")


def config_to_yaml(config: Config) -> str:
    """The whole effective configuration as YAML text."""
    return yaml.safe_dump(_plain(dataclasses.asdict(config)), sort_keys=False)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, tuple) else value


def _build(cls: type, data: dict[str, Any], where: str) -> Any:
    return _merge(cls(), data, where)


def _merge(obj: Any, data: Any, where: str) -> Any:
    if not isinstance(data, dict):
        raise ConfigError(f"config {where.rstrip('.') or 'top level'}: expected key: value pairs, got {data!r}")
    hints = typing.get_type_hints(type(obj))
    names = [f.name for f in fields(obj)]
    changes: dict[str, Any] = {}
    for key, value in data.items():
        if key not in names:
            near = difflib.get_close_matches(str(key), names, n=1)
            hint = f"; perhaps you meant {where}{near[0]}" if near else f"; known: {', '.join(names)}"
            raise ConfigError(f"config: unknown key {where}{key}{hint}")
        current = getattr(obj, key)
        if is_dataclass(current):
            changes[key] = _merge(current, value, f"{where}{key}.")
        else:
            changes[key] = _checked(value, hints[key], where + str(key))
    return replace(obj, **changes)


def _checked(value: Any, hint: Any, where: str) -> Any:
    origin = typing.get_origin(hint)
    if origin is Literal:
        options = typing.get_args(hint)
        if value not in options:
            raise ConfigError(f"config {where}: expected one of {', '.join(map(str, options))}, got {value!r}")
        return value
    if origin in (typing.Union, types.UnionType):
        if value is None:
            return None
        return _checked(value, next(a for a in typing.get_args(hint) if a is not type(None)), where)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise ConfigError(f"config {where}: expected a list, got {value!r}")
        return tuple(_checked(v, typing.get_args(hint)[0], where) for v in value)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, hint) or (hint is int and isinstance(value, bool)):
        raise ConfigError(f"config {where}: expected {hint.__name__}, got {value!r}")
    return value
