"""The viewer and the report in a real browser: what is drawn, how soon, from where, and that nothing is cut."""

from __future__ import annotations

import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from mastd3r.camera.pinhole import Camera
from mastd3r.cli.main import main
from mastd3r.evaluation.image_error import psnr
from mastd3r.export.read_run import Run, read_run
from mastd3r.mapping.ply import read_gaussians_ply
from mastd3r.mapping.splat import NEAR_RATIO, Splat
from mastd3r.viewer.server import is_installed
from viewers.browser import Browser
from viewers.show import Missing

Array = NDArray[Any]
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

SMALL = ("mapping.iterations=300", "mapping.max_gaussians=8000")
WIDTH, HEIGHT = 640, 480
WITHIN_DB = 3.0  # of our own render, against the photograph
FIRST_PICTURE_S = 5.0  # of our own process; what the browser takes is its software renderer's
EDGE_PX = 8  # of the photograph: where the selected camera's outline is drawn, and the lens looks past the image
LIT = 0.3  # share of the canvas that is no longer black
PLAIN = "?fixedDpr=1"  # viser draws smaller where it is slow
# viser's own: its splat's corners have two coordinates, whose third three.js misses; and a word on its clock
OF_VISER = ("THREE.Clock: This module has been deprecated", "THREE.BufferGeometry.computeBoundingSphere(): Computed")
CUT = """(() => {
  const width = document.documentElement.clientWidth;
  const box = (e) => e.getBoundingClientRect();
  const beyond = (e) => box(e).width > 0 && (box(e).right > width + 0.5 || box(e).left < -0.5);
  const cut = [...document.querySelectorAll("body *")].filter(beyond);
  const videos = [...document.querySelectorAll("video")];
  videos.forEach((v) => { v.autoplay = false; v.pause(); });
  return {
    scroll: document.documentElement.scrollWidth,
    cut: cut.map((e) => e.outerHTML.slice(0, 80)),
    videos: videos.map((v) => ({ width: v.videoWidth, bottom: box(v).bottom, error: v.error?.message ?? null })),
  };
})()"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    try:
        opened = Browser()
    except Missing as e:
        pytest.skip(f"no browser: {e}")
    with opened:
        yield opened


@pytest.fixture(scope="module")
def run(room_clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a small splat."""
    out = tmp_path_factory.mktemp("viewer") / "run"
    options = [word for change in SMALL for word in ("--set", change)]
    assert main(["run", str(room_clip), "--out", str(out), "--quiet", *options]) == 0
    return out


def symmetric(lens: Camera) -> Camera:
    """What viser looks through: the lens's vertical field of view, square pixels, no distortion."""
    focal_px = lens.fy_px * HEIGHT / lens.height
    return Camera(focal_px, focal_px, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)


def compared(run: Run, photograph: Array, shot: Array) -> tuple[float, float]:
    """PSNR in dB of the screenshot and of our own render, both against the photograph seen as viser looks."""
    assert run.camera is not None
    camera, lens = symmetric(run.camera), run.camera
    near = NEAR_RATIO * run.record["map"]["median_depth"]
    splat = Splat(read_gaussians_ply(run.path / "gaussians.ply"), near)
    ours = splat.render(run.trajectory.world_from_cam[0], camera)[0]
    at = lens.project(camera.rays(camera.pixel_grid())).astype(np.float32)
    wanted = cv2.remap(photograph, at, None, cv2.INTER_CUBIC).clip(0, 1)
    inside = ((at >= EDGE_PX) & (at <= np.array([lens.width, lens.height]) - 1 - EDGE_PX)).all(-1)
    inside[:EDGE_PX] = inside[-EDGE_PX:] = inside[:, :EDGE_PX] = inside[:, -EDGE_PX:] = False
    theirs, own = psnr(wanted, shot, inside), psnr(wanted, ours, inside)
    assert theirs is not None and own is not None
    return theirs, own


def picture(path: Path) -> Array:
    return np.asarray(Image.open(path).convert("RGB"), np.float32) / 255


@pytest.mark.skipif(not is_installed(), reason="viser is not installed")
def test_the_viewer_shows_the_splat_as_our_renderer_draws_it(run: Path, browser: Browser, tmp_path: Path) -> None:
    begun, before = time.time(), resource.getrusage(resource.RUSAGE_CHILDREN)
    words = [sys.executable, "-m", "mastd3r", "view", str(run), "--no-browser"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        address = process.stdout.readline().split()[0] + PLAIN
        first = browser.open(address, WIDTH, HEIGHT, lit=LIT)
        print(f"first picture after {first['lit_at_ms'] / 1e3 - begun:.1f} s")
        alone = browser.open(address, WIDTH, HEIGHT, lit=LIT, clicks=["Camera path"], canvas=str(tmp_path / "shot.png"))
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 130
    for answer in (first, alone):
        assert answer["foreign"] == []
        assert [line for line in answer["said"] if not line.startswith(OF_VISER)] == []
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(f"processor time of the viewer {used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime:.1f} s")
    assert used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime <= FIRST_PICTURE_S
    found, shot = read_run(run), picture(tmp_path / "shot.png")
    source = Path(found.record["source"]["path"])
    assert shot.shape == (HEIGHT, WIDTH, 3)
    theirs, own = compared(found, picture(sorted((source / "rgb").iterdir())[0]), shot)
    print(f"PSNR against the photograph: screenshot {theirs:.2f} dB, our render {own:.2f} dB")
    assert theirs >= own - WITHIN_DB


@pytest.mark.parametrize(("width", "height"), [(390, 844), (360, 640), (1280, 800)])
def test_nothing_of_the_report_is_cut(run: Path, browser: Browser, width: int, height: int) -> None:
    found = browser.open((run / "report.html").resolve().as_uri(), width, height, evaluate=CUT)
    assert found["said"] == [] and found["foreign"] == []
    value = found["value"]
    print(f"report at {width} px: {value['scroll']} px wide, {len(value['cut'])} elements cut")
    assert value["scroll"] <= width and value["cut"] == []
    assert len(value["videos"]) == 2 and all(v["width"] > 0 and v["error"] is None for v in value["videos"])
    assert value["videos"][0]["bottom"] <= height  # the flight is in the first screen


def test_every_link_of_the_report_leads_to_a_file(run: Path) -> None:
    links = re.findall(r'<a class="known" href="([^"]+)"', (run / "report.html").read_text())
    assert {link.rstrip("/") for link in links} == {
        p.name for p in run.iterdir() if p.name != "report.html" and not p.name.startswith(".")
    }
