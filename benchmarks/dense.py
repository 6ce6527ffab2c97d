"""Dense cloud and mesh of a finished run, against the depth sensor of its sequence.

usage: python benchmarks/dense.py --run RUN --sequence SEQUENCE --out dense.json [--work DIR]
The run is one of ``mastd3r run SEQUENCE``. Depth is found anew from its keyframes; the sensor's depth is for the
judgement alone. Printed and written: seconds, coverage, and the figures of ``mastd3r eval`` for cloud and mesh, the
splat's own depth in place of the swept one where there is a splat, what the sensor reads against the true poses, and
how well the sensor's own depth, as points and as a mesh, does as the estimate.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mastd3r.camera.pinhole import Camera
from mastd3r.concurrency import one_blas_thread
from mastd3r.config import Config
from mastd3r.evaluation.cloud_error import SensorView, evaluate_cloud, sensor_views
from mastd3r.export.machine import machine_info
from mastd3r.export.mesh_files import write_mesh
from mastd3r.export.point_cloud import read_cloud, read_points
from mastd3r.export.read_run import Run, read_run
from mastd3r.geometry.se3 import inverse
from mastd3r.mapping.ply import read_gaussians_ply
from mastd3r.mapping.splat import NEAR_RATIO, Splat
from mastd3r.mvs.depth_maps import REACH_PX, SOURCES, DepthMaps, agreed
from mastd3r.mvs.mesh import Mesh, meshed
from mastd3r.mvs.views import StereoView
from mastd3r.offline.dense import densified, write_dense
from mastd3r.progress import Silent
from mastd3r.sources import open_source
from mastd3r.types import Frame, State, Trajectory, Truth

Array = NDArray[Any]
SCALES = np.arange(0.9, 1.2001, 0.02)  # of the sensor's depth, that are tried
SAMPLES = 600_000  # points on a mesh
CUT_M = 0.1  # depth differences are cut there


@one_blas_thread()
def main() -> int:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, required=True)
    parser.add_argument("--sequence", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--work", type=Path, help="where cloud and mesh are written (default: beside --out)")
    args = parser.parse_args()
    work = args.work or args.out.parent
    work.mkdir(parents=True, exist_ok=True)
    found = measured(read_run(args.run), args.sequence, work)
    text = json.dumps(found, indent=2)
    args.out.write_text(text + "\n")
    print(text)
    return 0


def measured(run: Run, sequence: Path, work: Path) -> dict[str, Any]:
    """All figures."""
    source = open_source(sequence, Config().source, want_depth=True)
    truth, lens = source.truth(), run.camera
    frames = [frame for frame in source.frames() if frame.depth_m is not None]
    if truth is None or lens is None:
        raise SystemExit(f"{sequence}: expected a sequence with truth, and a run with a lens")

    def scored(points: Array) -> dict[str, Any]:
        return evaluate_cloud(points, run.trajectory, truth, frames, lens)

    cpu, began = time.process_time(), time.perf_counter()
    dense = densified(run, source, Silent())
    points = write_dense(dense, work / "cloud_dense.ply")
    cloud_s, cloud_cpu_s = time.perf_counter() - began, time.process_time() - cpu
    cpu, began = time.process_time(), time.perf_counter()
    mesh = meshed(dense.views, dense.maps)
    mesh_s, mesh_cpu_s = time.perf_counter() - began, time.process_time() - cpu
    write_mesh(work / "mesh.ply", mesh.vertices_world, mesh.faces, mesh.colors)
    write_mesh(work / "mesh.glb", mesh.vertices_world, mesh.faces, mesh.colors)
    found = {
        "date": datetime.now(UTC).date().isoformat(),
        "machine": machine_info(),
        "sensor_scale": sensor_scale(sensor_views(truth, frames), truth.focal_px, lens),
        **sensor_itself(sensor_views(truth, frames), truth, frames, lens),
        "sparse": scored(read_cloud(run.path / "cloud.ply").points_world),
        "dense": {**dense.facts, "points": points, "seconds": cloud_s, "cpu_s": cloud_cpu_s}
        | scored(read_points(work / "cloud_dense.ply")),
        "mesh": {"triangles": len(mesh.faces), "seconds": mesh_s, "cpu_s": mesh_cpu_s} | scored(on_surface(mesh)),
    }
    if (run.path / "gaussians.ply").is_file():
        other = meshed(dense.views, splat_maps(run, dense.views, dense.maps))
        found["mesh of the splat's depth"] = {"triangles": len(other.faces)} | scored(on_surface(other))
    return found


def sensor_scale(sensor: list[SensorView], focal_px: float | None, lens: Camera) -> dict[str, float]:
    """The scale by which depth images agree best with one another under the TRUE poses, and their mean difference.

    Of the truth alone, no estimate takes part: other than 1, the sensor's metre is not that of the true poses.
    """
    camera = lens.pinhole if focal_px is None else Camera.centred(focal_px, lens.width, lens.height)
    rays = camera.rays(camera.pixel_grid()[::6, ::6])

    def difference(scale: float) -> float:
        out = []
        for i in range(0, len(sensor) - 8, 3):
            known = sensor[i].depth_m[::6, ::6] > 0
            points = (rays * (sensor[i].depth_m[::6, ::6] / scale)[..., None])[known]
            for j in (i + 3, i + 8):
                j_from_i = inverse(sensor[j].world_from_cam) @ sensor[i].world_from_cam
                there = points @ j_from_i[:3, :3].T + j_from_i[:3, 3]
                there = there[there[:, 2] > 0.1]
                px = np.rint(camera.project(there)).astype(int)
                inside = ((px >= 0) & (px < [camera.width, camera.height])).all(1)
                depth = sensor[j].depth_m[px[inside, 1], px[inside, 0]]
                out.append(np.minimum(np.abs(there[inside, 2] - depth / scale)[depth > 0], CUT_M))
        return float(np.concatenate(out).mean())

    differences = [difference(scale) for scale in SCALES]
    best = int(np.argmin(differences))
    return {"scale": float(SCALES[best]), "difference_m": differences[best], "difference_at_1_m": difference(1.0)}


def sensor_itself(sensor: list[SensorView], truth: Truth, frames: list[Frame], lens: Camera) -> dict[str, Any]:
    """Figures of the sensor's own depth at the true poses: what no estimate can beat by much.

    As points, of frames that are not judged against; and as one surface, of those that are, by the mesh of this
    package, also with depth divided by what ``sensor_scale`` finds.
    """
    camera = lens.pinhole if truth.focal_px is None else Camera.centred(truth.focal_px, lens.width, lens.height)
    states: tuple[State, ...] = ("tracked",) * len(truth.timestamps_s)
    exact = Trajectory(truth.timestamps_s, truth.world_from_cam, states, np.ones(len(states), bool))
    others = sensor_views(truth, [replace(f, index=f.index - 2) for f in frames])
    rays = camera.rays(camera.pixel_grid())
    clouds = [
        (rays * view.depth_m[..., None])[view.depth_m > 0][::4] @ view.world_from_cam[:3, :3].T
        + view.world_from_cam[:3, 3]
        for view in others
    ]
    found = {"sensor's other frames": evaluate_cloud(np.concatenate(clouds), exact, truth, frames, lens)}
    poses = np.stack([view.world_from_cam for view in sensor])
    depth = np.stack([view.depth_m for view in sensor])
    blank = np.zeros((*depth.shape[1:], 3), np.uint8)
    views = [StereoView(0.0, blank, np.ones(blank.shape[:2], bool), pose, camera) for pose in poses]
    for scale in (1.0, sensor_scale(sensor, truth.focal_px, lens)["scale"]):
        rho = np.where(depth > 0, scale / np.maximum(depth, 1e-9), 0).astype(np.float32)
        seen = np.full(rho.shape, SOURCES, np.uint8)
        mesh = meshed(views, DepthMaps(rho, seen, rho, rho > 0, camera, poses, ()))
        name = "mesh of the sensor's depth" + ("" if scale == 1 else ", divided")
        found[name] = evaluate_cloud(on_surface(mesh), exact, truth, frames, lens)
    return found


def on_surface(mesh: Mesh) -> Array:
    """Points spread evenly over the triangles, (n, 3)."""
    rng = np.random.default_rng(0)
    corners = mesh.vertices_world[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = corners[rng.choice(len(corners), SAMPLES, p=area / area.sum())]
    a, b = rng.random((2, SAMPLES, 1))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    return np.asarray(chosen[:, 0] * (1 - a - b) + chosen[:, 1] * a + chosen[:, 2] * b)


def splat_maps(run: Run, views: list[StereoView], maps: DepthMaps) -> DepthMaps:
    """The same views with the depth that the run's splat is drawn with."""
    gaussians = read_gaussians_ply(run.path / "gaussians.ply")
    splat = Splat(gaussians, NEAR_RATIO * run.record["map"]["median_depth"])
    depths = np.stack([splat.render(view.world_from_cam, maps.camera)[1] for view in views])
    static = np.stack([view.static for view in views])
    inv_depth = np.where((depths > 0) & static, 1 / np.maximum(depths, 1e-9), 0).astype(np.float32)
    count, merged = agreed(inv_depth, maps.camera, maps.world_from_cam, list(maps.near), REACH_PX)
    return replace(maps, inv_depth=inv_depth, agreeing=count, merged=merged)


if __name__ == "__main__":
    raise SystemExit(main())
