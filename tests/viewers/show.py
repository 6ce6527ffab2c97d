"""A splat file in a web viewer beside our own render of it: for tests/test_viewers.py, and for a person to look.

    python tests/viewers/show.py RUN --viewer spark --frame 0 --out shot.png

writes one picture, our render on the left and the viewer's on the right. Needs Chromium, Node.js and npm.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mastd3r.camera.pinhole import Camera
from mastd3r.errors import InputError, SlamError
from mastd3r.evaluation.image_error import psnr
from mastd3r.export.read_run import read_run
from mastd3r.mapping.ply import read_gaussians_ply
from mastd3r.mapping.splat import Splat

Array = NDArray[Any]
PAGES = Path(__file__).resolve().parent
VIEWERS = ("spark", "gaussian-splats-3d")
SETTINGS = ("matched", "default")  # spark: nearest to what our renderer does, its own; the other viewer has one set
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SPZ_FROM_WORLD = np.diag([1.0, -1.0, -1.0, 1.0])  # how mapping/spz.py turns the world
FAR_RATIO = 1e5  # far plane / near plane
INSTALL_S, SHOOT_S = 240, 240


class Missing(Exception):
    """What the viewers need and this machine has not."""


@dataclass(frozen=True)
class View:
    """A camera somewhere in the world of the splat file."""

    world_from_cam: Array
    camera: Camera
    near: float

    def in_spz(self) -> View:
        """The same view for the .spz file."""
        return View(SPZ_FROM_WORLD @ self.world_from_cam, self.camera, self.near)

    def as_json(self, settings: str) -> dict[str, Any]:
        """What view.js reads."""
        lens = {name.removesuffix("_px"): value for name, value in asdict(self.camera).items()}
        pose = np.asarray(self.world_from_cam, float).tolist()
        return {**lens, "world_from_cam": pose, "near": self.near, "far": FAR_RATIO * self.near, "settings": settings}


@dataclass(frozen=True)
class Shot:
    """One picture to take."""

    viewer: str
    file: Path
    view: View
    settings: str = "matched"


def tools() -> tuple[str, str, str]:
    """Chromium, node and npm. Raises Missing."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    found = browser, shutil.which("node"), shutil.which("npm")
    lacking = [name for name, path in zip(("chromium", "node", "npm"), found, strict=True) if path is None]
    if lacking:
        raise Missing(f"not on this machine: {', '.join(lacking)}")
    return str(found[0]), str(found[1]), str(found[2])


def viewer_modules() -> Path:
    """The folder node_modules with the versions of package.json, installed once into the user's cache. Raises Missing.

    The environment variable MASTD3R_VIEWERS names another cache folder.
    """
    npm, wanted = tools()[2], (PAGES / "package.json").read_bytes()
    default = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mastd3r-viewers"
    folder = Path(os.environ.get("MASTD3R_VIEWERS", default)) / hashlib.sha256(wanted).hexdigest()[:12]
    if folder.is_dir():
        return folder / "node_modules"
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
        half = Path(scratch) / "half"
        half.mkdir()
        (half / "package.json").write_bytes(wanted)
        words = [npm, "install", "--ignore-scripts", "--no-audit", "--no-fund", "--no-package-lock"]
        try:
            done = subprocess.run(words, cwd=half, capture_output=True, text=True, timeout=INSTALL_S, check=False)
        except subprocess.TimeoutExpired as e:
            raise Missing(f"npm install took more than {INSTALL_S} s") from e
        if done.returncode:
            raise Missing(f"npm install: {' '.join(done.stderr.replace('npm error', '').split())[:200]}")
        if not folder.is_dir():
            half.rename(folder)
    return folder / "node_modules"


def photograph(shots: Sequence[Shot]) -> list[Array]:
    """(h, w, 3) float32 0..1, one a shot, over black. Raises Missing, and RuntimeError where a viewer fails."""
    browser, node, _ = tools()
    modules = viewer_modules()
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / f"{number}.png" for number in range(len(shots))]
        jobs = [
            {"viewer": s.viewer, "file": str(s.file.resolve()), "out": str(out), "view": s.view.as_json(s.settings)}
            for s, out in zip(shots, files, strict=True)
        ]
        words = [node, str(PAGES / "shoot.mjs"), str(PAGES), str(modules), browser]
        done = subprocess.run(
            words,
            input=json.dumps(jobs),
            capture_output=True,
            text=True,
            timeout=SHOOT_S + 20 * len(shots),
            check=False,
        )
        if done.returncode:
            raise RuntimeError(done.stderr.strip())
        return [np.asarray(Image.open(file).convert("RGB"), np.float32) / 255 for file in files]


def own_render(ply: Path, view: View) -> Array:
    """Our picture of the same view over black, as a screen shows it: rounded to bytes."""
    color = Splat(read_gaussians_ply(ply), view.near, (0, 0, 0)).render(view.world_from_cam, view.camera)[0]
    return np.rint(color * 255).astype(np.float32) / 255


def view_of_run(path: Path, frame: int) -> View:
    """Where the camera of a run folder was at one frame. Raises InputError."""
    run = read_run(path)
    near = run.record.get("map", {}).get("near")
    if run.camera is None or near is None:
        raise InputError(f"{path}: expected a run with camera.json and a map, got none")
    poses = run.trajectory.world_from_cam
    if not 0 <= frame < len(poses) or not np.isfinite(poses[frame]).all():
        raise InputError(f"{path}: expected a frame with a pose, 0 to {len(poses) - 1}, got {frame}")
    return View(poses[frame], run.camera.pinhole, near)


def main(words: Sequence[str] | None = None) -> str:
    """The command line; gives what it says at the end."""
    parser = argparse.ArgumentParser(description="our render of a run's splat beside a web viewer's")
    parser.add_argument("run", type=Path, help="run folder with gaussians.ply, trajectory.txt, camera.json, run.json")
    parser.add_argument("--viewer", choices=VIEWERS, default=VIEWERS[0])
    parser.add_argument("--settings", choices=SETTINGS, default=SETTINGS[0], help="of spark: ours or its own")
    parser.add_argument("--frame", type=int, default=0, help="row of trajectory.txt, from 0")
    parser.add_argument("--spz", action="store_true", help="show gaussians.spz, not gaussians.ply")
    parser.add_argument("--out", type=Path, default=Path("shot.png"))
    asked = parser.parse_args(words)
    view = view_of_run(asked.run, asked.frame)
    ours = own_render(asked.run / "gaussians.ply", view)
    shown, seen_from = ("gaussians.spz", view.in_spz()) if asked.spz else ("gaussians.ply", view)
    theirs = photograph([Shot(asked.viewer, asked.run / shown, seen_from, asked.settings)])[0]
    Image.fromarray(np.rint(np.hstack([ours, theirs]) * 255).astype(np.uint8)).save(asked.out)
    return f"{asked.out}: ours left, {asked.viewer} right, PSNR {psnr(ours, theirs):.1f} dB"


if __name__ == "__main__":
    try:
        print(main())
    except (SlamError, Missing, RuntimeError) as e:
        sys.exit(f"show.py: {e}")
