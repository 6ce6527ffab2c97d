"""gaussians.ply and .spz: as written, as read back, and as independent readers understand them."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import gsply
import numpy as np
import plyfile
import pytest
import torch
from scipy.spatial.transform import Rotation

from mastd3r.errors import InputError, OutputError
from mastd3r.mapping.gaussians import GaussianArrays
from mastd3r.mapping.ply import read_gaussians_ply, write_gaussians_ply
from mastd3r.mapping.sh import sh_colors
from mastd3r.mapping.spz import write_gaussians_spz

SH_DC = 0.28209479177387814


def random_arrays(count: int = 200, degree: int = 0, extent: float = 3.0) -> GaussianArrays:
    rng = np.random.default_rng(degree)
    quats = rng.normal(size=(count, 4))
    return GaussianArrays(
        means=rng.uniform(-extent, extent, (count, 3)).astype(np.float32),
        scales=np.exp(rng.uniform(-6, 0, (count, 3))).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        opacities=rng.uniform(0.02, 0.98, count).astype(np.float32),
        colors=rng.uniform(0, 1, (count, 3)).astype(np.float32),
        kf_id=np.full(count, -1, np.int32),
        sh_rest=rng.uniform(-0.4, 0.4, (count, (degree + 1) ** 2 - 1, 3)).astype(np.float32),
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_ply_round_trip(tmp_path: Path, degree: int) -> None:
    arrays = random_arrays(degree=degree)
    write_gaussians_ply(tmp_path / "g.ply", arrays)
    back = read_gaussians_ply(tmp_path / "g.ply")
    for name in ("means", "scales", "quats", "opacities", "colors", "sh_rest"):
        assert np.allclose(getattr(back, name), getattr(arrays, name), atol=1e-5), name


@pytest.mark.parametrize("degree", [0, 3])
def test_ply_as_gsply_reads_it(tmp_path: Path, degree: int) -> None:
    arrays = random_arrays(degree=degree)
    write_gaussians_ply(tmp_path / "g.ply", arrays)
    other = gsply.plyread(str(tmp_path / "g.ply"))
    assert np.allclose(other.means, arrays.means)
    assert np.allclose(np.exp(other.scales), arrays.scales, rtol=1e-5)
    assert np.allclose(other.quats, arrays.quats, atol=1e-6)
    assert np.allclose(1 / (1 + np.exp(-np.ravel(other.opacities))), arrays.opacities, atol=1e-6)
    assert np.allclose(other.sh0 * SH_DC + 0.5, arrays.colors, atol=1e-6)
    if degree:
        assert np.allclose(other.shN, arrays.sh_rest, atol=1e-6)


@pytest.mark.parametrize("degree", [0, 2])
def test_ply_as_plyfile_reads_it(tmp_path: Path, degree: int) -> None:
    """Column by column, by the names and meanings that viewers agree on; f_rest is channel by channel."""
    arrays = random_arrays(degree=degree)
    write_gaussians_ply(tmp_path / "g.ply", arrays)
    vertex = plyfile.PlyData.read(str(tmp_path / "g.ply"))["vertex"]

    def columns(*names: str) -> np.ndarray:
        return np.stack([np.asarray(vertex[name]) for name in names], 1)

    assert np.array_equal(columns("x", "y", "z"), arrays.means)
    assert np.allclose(np.exp(columns("scale_0", "scale_1", "scale_2")), arrays.scales, rtol=1e-5)
    assert np.allclose(columns("rot_0", "rot_1", "rot_2", "rot_3"), arrays.quats)
    assert np.allclose(1 / (1 + np.exp(-np.asarray(vertex["opacity"]))), arrays.opacities, atol=1e-6)
    assert np.allclose(columns("f_dc_0", "f_dc_1", "f_dc_2") * SH_DC + 0.5, arrays.colors, atol=1e-6)
    upper = (degree + 1) ** 2 - 1
    assert len([p for p in vertex.properties if p.name.startswith("f_rest_")]) == 3 * upper
    for channel in range(3):
        for k in range(upper):
            assert np.array_equal(vertex[f"f_rest_{channel * upper + k}"], arrays.sh_rest[:, k, channel])


def test_ply_on_a_full_disk_and_bad_files(tmp_path: Path) -> None:
    full = Path("/dev/full")
    if full.exists():
        with pytest.raises(OutputError, match="expected to write"):
            write_gaussians_ply(full, random_arrays(2000))
    with pytest.raises(OutputError):
        write_gaussians_ply(tmp_path / "missing" / "a.ply", random_arrays(5))
    with pytest.raises(InputError, match="readable"):
        read_gaussians_ply(tmp_path / "none.ply")
    (tmp_path / "bad.ply").write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    with pytest.raises(InputError, match="little-endian"):
        read_gaussians_ply(tmp_path / "bad.ply")
    write_gaussians_ply(tmp_path / "cut.ply", random_arrays(5))
    data = (tmp_path / "cut.ply").read_bytes()
    (tmp_path / "cut.ply").write_bytes(data[:-7])
    with pytest.raises(InputError, match="expected 5 vertices of"):
        read_gaussians_ply(tmp_path / "cut.ply")


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("extent", [0.5, 900.0])
def test_spz_as_gsply_reads_it(tmp_path: Path, degree: int, extent: float) -> None:
    """Within the steps of the format. Its axes are ours with y and z turned round, which gsply leaves to its user."""
    arrays = random_arrays(degree=degree, extent=extent)
    write_gaussians_spz(tmp_path / "g.spz", arrays)
    other = gsply.read_spz(str(tmp_path / "g.spz"))
    flip = np.array([1, -1, -1])
    assert np.abs(other.means * flip - arrays.means).max() <= 2e-6 * max(1, extent)
    assert np.allclose(other.scales, np.log(arrays.scales), atol=0.5 / 16 + 1e-6)
    opacity = 1 / (1 + np.exp(-np.ravel(other.opacities)))
    assert np.allclose(opacity, arrays.opacities, atol=0.51 / 255)
    assert np.allclose(other.sh0 * SH_DC + 0.5, arrays.colors, atol=0.51 / 255 / 0.15 * SH_DC)
    wxyz = np.asarray(other.quats, float)
    back = Rotation.from_quat(np.concatenate([wxyz[:, 1:] * flip, wxyz[:, :1]], 1))
    ours = Rotation.from_quat(np.concatenate([arrays.quats[:, 1:], arrays.quats[:, :1]], 1).astype(float))
    assert (back.inv() * ours).magnitude().max() < 0.2  # w comes from the other three: coarse near half a turn
    assert np.median((back.inv() * ours).magnitude()) < 0.015
    if degree:
        _same_colors_from_the_same_side(arrays, np.asarray(other.shN), flip)


def _same_colors_from_the_same_side(arrays: GaussianArrays, rest: np.ndarray, flip: np.ndarray) -> None:
    """Seen along d in our axes as along the turned d in the format's."""
    count, constant = len(arrays.means), np.zeros((len(arrays.means), 1, 3))
    directions = np.random.default_rng(5).normal(size=(count, 3))
    colors = [
        sh_colors(torch.from_numpy(np.concatenate([constant, r], 1)), torch.from_numpy(d), torch.zeros(3).double())
        for r, d in ((arrays.sh_rest.astype(float), directions), (rest.astype(float), directions * flip))
    ]
    assert (colors[0] - colors[1]).abs().max() < 0.03


def test_spz_header_and_size(tmp_path: Path) -> None:
    write_gaussians_spz(tmp_path / "g.spz", random_arrays(1000, extent=100.0))
    data = gzip.decompress((tmp_path / "g.spz").read_bytes())
    magic, version, count, degree, bits, flags, reserved = struct.unpack("<IIIBBBB", data[:16])
    assert (magic, version, count, degree, flags, reserved) == (0x5053474E, 2, 1000, 0, 0, 0)
    assert 100 * 2**bits < 2**23 <= 100 * 2 ** (bits + 1) * 1.01
    assert len(data) == 16 + 1000 * (9 + 1 + 3 + 3 + 3)


def test_spz_refuses_what_it_cannot_hold(tmp_path: Path) -> None:
    arrays = random_arrays(5)
    with pytest.raises(OutputError, match="expected to write"):
        write_gaussians_spz(tmp_path / "missing" / "g.spz", arrays)
    arrays.means[2] = np.nan
    with pytest.raises(OutputError, match="finite"):
        write_gaussians_spz(tmp_path / "g.spz", arrays)
