"""The replaceable parts of a run, chosen by name; what was chosen automatically is said in ``notes``."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .concurrency import prefetch
from .config import Config, MappingConfig, NetworksConfig
from .download import weights
from .dynamics.appearance import plain_descriptors
from .errors import ConfigError, InputError
from .features.orb import OrbFeatures
from .graph.place_recognition import PlaceRecognition
from .pointmap.base import PointmapProvider
from .pointmap.geometric import GeometricPointmaps, SensorDepthPointmaps, working_size
from .types import Frame, Source, WorkFrame

Array = NDArray[Any]
log = logging.getLogger(__name__)
Near = Callable[[Frame], WorkFrame | None]  # what a frame is probably seen beside
DESCRIBED_PX = 4  # working pixels a plain descriptor
REMEMBERED_FEATURES = 4  # frames whose features are kept: the mask of one is made when the next is already looked at


@dataclass
class Parts:
    """What the loop works with."""

    provider: PointmapProvider
    size: tuple[int, int]  # (width, height) of the working image
    features: OrbFeatures = field(default_factory=OrbFeatures)
    places: PlaceRecognition = field(default_factory=PlaceRecognition)
    notes: list[str] = field(default_factory=list)
    semantic: Callable[[Frame], Frame] | None = None  # fills Frame.semantic; None: what the source brings
    own_scale_known: bool = True  # False: the depth of every frame alone has a scale of its own
    prefetches_pairs: bool = False  # the provider decodes a frame's pair before its turn, beside the anchor
    descriptors: Callable[[Frame], Array] | None = None  # (h', w', c) of a network; None: plain descriptors

    def __post_init__(self) -> None:
        width, height = self.size
        x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        self.grid_px = np.stack([x, y], -1)
        self._foreseen: dict[int, _Foreseen] = {}

    def observe(self, frame: Frame, near: WorkFrame | None = None) -> WorkFrame:
        """The frame with its semantic prior, as the provider sees it; ``near`` sees the same place."""
        seen = self._foreseen.pop(frame.index, None)
        if seen is None or seen.frame is not frame:
            return self.provider.beside(self._look(frame), near)
        return seen.work if seen.near is near and near is not None else self.provider.beside(seen.work, near)

    def describe(self, frame: Frame) -> Array:
        """(h', w', c) float32 descriptors of a frame, for the head that learns what moving things look like."""
        if self.descriptors is not None:
            return self.descriptors(frame)
        return plain_descriptors(frame.image, self.size[0] // DESCRIBED_PX, self.size[1] // DESCRIBED_PX)

    def prefetched(self, frames: Iterator[Frame], near: Callable[[], Near]) -> Iterator[Frame]:
        """The frames, each read, and looked at for ``observe``, while the caller works on the one before.

        ``near`` is asked in the caller's thread, a frame ahead: the frame that ``observe`` will probably be given.
        """
        looked = prefetch(frames, lambda frame, _: self._foresee(frame), lambda: None)
        return prefetch(looked, self._foresee_beside, near) if self.prefetches_pairs else looked

    def _look(self, frame: Frame) -> WorkFrame:
        return self.provider.look(frame if self.semantic is None else self.semantic(frame))

    def _foresee(self, frame: Frame) -> None:
        self._foreseen[frame.index] = _Foreseen(frame, self._look(frame))

    def _foresee_beside(self, frame: Frame, near: Near) -> None:
        seen, other = self._foreseen[frame.index], near(frame)
        if other is not None:
            seen.work, seen.near = self.provider.beside(seen.work, other), other


@dataclass
class _Foreseen:
    """A frame that was looked at before its turn."""

    frame: Frame
    work: WorkFrame
    near: WorkFrame | None = None  # the frame that it was looked at beside; None: alone so far


def build_parts(config: Config, source: Source) -> Parts:
    """Choose and build the parts. Raises ConfigError and InputError for what this machine or source cannot serve."""
    kind, why = chosen_pointmaps(config)
    notes = [f"pointmaps: {kind}, chosen by auto ({why})"] if why else []
    if kind == "depth" and not source.has_depth:
        raise InputError(f"--pointmaps depth: expected a TUM-layout folder with depth.txt, {source.name} has no depth")
    prior, why = chosen_semantics(config, source)
    notes.append(f"semantics: {prior}" + (f", chosen by auto ({why})" if why else ""))
    if kind == "mast3r":
        parts = _mast3r(config, source)
    else:
        width, height = working_size(*source.size, config.tracking.area_px)
        provider_class = SensorDepthPointmaps if kind == "depth" else GeometricPointmaps
        parts = Parts(provider_class(width, height, config.tracking.cell_px), (width, height))
    if prior == "dinov2":
        parts.semantic, parts.descriptors, note = _dinov2(config.networks)
        parts.notes.append(note)
    parts.notes[:0] = notes
    return parts


def with_dataset_lens(config: Config, source: Source) -> tuple[Config, list[str]]:
    """The dataset's calibration in place of intrinsics where it is asked for, and a note. Raises ConfigError."""
    if not config.camera.from_dataset:
        return config, []
    given = source.calibration
    if not given:
        raise ConfigError(f"--intrinsics dataset: expected a calibration in {source.name} ({source.kind}), got none")
    numbers = ",".join(f"{v:g}" for v in given)
    lens = replace(config.camera, intrinsics=given)
    return replace(config, camera=lens), [f"intrinsics: the calibration of the dataset ({source.kind}): {numbers}"]


