"""``gaussians.ply`` in the layout that 3-D Gaussian viewers read (binary little endian)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import InputError, OutputError
from ..reading.ply import FARTHEST, read_vertices
from .gaussian_arrays import GaussianArrays

SH_DC = 0.28209479177387814  # first spherical harmonic
_OF_REST = {0: 0, 9: 3, 24: 8, 45: 15}  # number of f_rest columns -> upper coefficients a channel
MOST_LOG_SCALE, SHORTEST = 40.0, 1e-6  # of what a splat may say
_OPACITY_EDGE = 1e-6  # logits stay finite


def _names(rest: int) -> tuple[str, ...]:
    """Columns of a file with ``rest`` columns of upper spherical harmonics."""
    return (
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{i}" for i in range(rest)),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    )


def write_gaussians_ply(path: Path, gaussians: GaussianArrays) -> None:
    """Means, logit opacity, log scales, wxyz rotation, f_dc = (rgb - 0.5)/SH_DC. Raises OutputError.

    f_rest holds the upper spherical harmonics, all of red, then green, then blue; none at degree 0.
    """
    rest = gaussians.sh_rest.transpose(0, 2, 1).reshape(len(gaussians.means), -1)
    names = _names(rest.shape[1])
    table = np.zeros(len(gaussians.means), [(name, "<f4") for name in names])
    opacity = np.clip(gaussians.opacities.astype(float), _OPACITY_EDGE, 1 - _OPACITY_EDGE)
    table["opacity"] = np.log(opacity / (1 - opacity))
    for i in range(3):
        table["xyz"[i]] = gaussians.means[:, i]
        table[f"f_dc_{i}"] = (gaussians.colors[:, i] - 0.5) / SH_DC
        table[f"scale_{i}"] = np.log(gaussians.scales[:, i])
    for i in range(4):
        table[f"rot_{i}"] = gaussians.quats[:, i]
    for i in range(rest.shape[1]):
        table[f"f_rest_{i}"] = rest[:, i]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    lines += [f"property float {name}" for name in names]
    header = "\n".join([*lines, "end_header"]) + "\n"
    try:
        with path.open("wb") as file:
            file.write(header.encode("ascii"))
            file.write(table.tobytes())
    except OSError as e:
        raise OutputError(f"{path}: expected to write {table.nbytes} bytes, got {e}") from e


def _check_numbers(table: np.ndarray, path: Path) -> None:
    """Raise InputError for Gaussians that cannot be drawn."""
    for name in table.dtype.names or ():
        most = MOST_LOG_SCALE if name.startswith("scale_") else FARTHEST
        wrong = np.flatnonzero(~(np.abs(table[name]) < most))
        if len(wrong):
            n = int(wrong[0])
            raise InputError(f"{path} vertex {n}: expected {name} within {most:g}, got {table[name][n]:g}")
    turns = np.stack([table[f"rot_{i}"] for i in range(4)], 1)
    if len(turns) and not np.abs(turns).max(1).min() > SHORTEST:
        raise InputError(f"{path}: expected rotations, got a quaternion of length 0")


def read_gaussians_ply(path: Path) -> GaussianArrays:
    """What ``write_gaussians_ply`` wrote; ``kf_id`` is not in the file and becomes -1. Raises InputError."""
    table = read_vertices(path)
    names = table.dtype.names or ()
    rest = sum(name.startswith("f_rest_") for name in names)
    if rest not in _OF_REST or table.dtype != np.dtype([(name, "<f4") for name in _names(rest)]):
        raise InputError(f"{path}: expected a binary 3-D Gaussian .ply, got another layout")
    _check_numbers(table, path)

    def columns(*wanted: str) -> np.ndarray:
        return np.stack([table[name] for name in wanted], 1) if wanted else np.zeros((len(table), 0), np.float32)

    upper = columns(*(f"f_rest_{i}" for i in range(rest))).reshape(len(table), 3, _OF_REST[rest])
    return GaussianArrays(
        means=columns("x", "y", "z"),
        scales=np.exp(columns("scale_0", "scale_1", "scale_2")),
        quats=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        opacities=1 / (1 + np.exp(-table["opacity"])),
        colors=columns("f_dc_0", "f_dc_1", "f_dc_2") * np.float32(SH_DC) + np.float32(0.5),
        kf_id=np.full(len(table), -1, np.int32),
        sh_rest=np.ascontiguousarray(upper.transpose(0, 2, 1)),
    )
