"""A map trained from a COLMAP export alone, beside the splat of the run that it is of; prints and writes JSON.

    mastd3r export RUN --to colmap --out EXPORT
    python benchmarks/train_from_export.py EXPORT RUN --out RESULT.json

From EXPORT come images, masks, poses, lens and points, read by the tests' own reader of COLMAP's files; from RUN the
options of its map (config.yaml), so that both are trained for as long on images of the same scale. Every eighth image
is kept away from both. Both files are drawn there, and compared with the exported images where nothing moves.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import mastd3r
from mastd3r.camera.pinhole import Camera
from mastd3r.config import HOLDOUT_EVERY
from mastd3r.evaluation.image_error import psnr
from mastd3r.export.machine import machine_info
from mastd3r.geometry.se3 import inverse
from mastd3r.mapping.mapper import Mapper
from mastd3r.mapping.ply import read_gaussians_ply, write_gaussians_ply
from mastd3r.mapping.splat import NEAR_RATIO, Splat
from mastd3r.types import StaticCloud, View

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
from colmap_reader import Image, Model, read_binary

Array = NDArray[Any]
FEWEST = 0.01  # weight of a pixel that a mask leaves out: exactly 0 would mean that there is no data


def camera_of(model: Model, scale: float) -> Camera:
    """The pinhole of the export, its images scaled."""
    name, width, height, (fx, fy, cx, cy) = model.camera
    if name != "PINHOLE":
        raise SystemExit(f"expected an undistorted export (PINHOLE), got {name}")
    full = Camera(fx, fy, cx - 0.5, cy - 0.5, width, height)
    return full.resized(round(width * scale), round(height * scale))


def view_of(export: Path, number: int, image: Image, camera: Camera) -> View:
    """One image of the export as the trainer takes it."""
    size = (camera.width, camera.height)
    pixels = cv2.cvtColor(cv2.imread(str(export / "images" / image.name)), cv2.COLOR_BGR2RGB)
    mask = cv2.imread(str(export / "masks" / f"{image.name}.png"), cv2.IMREAD_GRAYSCALE)
    static = cv2.resize(mask.astype(np.float32) / 255, size, interpolation=cv2.INTER_AREA)
    small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    static = np.clip(static, FEWEST, 1).astype(np.float16)
    return View(float(number), small, static, inverse(image.cam_from_world), camera, 0)


def cloud_of(model: Model) -> StaticCloud:
    """The points of the export; a point stands for as much as lies half-way to its neighbours."""
    points = np.array([p.xyz for p in model.points.values()], np.float32)
    colors = np.array([p.rgb for p in model.points.values()], np.uint8)
    spacing = cKDTree(points).query(points, k=4)[0][:, 1:].mean(1).astype(np.float32)
    return StaticCloud(points, colors, np.ones(len(points), np.float32), spacing, np.zeros(len(points), np.int32))


def score(splat: Splat, views: list[View]) -> float:
    """Mean PSNR over views, where nothing moves."""
    figures = [psnr(splat.render(v.world_from_cam, v.camera)[0], v.image / 255, v.static > 0.5) for v in views]
    return float(np.mean([f for f in figures if f is not None]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("export", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    run = mastd3r.load(args.run)
    mapping, model = run.config.mapping, read_binary(args.export / "sparse" / "0")
    camera = camera_of(model, mapping.width_px / run.camera.width)
    views = [view_of(args.export, n, image, camera) for n, image in enumerate(model.images.values())]
    held, shown = views[::HOLDOUT_EVERY], [v for n, v in enumerate(views) if n % HOLDOUT_EVERY]
    options = replace(mapping, width_px=camera.width, refine_poses=False)
    mapper = Mapper(options, cloud_of(model), shown, run.config.seed)
    mapper.refine(mapping.iterations or 0)
    mapper.settle()
    near = NEAR_RATIO * float(mapper.facts["median_depth"])
    with tempfile.TemporaryDirectory() as folder:
        write_gaussians_ply(Path(folder) / "trained.ply", mapper.gaussians)
        trained = score(Splat(read_gaussians_ply(Path(folder) / "trained.ply"), near), held)
    of_run = score(Splat(read_gaussians_ply(args.run / "gaussians.ply"), near), held)
    found = {
        "psnr_from_export": trained,
        "psnr_of_run": of_run,
        "difference_db": trained - of_run,
        "images": [len(shown), len(held)],
        "image_size": [camera.width, camera.height],
        "points": len(model.points),
        "steps": mapping.iterations,
        "gaussians": [len(mapper.gaussians.means), mapping.max_gaussians],
        "machine": machine_info(),
    }
    print(json.dumps({k: v for k, v in found.items() if k != "machine"}))
    if args.out is not None:
        args.out.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
