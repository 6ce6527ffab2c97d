"""``.spz``: the splat in a tenth of the bytes, as web viewers take it (Niantic's format, version 2, gzip).

The layout: 16 bytes of header (magic, version, count, degree, fractional bits, flags, 0), then one block a property:
positions as 24-bit fixed point, opacity, colours, log scales, the vector part of the quaternions, harmonics; one
byte a number. Its axes are right, up, back, ours are right, down, forward: y and z change sign.
"""

from __future__ import annotations

import gzip
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..errors import OutputError
from .gaussian_arrays import GaussianArrays
from .ply import SH_DC
from .sh import sh_basis, sh_degree

_MAGIC, _VERSION = 0x5053474E, 2
_FLIP = np.array([1.0, -1.0, -1.0])
_COLOR_SCALE = 0.15
_FIXED_MAX = 2**23 - 1
_MOST_FRACTIONAL_BITS = 20


def write_gaussians_spz(path: Path, gaussians: GaussianArrays) -> None:
    """Write ``path``. Raises OutputError for numbers that are not finite, and for what the system refuses."""
    if not all(np.isfinite(a).all() for a in (gaussians.means, gaussians.scales, gaussians.quats)):
        raise OutputError(f"{path}: expected finite Gaussians, got some that are not")
    degree = sh_degree(gaussians.sh_rest)
    bits = _fractional_bits(gaussians.means)
    head = struct.pack("<IIIBBBB", _MAGIC, _VERSION, len(gaussians.means), degree, bits, 0, 0)
    blocks = (
        _fixed_point(gaussians.means * _FLIP, bits),
        _byte(gaussians.opacities * 255),
        _byte((gaussians.colors - 0.5) / SH_DC * _COLOR_SCALE * 255 + 127.5),
        _byte((np.log(gaussians.scales) + 10) * 16),
        _byte(_vector_part(gaussians.quats) * 127.5 + 127.5),
        _byte(gaussians.sh_rest * _sh_signs(degree)[:, None] * 128 + 128),
    )
    data = gzip.compress(head + b"".join(block.tobytes() for block in blocks), mtime=0)
    try:
        path.write_bytes(data)
    except OSError as e:
        raise OutputError(f"{path}: expected to write {len(data)} bytes, got {e}") from e


def _byte(values: Any) -> NDArray[np.uint8]:
    return np.rint(np.clip(values, 0, 255)).astype(np.uint8)


def _fractional_bits(means: Any) -> int:
    """As many bits after the point as the farthest Gaussian leaves room for."""
    far = max(float(np.abs(means).max(initial=0.0)), 1e-9)
    return int(np.clip(np.floor(np.log2(_FIXED_MAX / far)), 0, _MOST_FRACTIONAL_BITS))


def _fixed_point(positions: Any, bits: int) -> NDArray[np.uint8]:
    """(n, 3) to (n, 3, 3): little-endian signed 24-bit numbers."""
    fixed = np.clip(np.rint(positions * 2.0**bits), -_FIXED_MAX, _FIXED_MAX).astype("<i4")
    return np.ascontiguousarray(fixed[..., None].view(np.uint8)[..., :3])


def _vector_part(quats: Any) -> Any:
    """x, y, z of unit quaternions (wxyz) in the format's axes; their sign is the one that makes w positive."""
    return quats[:, 1:] * np.where(quats[:, :1] < 0, -1.0, 1.0) * _FLIP


def _sh_signs(degree: int) -> NDArray[np.float64]:
    """How each upper harmonic changes its sign where y and z do."""
    generic = torch.tensor([[0.3, 0.5, 0.8], list(np.array([0.3, 0.5, 0.8]) * _FLIP)], dtype=torch.float64)
    before, after = sh_basis(generic, degree)[:, 1:].numpy()
    return np.sign(before * after)
