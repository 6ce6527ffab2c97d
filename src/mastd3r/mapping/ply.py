"""``gaussians.ply`` in the layout that 3-D Gaussian viewers read (degree 0, binary little endian)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import InputError, OutputError
from .gaussians import GaussianArrays

SH_DC = 0.28209479177387814  # first spherical harmonic
_NAMES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
_OPACITY_EDGE = 1e-6  # logits stay finite


def write_gaussians_ply(path: Path, gaussians: GaussianArrays) -> None:
    """Means, logit opacity, log scales, wxyz rotation, f_dc = (rgb - 0.5)/SH_DC. Raises OutputError."""
    table = np.zeros(len(gaussians.means), [(name, "<f4") for name in _NAMES])
    opacity = np.clip(gaussians.opacities.astype(float), _OPACITY_EDGE, 1 - _OPACITY_EDGE)
    table["opacity"] = np.log(opacity / (1 - opacity))
    for i in range(3):
        table[_NAMES[i]] = gaussians.means[:, i]
        table[f"f_dc_{i}"] = (gaussians.colors[:, i] - 0.5) / SH_DC
        table[f"scale_{i}"] = np.log(gaussians.scales[:, i])
    for i in range(4):
        table[f"rot_{i}"] = gaussians.quats[:, i]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    lines += [f"property float {name}" for name in _NAMES]
    header = "\n".join([*lines, "end_header"]) + "\n"
    try:
        with path.open("wb") as file:
            file.write(header.encode("ascii"))
            file.write(table.tobytes())
    except OSError as e:
        raise OutputError(f"{path}: expected to write {table.nbytes} bytes, got {e}") from e


def read_gaussians_ply(path: Path) -> GaussianArrays:
    """What ``write_gaussians_ply`` wrote; ``kf_id`` is not in the file and becomes -1. Raises InputError."""
    try:
        data = path.read_bytes()
    except OSError as e:
        raise InputError(f"{path}: expected a readable .ply, got {e}") from e
    head, mark, body = data.partition(b"end_header\n")
    lines = head.decode("ascii", "replace").split("\n")
    counts = [int(line.split()[2]) for line in lines if line.startswith("element vertex ")]
    names = tuple(line.split()[2] for line in lines if line.startswith("property float "))
    if not mark or "format binary_little_endian 1.0" not in lines or len(counts) != 1 or names != _NAMES:
        raise InputError(f"{path}: expected a binary 3-D Gaussian .ply of degree 0, got another layout")
    if len(body) != counts[0] * 4 * len(_NAMES):
        raise InputError(f"{path}: expected {counts[0]} Gaussians, got {len(body)} bytes of data")
    table = np.frombuffer(body, "<f4").reshape(-1, len(_NAMES))
    return GaussianArrays(
        means=table[:, 0:3].copy(),
        scales=np.exp(table[:, 10:13]),
        quats=table[:, 13:17].copy(),
        opacities=1 / (1 + np.exp(-table[:, 9])),
        colors=table[:, 6:9] * np.float32(SH_DC) + np.float32(0.5),
        kf_id=np.full(len(table), -1, np.int32),
    )
