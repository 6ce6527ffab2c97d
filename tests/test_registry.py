"""Every stage can be replaced from outside: a toy part of each kind is registered, chosen by name, and used."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mastd3r
from mastd3r.alignment.align import CoarseToFine
from mastd3r.cli.options import config_from_args
from mastd3r.cli.parser import parser
from mastd3r.config import Config, with_override
from mastd3r.dynamics.ours import LogOddsModel
from mastd3r.errors import ConfigError
from mastd3r.features.orb import OrbFeatures
from mastd3r.graph.place_recognition import thumbnail
from mastd3r.mapping.rasterise_cpu import NumbaBackend
from mastd3r.pointmap.geometric import GeometricPointmaps, build_geometric
from mastd3r.registry import (
    ALIGNMENT,
    DYNAMICS,
    FEATURES,
    MAP_BACKENDS,
    PLACES,
    POINTMAPS,
    REGISTRIES,
    SEMANTICS,
    Registry,
)
from mastd3r.sources.semantic_maps import FromSource

USED: set[str] = set()


def used(name: str) -> None:
    USED.add(name)


class ToyPointmaps(GeometricPointmaps):
    name = "toy"
    notes = ("toy pointmaps were here",)

    def predict(self, *given: Any) -> Any:
        used("pointmaps")
        return super().predict(*given)


class ToyFeatures(OrbFeatures):
    def matches(self, *given: Any) -> Any:
        used("features")
        return super().matches(*given)


class ToyAligner(CoarseToFine):
    def fine(self, *given: Any) -> Any:
        used("alignment")
        return super().fine(*given)


class ToyDynamics(LogOddsModel):
    def filter(self, *given: Any) -> Any:
        used("dynamics")
        return super().filter(*given)


class ToySemantics(FromSource):
    def fill(self, frame: Any) -> Any:
        used("semantics")
        return super().fill(frame)


class ToyBackend(NumbaBackend):
    def rasterise(self, *given: Any) -> Any:
        used("map backend")
        return NumbaBackend.rasterise(*given)


def toy_place(work: Any) -> Any:
    used("place recognition")
    return thumbnail(work.gray)


def toy_pointmaps(config: Config, source: Any) -> ToyPointmaps:
    plain = build_geometric(config, source)
    return ToyPointmaps(*plain.size, plain.cell_px)


TOYS: tuple[tuple[Registry, Any], ...] = (
    (POINTMAPS, toy_pointmaps),
    (FEATURES, ToyFeatures),
    (ALIGNMENT, ToyAligner),
    (DYNAMICS, ToyDynamics),
    (SEMANTICS, lambda config, source: ToySemantics()),
    (PLACES, lambda provider: toy_place),
    (MAP_BACKENDS, ToyBackend),
)


def test_a_toy_part_of_every_kind_runs(room_clip: Path, tmp_path: Path) -> None:
    """With noise in the middle, so that places and features are asked."""
    assert {registry for registry, _ in TOYS} == set(REGISTRIES)
    USED.clear()
    for registry, build in TOYS:
        registry.register("toy", build, "a toy")
    try:
        config = mastd3r.Config()
        for registry in REGISTRIES:
            config = with_override(config, f"{registry.option}=toy")
            assert "toy" in registry.choices
        for change in ("mapping.iterations=4", "mapping.width_px=64"):
            config = with_override(config, change)
        frames = [image for _, image in images(room_clip)]
        frames.insert(9, np.random.default_rng(0).integers(0, 256, frames[0].shape, np.uint8))
        rec = mastd3r.reconstruct(((0.2 * n, image) for n, image in enumerate(frames[:15])), tmp_path / "run", config)
    finally:
        for registry, _ in TOYS:
            registry.remove("toy")
    assert {registry.stage for registry in REGISTRIES} == USED
    assert rec.is_complete and rec.gaussians is not None and "toy pointmaps were here" in rec.notes
    assert "variant: toy" in (rec.path / "config.yaml").read_text()


def images(path: Path) -> Any:
    from mastd3r.sources import open_source

    return [(f.timestamp_s, f.image) for f in open_source(path, Config().source).frames()]


def test_the_command_line_takes_what_is_registered() -> None:
    words = ["run", "x", "--out", "y", "--pointmaps", "toy"]
    with pytest.raises(ConfigError, match="invalid choice"):
        parser().parse_args(words)
    with POINTMAPS.registered("toy", toy_pointmaps, "a toy"):
        assert config_from_args(parser().parse_args(words)).pointmaps == "toy"
    assert "toy" not in POINTMAPS.choices


@pytest.mark.parametrize("registry", REGISTRIES, ids=lambda r: r.stage)
def test_unknown_names_are_refused_with_the_nearest(registry: Registry) -> None:
    name = registry.entries()[0].name
    with pytest.raises(ConfigError, match=f"expected one of .*perhaps you meant {name}") as caught:
        with_override(Config(), f"{registry.option}={name}x")
    assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match="expected"):
        registry.create("nonsense")
    for taken in (name, "", "auto"):
        with pytest.raises(ConfigError, match="expected a new name"):
            registry.register(taken, lambda: None, "")


@pytest.mark.parametrize("registry", REGISTRIES, ids=lambda r: r.stage)
def test_every_shipped_part_can_be_loaded(registry: Registry) -> None:
    for entry in registry.entries():
        assert callable(entry.builder()) and entry.summary


def test_places_of_a_provider_that_has_none() -> None:
    with pytest.raises(ConfigError, match="expected pointmaps that describe places, got geometric"):
        PLACES.create("pointmaps", GeometricPointmaps(64, 48, 8))


def test_a_backend_says_where_the_map_lives() -> None:
    from mastd3r.mapping.rasterise import map_device

    assert map_device("auto", "numba") == ("cpu", "")
    with pytest.raises(ConfigError, match="expected auto or cpu"):
        map_device("cuda", "numba")
