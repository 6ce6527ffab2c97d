"""Series of photographs: their order, and the focal length that EXIF says, from the file to where the lens starts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from helpers import blobs
from mastd3r.config import CameraConfig, Config, GraphConfig, MappingConfig, SourceConfig
from mastd3r.graph.initialisation import FOCAL_RATIOS, bootstrap, first_focals
from mastd3r.graph.intrinsics import intrinsics_for
from mastd3r.graph.keyframe_graph import KeyframeGraph
from mastd3r.slam import Slam
from mastd3r.sources import open_source
from mastd3r.sources.exif_focal import EXIF_IFD, FOCAL_35MM, FOCAL_LENGTH, PIXELS_X, PIXELS_Y, PLANE_X, focal_of
from test_graph_keyframes import graph_of

ALL = SourceConfig()


def photographs(folder: Path, exif_of: Callable[[int], dict[int, object]], count: int = 3, turn: int = 1) -> Path:
    folder.mkdir()
    for k in range(count):
        exif = Image.Exif()
        exif[0x0112] = turn
        exif.get_ifd(EXIF_IFD).update(exif_of(k))
        Image.fromarray(blobs(1, 64, 48, seed=k)[0]).save(folder / f"IMG_{9 + k}.jpg", exif=exif)
    return folder


def hint(folder: Path) -> tuple[float | None, str]:
    source = open_source(folder, ALL)
    return source.focal_hint_px, source.focal_source  # type: ignore[attr-defined]


def test_names_are_read_in_natural_order(tmp_path: Path) -> None:
    folder = photographs(tmp_path / "a", lambda k: {})
    images = [f.image for f in open_source(folder, ALL).frames()]
    for k, image in enumerate(images):  # IMG_9 before IMG_10
        assert np.abs(image.astype(int) - blobs(1, 64, 48, seed=k)[0]).mean() < 12
    assert all(np.abs(a.astype(int) - b).mean() > 20 for a, b in pairwise(images))


def test_the_focal_length_of_exif(tmp_path: Path) -> None:
    expected = 28 * np.hypot(64, 48) / np.hypot(36, 24)
    for turn in (1, 6):
        folder = photographs(tmp_path / f"a{turn}", lambda k: {FOCAL_35MM: 28}, turn=turn)
        focal_px, told = hint(folder)
        assert focal_px == pytest.approx(expected) and told == "EXIF's 28 mm equivalent"
    sensor = {FOCAL_LENGTH: 4.0, PLANE_X: 254.0, PIXELS_X: 128, PIXELS_Y: 96}  # 10 px a mm; twice as large when taken
    focal_px, told = hint(photographs(tmp_path / "b", lambda k: sensor))
    assert focal_px == pytest.approx(20.0) and told == "EXIF's 4 mm and pixels of the sensor"


def test_no_focal_length_where_exif_does_not_agree(tmp_path: Path) -> None:
    cases: dict[str, Callable[[int], dict[int, object]]] = {
        "silent": lambda k: {},
        "zoomed": lambda k: {FOCAL_35MM: 28 if k else 35},
        "mostly silent": lambda k: {} if k else {FOCAL_35MM: 28},
        "unknown": lambda k: {FOCAL_35MM: 0},
        "cropped": lambda k: {FOCAL_35MM: 28, PIXELS_X: 4000, PIXELS_Y: 2250},
        "no size": lambda k: {FOCAL_LENGTH: 4.0, PLANE_X: 254.0},
    }
    for name, exif_of in cases.items():
        assert hint(photographs(tmp_path / name, exif_of)) == (None, ""), name
    (tmp_path / "broken.jpg").write_bytes(b"no image")
    assert focal_of([tmp_path / "broken.jpg"], (64, 48)) == (None, "")


def test_a_hint_is_a_narrow_prior_of_the_focal_length() -> None:
    size, full = (320, 240), (640, 480)
    hinted, plain = intrinsics_for(CameraConfig(), *size, full, 700.0), intrinsics_for(CameraConfig(), *size, full)
    assert np.exp(hinted.prior[0]) == pytest.approx(350.0) and hinted.values[0] == hinted.prior[0]
    assert hinted.prior_info[0] == pytest.approx(25 * plain.prior_info[0])  # 5 % for 25 %
    np.testing.assert_array_equal(hinted.prior_info[1:], plain.prior_info[1:])
    assert hinted.free.all() and (hinted.focal_source, plain.focal_source) == ("EXIF", "assumed")
    given = CameraConfig(intrinsics=(500.0, 500.0, 320.0, 240.0))
    lens = intrinsics_for(given, *size, full, 700.0)
    assert lens.focal_source == "given" and np.exp(lens.values[0]) == pytest.approx(250.0)


def test_starts_are_tried_at_the_hint_first_and_around_it() -> None:
    graph = KeyframeGraph(GraphConfig(), intrinsics_for(CameraConfig(), 320, 240, (640, 480), 700.0))
    graph.size = (320, 240)
    focals = first_focals(graph)
    assert focals[0] == pytest.approx(350.0) and len(focals) == 3 and min(focals) < 310 and max(focals) > 400
    graph.believe_focal(200.0)  # a network's; EXIF goes before it
    assert np.exp(graph.intrinsics.prior[0]) == pytest.approx(350.0)
    graph.set_intrinsics(intrinsics_for(CameraConfig(), 320, 240, (640, 480)))
    assert len(first_focals(graph)) == len(FOCAL_RATIOS)
    graph.believe_focal(200.0)
    assert np.exp(graph.intrinsics.prior[0]) == pytest.approx(200.0)


def test_a_hint_decides_where_the_views_cannot(exact_scene: Callable[..., Any]) -> None:
    """A short path and noise: the focal length follows EXIF, and not the starts around it."""
    scene = exact_scene(3, step=0.1, focal_px=330.0)
    graph = graph_of(scene, 3, noise_px=0.3)
    graph.set_intrinsics(intrinsics_for(CameraConfig(), 320, 240, (320, 240), 330.0))
    assert bootstrap(graph).started
    assert np.exp(graph.intrinsics.values[0]) == pytest.approx(330.0, rel=0.02)


@pytest.mark.parametrize("given", [(), (60.0, 60.0, 31.5, 23.5)])
def test_a_run_starts_at_the_focal_length_of_exif(tmp_path: Path, given: tuple[float, ...]) -> None:
    source = open_source(photographs(tmp_path / "a", lambda k: {FOCAL_35MM: 28}), ALL)
    config = replace(Config(), camera=CameraConfig(intrinsics=given), mapping=MappingConfig(enabled=False))
    slam = Slam(config, source.size, source=source)
    told = [n for n in slam.parts.notes if "focal length starts" in n]
    width, height = slam.graph.size
    expected = 28 * np.hypot(64, 48) / np.hypot(36, 24) * np.sqrt(width * height / (64 * 48))
    if given:
        assert told == [] and slam.graph.intrinsics.focal_source == "given"
    else:
        assert told == ["focal length starts at EXIF's 28 mm equivalent (52 px)"]
        assert np.exp(slam.graph.intrinsics.values[0]) == pytest.approx(expected)
