"""The two rasterisers on one machine: do they agree, and how fast is mapping on each; writes JSON.

    python benchmarks/bench_gpu_map.py RUN --out gpu_map.json

RUN is a finished run folder (gaussians.ply, camera.json, trajectory.txt); photographs are not needed: the map is
trained towards its own renders, from a disturbed start. Without an accelerator only the CPU's half is measured.
Every part is written as soon as it is done; a part that fails leaves its error line and the others go on.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bench_rasteriser import CASES, random_case
from mastd3r.camera.pinhole import Camera
from mastd3r.concurrency import one_torch_thread
from mastd3r.config import HOLDOUT_EVERY, MappingConfig
from mastd3r.errors import InputError, SlamError
from mastd3r.export.machine import machine_info, peak_rss_mib
from mastd3r.export.read_run import read_run
from mastd3r.mapping.gaussians import GaussianArrays, GaussianMap
from mastd3r.mapping.mapper import Mapper
from mastd3r.mapping.ply import read_gaussians_ply
from mastd3r.mapping.rasterise import rasterization, torch_device
from mastd3r.mapping.rasterise_reference import rasterise_reference
from mastd3r.types import StaticCloud, View

FAILURES = (SlamError, RuntimeError, OSError, ImportError, AttributeError, ValueError, TypeError, KeyError)
FAILURES += (AssertionError, subprocess.CalledProcessError)
MAX_COLOR_DIFFERENCE, MAX_GRADIENT_ERROR = 1e-3, 1e-4  # the bounds that the figures are held to
SEEDS = (0, 1, 2)
VIEWS, WARM_UP, SETTLE = 24, 30, 15
GPU_WIDTH_PX = 320  # of the images, at most
Drawn = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


def read_map(folder: Path, width_px: int) -> tuple[GaussianArrays, Camera, np.ndarray]:
    """Gaussians, the pinhole camera of the renders, and (n, 4, 4) poses of the frames."""
    run = read_run(folder)
    if run.camera is None:
        raise InputError(f"{folder}: expected camera.json, got none")
    width = min(width_px, run.camera.width)
    camera = run.camera.pinhole.resized(width, round(run.camera.height * width / run.camera.width))
    poses = run.trajectory.world_from_cam
    return read_gaussians_ply(folder / "gaussians.ply"), camera, poses[np.isfinite(poses).all((1, 2))]


def drawn(gaussians: GaussianMap, pose: np.ndarray, camera: Camera) -> Drawn:
    """Colour, depth and alpha from one pose, at the near limit of a trained map."""
    view, K = torch.from_numpy(np.linalg.inv(pose)), torch.from_numpy(camera.matrix)
    return gaussians.draw(view, K, camera.width, camera.height, 0.05)


def agreement(arrays: GaussianArrays, camera: Camera, poses: np.ndarray, device: str) -> dict[str, Any]:
    """Renders of the holdout poses by both backends; depth in units of its median."""
    maps = GaussianMap.from_arrays(arrays), GaussianMap.from_arrays(arrays, device)
    rows = []
    for pose in poses[::HOLDOUT_EVERY]:
        with torch.no_grad():
            ours, theirs = (tuple(t.cpu() for t in drawn(m, pose, camera)) for m in maps)
        seen = ours[2] > 0.5
        scale = float(ours[1][seen].median()) if bool(seen.any()) else 1.0
        apart = [(a - b).abs() for a, b in zip(ours, theirs, strict=True)]
        rows.append([float(f(d)) for d in (apart[0], apart[1] / scale, apart[2]) for f in (torch.mean, torch.max)])
    table = np.array(rows)
    names = [f"{kind}_{what}" for kind in ("color", "depth_ratio", "alpha") for what in ("mean", "max")]
    out: dict[str, Any] = {"views": len(rows), "size": [camera.width, camera.height], "gaussians": len(arrays.means)}
    for i, name in enumerate(names):
        out[name] = float(table[:, i].mean() if name.endswith("mean") else table[:, i].max())
    out["color_mean_worst_view"] = float(table[:, 0].max())
    out["bound"], out["holds"] = MAX_COLOR_DIFFERENCE, out["color_mean_worst_view"] <= MAX_COLOR_DIFFERENCE
    return out


def gradient_errors(device: str) -> dict[str, Any]:
    """Largest relative error (norm of the difference / norm) of each gradient against the float64 reference."""
    sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
    from gaussian_scenes import HEIGHT, KINDS, NAMES, WIDTH, random_scene, with_grads

    def on_device(*arguments: Any, **options: Any) -> Drawn:
        moved = [a.to(device, torch.float32) if isinstance(a, torch.Tensor) else a for a in arguments]
        return tuple(t.cpu() for t in rasterization(*moved, **options))  # type: ignore[return-value]

    out: dict[str, Any] = {}
    for kind in KINDS:
        worst = dict.fromkeys(NAMES, 0.0)
        values = 0.0
        for seed in SEEDS:
            scene, K = random_scene(kind, seed)
            image, grads = with_grads(on_device, scene, K)
            exact_image, exact = with_grads(rasterise_reference, scene, K)
            values = max(
                values, *(float((a - b).detach().abs().max()) for a, b in zip(image, exact_image, strict=True))
            )
            for name, a, b in zip(NAMES, grads, exact, strict=True):
                worst[name] = max(worst[name], float((a - b).norm() / b.norm()))
        out[kind] = {"value_error_max": values, **worst}
    largest = max(v for row in out.values() for k, v in row.items() if k != "value_error_max")
    size, seeds = [WIDTH, HEIGHT], list(SEEDS)
    return {"size": size, "seeds": seeds, "bound": MAX_GRADIENT_ERROR, "worst": largest, "kinds": out}


def synchronised(device: str) -> float:
    """Now, after the device has done what it was given."""
    if device != "cpu":
        torch.cuda.synchronize()
    return time.perf_counter()


def pass_times(leaves: list[torch.Tensor], K: torch.Tensor, size: tuple[int, int], repeats: int) -> dict[str, float]:
    """Median milliseconds of forward and of forward + backward."""
    device = leaves[0].device.type
    forward, total = [], []
    for repeat in range(repeats + 3):
        began = synchronised(device)
        result = rasterization(*leaves, K, *size)
        middle = synchronised(device)
        torch.autograd.grad([*result], leaves, [torch.ones_like(t) for t in result])
        if repeat >= 3:
            forward.append((middle - began) * 1e3)
            total.append((synchronised(device) - began) * 1e3)
    return {"forward_ms": float(np.median(forward)), "forward_backward_ms": float(np.median(total))}


def rasteriser_speed(device: str, repeats: int) -> dict[str, Any]:
    """The cases of bench_rasteriser.py on one device."""
    out = {}
    for count, width, height in CASES:
        *leaves, K = (t.detach().to(device) for t in random_case(count, width, height))
        leaves = [t.requires_grad_() for t in leaves]
        out[f"{count} at {width}x{height}"] = pass_times(leaves, K, (width, height), repeats)
    return out


def training_set(arrays: GaussianArrays, camera: Camera, poses: np.ndarray) -> list[View]:
    """Views drawn from the map by the CPU, none of them a holdout pose."""
    source = GaussianMap.from_arrays(arrays)
    numbers = [n for n in range(len(poses)) if n % HOLDOUT_EVERY][:: max(1, len(poses) // VIEWS)]
    ones = np.ones((camera.height, camera.width), np.float32)
    views = []
    for n in numbers:
        with torch.no_grad():
            image = (drawn(source, poses[n], camera)[0].clamp(0, 1).numpy() * 255).round().astype(np.uint8)
        views.append(View(float(n), image, ones, poses[n], camera, 0))
    return views


def mapping_speed(arrays: GaussianArrays, camera: Camera, poses: np.ndarray, device: str, steps: int) -> dict[str, Any]:
    """Training steps a second on a map of this size, and what the steps gain on holdout poses."""
    if device != "cpu":
        torch.cuda.reset_peak_memory_stats()
    count = len(arrays.means)
    colors = (np.clip(arrays.colors, 0, 1) * 255).astype(np.uint8)
    spacing = 2 * np.exp(np.log(np.maximum(arrays.scales, 1e-9)).mean(1))
    cloud = StaticCloud(arrays.means, colors, np.ones(count, np.float32), spacing, np.zeros(count, np.int32))
    total = WARM_UP + steps
    config = MappingConfig(iterations=total, max_gaussians=int(count / 0.6) + 1, loss="plain")
    mapper = Mapper(config, cloud, training_set(arrays, camera, poses), 0, device)
    source, chosen = GaussianMap.from_arrays(arrays), poses[::HOLDOUT_EVERY][:SETTLE]

    def quality() -> float:
        figures = []
        for pose in chosen:
            with torch.no_grad():
                truth = drawn(source, pose, camera)[0].clamp(0, 1).numpy()
            error = np.square(mapper.render(pose, camera)[0] - truth).mean()
            figures.append(-10 * np.log10(max(float(error), 1e-12)))
        return float(np.mean(figures))

    before = quality()
    mapper.refine(WARM_UP)
    began = synchronised(device)
    mapper.refine(steps)
    seconds = synchronised(device) - began
    out = {"gaussians_start": count, "gaussians_end": len(mapper.gaussians.means), "steps": steps}
    out |= {"steps_per_s": steps / seconds, "psnr_start_db": before, "psnr_end_db": quality()}
    if device != "cpu":
        out["peak_allocated_mib"] = torch.cuda.max_memory_allocated() / 2**20
        out["peak_reserved_mib"] = torch.cuda.max_memory_reserved() / 2**20
    return out | {"peak_rss_mib": peak_rss_mib()}


def map_pass_times(arrays: GaussianArrays, camera: Camera, pose: np.ndarray, device: str, n: int) -> dict[str, float]:
    """Forward and backward over the trained map itself."""
    g = GaussianMap.from_arrays(arrays, device)
    view = torch.from_numpy(np.linalg.inv(pose)).float().to(device)
    parts = (g.means, g.quats, g.log_scales.exp(), g.opacity_logits.sigmoid(), g.colors, view)
    leaves = [t.detach().requires_grad_() for t in parts]
    return pass_times(leaves, torch.from_numpy(camera.matrix), (camera.width, camera.height), n)


class Report:
    """The JSON file, written anew after every part."""

    def __init__(self, path: Path, run: Path) -> None:
        self.path = path
        info = machine_info()
        self.data: dict[str, Any] = {
            "date": time.strftime("%Y-%m-%d"),
            "run": run.name,
            "device": torch.cuda.get_device_name() if torch_device() != "cpu" else None,
            "cuda": torch.version.cuda,
            "machine": {k: info[k] for k in ("platform", "processor", "cores", "python", "git_commit")},
            "packages": {k: info["packages"].get(k) for k in ("torch", "numba", "gsplat", "numpy")},
        }
        self.failed = False

    def part(self, name: str, work: Callable[[], Any]) -> Any:
        """Do one part; its result, or None and its error line in the file."""
        began, result = time.perf_counter(), None
        try:
            result = work()
            self.data[name] = result if isinstance(result, dict) else "done"
        except FAILURES as e:
            self.failed = True
            self.data[name] = {"error": f"{type(e).__name__}: {' '.join(str(e).split())[:500]}"}
        text = json.dumps(self.data, indent=1)
        self.path.write_text(text + "\n")
        print(f"{name}: {time.perf_counter() - began:.1f} s {json.dumps(self.data[name])}", flush=True)
        return result


def main() -> int:
    """Command line; 1 where a part failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="finished run folder")
    parser.add_argument("--out", type=Path, default=Path("gpu_map.json"))
    parser.add_argument("--steps", type=int, default=300, help="training steps that are timed on the accelerator")
    parser.add_argument("--cpu-steps", type=int, default=300, help="the same on the CPU")
    parser.add_argument("--repeats", type=int, default=15)
    args = parser.parse_args()
    report, device = Report(args.out, args.run), torch_device()
    devices = ["cpu"] if device == "cpu" else [device, "cpu"]
    if device != "cpu":  # gsplat compiles its kernels at the first call
        report.part("gsplat_first_call", lambda: {"error_max": gradient_errors(device)["worst"]})
    loaded = report.part("map", lambda: read_map(args.run, GPU_WIDTH_PX))
    for on in devices:
        report.part(f"gradients_{on}", lambda on=on: gradient_errors(on))
    if loaded is not None:
        arrays, camera, poses = loaded
        if device != "cpu":
            report.part("agreement", lambda: agreement(arrays, camera, poses, device))
        for on in devices:
            n = args.steps if on != "cpu" else args.cpu_steps
            report.part(f"map_pass_{on}", lambda on=on: map_pass_times(arrays, camera, poses[0], on, args.repeats))
            report.part(f"mapping_{on}", lambda on=on, n=n: mapping_speed(arrays, camera, poses, on, n))
    for on in devices:
        with one_torch_thread():
            report.part(f"rasteriser_{on}", lambda on=on: rasteriser_speed(on, args.repeats))
    return int(report.failed)


if __name__ == "__main__":
    sys.exit(main())