def chosen_map_device(config: MappingConfig, notes: list[str]) -> str:
    """Where the map will live; the choice and its reason go to ``notes``.

    Raises InputError, see ``map_device``, and ConfigError for options of the map outside their range.
    """
    from .mapping.mapper import check_map_options
    from .mapping.rasterise import map_device

    check_map_options(config)
    if not config.enabled:
        return "cpu"
    device, why = map_device(config.device)
    notes.append(f"map on {device}" + (f", chosen by auto ({why})" if why else ""))
    log.info(notes[-1])
    return device


def chosen_pointmaps(config: Config) -> tuple[str, str]:
    """The provider's name, and why ``auto`` chose it; no reason where the user did."""
    if config.pointmaps != "auto":
        return config.pointmaps, ""
    lack = _lack(config.networks.mast3r, "MASt3R")
    return ("geometric", lack) if lack else ("mast3r", "weights and an accelerator are there")


def chosen_semantics(config: Config, source: Source) -> tuple[str, str]:
    """The prior's name, and why ``auto`` chose it. Raises InputError where maps are asked for and there are none."""
    if config.semantics == "maps" and not source.has_semantic:
        raise InputError(f"--semantics maps: expected probability maps beside the frames, {source.name} has none")
    if config.semantics != "auto":
        return config.semantics, ""
    if source.has_semantic:
        return "maps", "the source brings them"
    lack = _lack(config.networks.dinov2, "DINOv2")
    return ("none", lack) if lack else ("dinov2", "weights and an accelerator are there")


def _lack(what: str, title: str) -> str:
    """What is missing for a network to be the default, or nothing. torch is loaded only where weights are there."""
    if not weights.installed(what):
        return f"no {title} weights are installed"
    return "no accelerator" if _device() == "cpu" else ""


def _device() -> str:
    from .mapping.rasterise import torch_device

    return torch_device()


def _precision(config: NetworksConfig, device: str) -> str:
    return config.precision if config.precision != "auto" else "float32" if device == "cpu" else "bfloat16"


def _execution(config: NetworksConfig, device: str) -> str:
    return config.execution if config.execution != "auto" else "eager" if device == "cpu" else "graph"


def _mast3r(config: Config, source: Source) -> Parts:
    """The network provider. Raises InputError that names the command which brings the weights."""
    c = config.networks
    if not 0 < c.depth_sigma_ratio < 1:
        raise ConfigError(f"networks.depth_sigma_ratio: expected a share between 0 and 1, got {c.depth_sigma_ratio}")
    if c.long_side_px < 64 or c.long_side_px % 16:
        raise ConfigError(f"networks.long_side_px: expected a multiple of 16 from 64 on, got {c.long_side_px}")
    path = weights.path(c.mast3r)
    from .networks.load import load_pair_network
    from .networks.matching import RecordedMatching, match_pixels
    from .pointmap.mast3r import Mast3rPointmaps, match_on_host, working_size_of
    from .pointmap.matching import FoundPixels

    device = _device()
    precision, execution = _precision(c, device), _execution(c, device)
    network = load_pair_network(path, device, precision, c.long_side_px, execution)
    width, height = working_size_of(network, source.size)
    matcher, most = match_on_host, 4
    if device != "cpu":
        search = match_pixels if network.recorder is None else RecordedMatching(network.recorder)
        matcher, most = (lambda *given: FoundPixels(*search(*given))), 24  # a pair takes 46 MB at 512 x 384
    options: dict[str, Any] = {"remembered_pairs": most, "depth_sigma_ratio": c.depth_sigma_ratio}
    provider = Mast3rPointmaps(network, width, height, config.tracking.cell_px, matcher=matcher, **options)
    note = f"MASt3R: {path.name} of {c.mast3r}, {precision} on {device}, {execution}, working image {width}x{height}"
    places = PlaceRecognition(provider.place_descriptor)
    parts = Parts(provider, (width, height), places=places, notes=[note], own_scale_known=False)
    parts.prefetches_pairs = device != "cpu"  # there the main loop needs the processor itself
    return parts


def _dinov2(config: NetworksConfig) -> tuple[Callable[[Frame], Frame], Callable[[Frame], Array], str]:
    """What gives a frame its P(foreground), with a memory over the video; its features; and a line about it."""
    path = weights.path(config.dinov2)
    from .networks.dinov2 import Dinov2Features
    from .networks.foreground import ForegroundPrior

    device = _device()
    precision = _precision(config, device)
    recorded = device != "cpu" and config.execution in ("auto", "graph")
    network, prior = Dinov2Features(path, device, precision, recorded), ForegroundPrior()
    known: dict[int, Array] = {}  # the network is asked once a frame, from whichever thread comes first
    one_at_a_time = threading.Lock()

    def features(frame: Frame) -> Array:
        with one_at_a_time:
            if frame.index not in known:
                while len(known) >= REMEMBERED_FEATURES:
                    known.pop(next(iter(known)))
                known[frame.index] = network.one(frame.image).features
            return known[frame.index]

    def fill(frame: Frame) -> Frame:
        return replace(frame, semantic=prior(features(frame)))

    return fill, features, f"DINOv2: {config.dinov2}, {precision} on {device}"
