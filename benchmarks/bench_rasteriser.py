"""Time and memory of the CPU rasteriser, forward + backward, against a vectorised pure-torch one; writes JSON.

    python benchmarks/bench_rasteriser.py --out rasteriser.json

The case: random Gaussians in the camera's frustum, sigma 0.7 to 3 px at 320 px width (in proportion at 640),
opacity 0.1 to 0.9, gradients to every input and to the view matrix, float32. ``*_cpu_ms`` is the time of the
processor, all threads together: on a machine that others use too it says more than the time on the clock.
``peak_rss_mib`` is the most memory that the process had held by then, ours being measured before torch's.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
import torch

from mastd3r.export.machine import peak_rss_mib
from mastd3r.mapping.rasterise import rasterization
from mastd3r.mapping.rasterise_reference import rotation_matrices

TORCH_LIMIT = 100_000  # Gaussians: torch would keep tens of GiB for the largest case
CASES = ((20_000, 320, 240), (100_000, 640, 480), (300_000, 1280, 720))
Result = tuple[torch.Tensor, ...]


def random_case(count: int, width: int, height: int) -> list[torch.Tensor]:
    """means, quats, scales, opacities, colors, view (leaves) and K."""
    rng = np.random.default_rng(0)
    focal = 0.9 * width
    z = rng.uniform(1, 6, count)
    u, v = rng.uniform(-0.05, 1.05, (2, count))
    means = np.stack([(u - 0.5) * width / focal * z, (v - 0.5) * height / focal * z, z], 1)
    scales = rng.uniform(0.7, 3, (count, 3)) * (width / 320) / focal * z[:, None]
    view = np.eye(4)
    view[:3, 3] = [0.01, -0.02, 0.03]
    arrays = [
        means,
        rng.normal(size=(count, 4)),
        scales,
        rng.uniform(0.1, 0.9, count),
        rng.uniform(0, 1, (count, 3)),
        view,
    ]
    leaves = [torch.tensor(a, dtype=torch.float32).requires_grad_() for a in arrays]
    K = torch.tensor([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1]], dtype=torch.float32)
    return [*leaves, K]


def torch_rasterise(means, quats, scales, opacities, colors, view, K, width, height):  # type: ignore[no-untyped-def]
    """Vectorised torch: (tile, Gaussian) pairs by sorting, one padded batch of tiles a power of two."""
    tile = 16
    points = means @ view[:3, :3].T + view[:3, 3]
    x, y, z = points.unbind(-1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2], -1).view(-1, 2, 3)
    shape = jacobian @ view[:3, :3] @ (rotation_matrices(quats) * scales[:, None, :])
    covariance = shape @ shape.transpose(1, 2)
    a, b, c = covariance[:, 0, 0] + 0.3, covariance[:, 0, 1], covariance[:, 1, 1] + 0.3
    determinant = a * c - b * b
    pixels, conic = (
        torch.stack([fx * x / z + cx, fy * y / z + cy], -1),
        torch.stack([c, -b, a], -1) / determinant[:, None],
    )
    features = torch.cat([colors, z[:, None]], -1)
    columns, rows = -(-width // tile), -(-height // tile)
    with torch.no_grad():
        reach = torch.sqrt(2 * torch.log(opacities * 255)).clamp(min=0)[:, None] * torch.stack([a, c], -1).sqrt()
        limit = torch.tensor([columns, rows])
        low = ((pixels - reach) / tile).floor().long().clamp(min=0)
        high = torch.minimum(((pixels + reach) / tile).ceil().long(), limit)
        extent = (high - low).clamp(min=0)
        number = extent.prod(1)
        gaussian = torch.repeat_interleave(torch.arange(len(z)), number)
        inside = torch.arange(len(gaussian)) - torch.repeat_interleave(number.cumsum(0) - number, number)
        tx = low[gaussian, 0] + inside % extent[gaussian, 0]
        ty = low[gaussian, 1] + inside // extent[gaussian, 0]
        by_depth = torch.argsort(z[gaussian], stable=True)
        order = by_depth[torch.argsort((ty * columns + tx)[by_depth], stable=True)]
        gaussian, tiles = gaussian[order], (ty * columns + tx)[order]
        counts = torch.bincount(tiles, minlength=columns * rows)
        starts = counts.cumsum(0) - counts
    image = torch.zeros(columns * rows, tile * tile, 5)
    grid = torch.stack(torch.meshgrid(torch.arange(tile), torch.arange(tile), indexing="xy"), -1).view(-1, 2) + 0.5
    level = torch.ceil(torch.log2(counts.clamp(min=1).float())).long()
    for power in level.unique().tolist():
        chosen = torch.nonzero((level == power) & (counts > 0))[:, 0]
        for group in chosen.split(max(1, 2**15 >> power)):
            slot = torch.arange(int(counts[group].max()))
            valid = slot[None] < counts[group][:, None]
            ids = gaussian[(starts[group][:, None] + slot[None]).clamp(max=len(gaussian) - 1)]
            corner = torch.stack([group % columns, group // columns], -1) * tile
            offset = grid[None, :, None] + corner[:, None, None] - pixels[ids][:, None]
            dx, dy, k = offset[..., 0], offset[..., 1], conic[ids][:, None]
            exponent = 0.5 * (k[..., 0] * dx * dx + k[..., 2] * dy * dy) + k[..., 1] * dx * dy
            alpha = (opacities[ids][:, None] * torch.exp(-exponent)).clamp_max(0.999)
            alpha = alpha * ((alpha >= 1 / 255) & valid[:, None])
            after = torch.cumprod(1 - alpha, -1)
            alpha = alpha * (after > 1e-4)
            before = torch.cat([torch.ones_like(after[..., :1]), after[..., :-1]], -1)
            weight = alpha * before
            part = torch.cat([weight @ features[ids], weight.sum(-1, keepdim=True)], -1)
            image = image.index_put((group,), part)
    full = image.view(rows, columns, tile, tile, 5).permute(0, 2, 1, 3, 4).reshape(rows * tile, columns * tile, 5)
    full = full[:height, :width]
    return full[..., :3], full[..., 3], full[..., 4]


def milliseconds(
    function: Callable[..., Result], case: list[torch.Tensor], size: tuple[int, int], repeats: int
) -> dict[str, float]:
    """Median time of forward and of backward, on the clock and of the processor, after one warm-up."""
    wall: list[list[float]] = []
    processor: list[list[float]] = []
    for repeat in range(repeats + 1):
        for leaf in case[:6]:
            leaf.grad = None
        times = [(time.perf_counter(), time.process_time())]
        color, depth, alpha = function(*case, *size)
        times.append((time.perf_counter(), time.process_time()))
        torch.autograd.backward([color, depth, alpha], [torch.ones_like(t) for t in (color, depth, alpha)])
        times.append((time.perf_counter(), time.process_time()))
        if repeat:
            for kept, number in ((wall, 0), (processor, 1)):
                kept.append([(after[number] - before[number]) * 1e3 for before, after in itertools.pairwise(times)])
    out: dict[str, float] = {}
    for name, kept in (("", wall), ("_cpu", processor)):
        f, b = (float(v) for v in np.median(kept, axis=0))
        out |= {f"forward{name}_ms": round(f, 2), f"backward{name}_ms": round(b, 2), f"total{name}_ms": round(f + b, 2)}
    return out


def measure(count: int, width: int, height: int, repeats: int, with_torch: bool) -> dict[str, object]:
    """One row of the table; the two must draw the same image."""
    case = random_case(count, width, height)
    row: dict[str, object] = {"gaussians": count, "width": width, "height": height}
    ours = milliseconds(rasterization, case, (width, height), repeats)
    row["ours"] = {**ours, "peak_rss_mib": round(peak_rss_mib(), 1)}
    if with_torch and count <= TORCH_LIMIT:
        with torch.no_grad():
            pair = rasterization(*case, width, height), torch_rasterise(*case, width, height)
        row["mean_color_difference"] = float((pair[0][0] - pair[1][0]).abs().mean())
        torch_time = milliseconds(torch_rasterise, case, (width, height), 1)
        row["torch"] = torch_time
        row["times_faster"] = round(torch_time["total_ms"] / ours["total_ms"], 1)
    return row


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("bench_rasteriser.json"))
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--no-torch", action="store_true", help="time only our own rasteriser")
    options = parser.parse_args()
    machine = {
        "cpus": os.cpu_count(),
        "processor": platform.processor() or platform.machine(),
        "numba_threads": numba.get_num_threads(),
        "torch": torch.__version__,
        "numba": numba.__version__,
    }
    rows = [measure(*case, options.repeats, not options.no_torch) for case in CASES]
    text = json.dumps({"machine": machine, "cases": rows}, indent=2)
    options.out.write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
