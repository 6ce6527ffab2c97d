"""Our splat files look in web viewers as they do in our own renderer: same place, same way up, same colours."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from mastd3r.camera.pinhole import Camera
from mastd3r.evaluation.image_error import psnr
from mastd3r.geometry.se3 import so3_exp
from mastd3r.mapping.gaussians import GaussianArrays
from mastd3r.mapping.ply import write_gaussians_ply
from mastd3r.mapping.spz import write_gaussians_spz
from viewers import show
from viewers.show import Missing, Shot, View, own_render, photograph

Array = NDArray[Any]
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

CAMERA = Camera(260.0, 250.0, 150.3, 127.8, 320, 240)  # neither square pixels nor a centred principal point
COUNT = 2000
# Decibels that each viewer must reach, about 3 below what was measured. Spark's own settings take opacity off thin
# Gaussians for the 0.3 px² that are added to them; no splat trained without that looks the same there.
LEAST_DB = {("spark", "matched"): 38.0, ("spark", "default"): 35.0, ("gaussian-splats-3d", "default"): 41.0}
TURNED_DB = 20.0  # less than this where the picture is mirrored or upside down
TURNS: dict[str, Any] = {"upside down": np.s_[::-1], "mirrored": np.s_[:, ::-1], "both": np.s_[::-1, ::-1]}


def lopsided_splat() -> GaussianArrays:
    """Turned needles and discs, half of them half transparent; no mirror image of it looks like it.

    Blue above and brown below (y is down), redder to the right, larger to the left, colours that change with the view.
    """
    rng = np.random.default_rng(3)
    means = rng.uniform([-1.6, -1.3, 2.0], [1.6, 1.3, 5.0], (COUNT, 3))
    quats = rng.normal(size=(COUNT, 4))
    right, down = (means[:, 0] + 1.6) / 3.2, (means[:, 1] + 1.3) / 2.6
    colors = np.stack([0.15 + 0.7 * right, 0.35 + 0.25 * np.sin(9 * right), 0.85 - 0.75 * down], -1)
    return GaussianArrays(
        means=means.astype(np.float32),
        scales=(rng.uniform(0.012, 0.09, (COUNT, 3)) * (1.4 - right)[:, None]).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        opacities=np.where(rng.random(COUNT) < 0.5, 0.95, rng.uniform(0.1, 0.6, COUNT)).astype(np.float32),
        colors=np.clip(colors + rng.normal(0, 0.08, (COUNT, 3)), 0.02, 0.98).astype(np.float32),
        kf_id=np.zeros(COUNT, np.int32),
        sh_rest=rng.normal(0, 0.08, (COUNT, 8, 3)).astype(np.float32),
    )


def views() -> list[View]:
    """From the origin along z; and from the side, tilted and rolled."""
    aside = np.eye(4)
    aside[:3, :3] = so3_exp(np.array([0.15, -0.45, 0.3]))
    aside[:3, 3] = 1.1, -0.6, 0.2
    return [View(np.eye(4), CAMERA, 0.2), View(aside, CAMERA, 0.2)]


@pytest.fixture(scope="module")
def splat_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with splat.ply and splat.spz."""
    folder = tmp_path_factory.mktemp("splat")
    write_gaussians_ply(folder / "splat.ply", lopsided_splat())
    write_gaussians_spz(folder / "splat.spz", lopsided_splat())
    return folder


@pytest.fixture(scope="module")
def pictures(splat_files: Path) -> dict[tuple[str, str, str], list[Array]]:
    """(viewer, settings, kind of file): what it shows from each view. One browser takes them all."""
    wanted = [(*key, kind) for key in LEAST_DB for kind in ("ply", "spz")]
    shots = [
        Shot(viewer, splat_files / f"splat.{kind}", view.in_spz() if kind == "spz" else view, settings)
        for viewer, settings, kind in wanted
        for view in views()
    ]
    try:
        taken = photograph(shots)
    except Missing as e:
        pytest.skip(f"web viewers cannot be run: {e}")
    count = len(views())
    return {key: taken[count * n : count * (n + 1)] for n, key in enumerate(wanted)}


@pytest.mark.parametrize("kind", ["ply", "spz"])
@pytest.mark.parametrize(("viewer", "settings"), LEAST_DB)
def test_a_viewer_shows_what_our_renderer_draws(
    viewer: str, settings: str, kind: str, splat_files: Path, pictures: dict[tuple[str, str, str], list[Array]]
) -> None:
    for view, theirs in zip(views(), pictures[viewer, settings, kind], strict=True):
        ours = own_render(splat_files / "splat.ply", view)
        assert theirs.shape == ours.shape
        found = psnr(ours, theirs)
        print(f"{viewer} {settings} {kind}: {found:.1f} dB")
        assert found is not None and found >= LEAST_DB[viewer, settings]
        turned = {name: psnr(ours, theirs[turn]) for name, turn in TURNS.items()}
        assert all(db is not None and db < TURNED_DB for db in turned.values()), turned


def test_a_run_is_shown_beside_our_render(splat_files: Path, tmp_path: Path) -> None:
    view, run = views()[0], tmp_path / "run"
    run.mkdir()
    (run / "gaussians.ply").write_bytes((splat_files / "splat.ply").read_bytes())
    (run / "trajectory.txt").write_text("0 0 0 0 0 0 0 1\n")
    (run / "run.json").write_text(json.dumps({"map": {"near": view.near}}))
    fields = ("fx_px", "fy_px", "cx_px", "cy_px", "width", "height")
    (run / "camera.json").write_text(json.dumps({name: getattr(CAMERA, name) for name in fields}))
    try:
        said = show.main([str(run), "--out", str(tmp_path / "shot.png")])
    except Missing as e:
        pytest.skip(f"web viewers cannot be run: {e}")
    both = np.asarray(Image.open(tmp_path / "shot.png"), np.float32) / 255
    ours, theirs = both[:, : CAMERA.width], both[:, CAMERA.width :]
    assert np.array_equal(ours, own_render(run / "gaussians.ply", view))
    assert (
        f"PSNR {psnr(ours, theirs):.1f} dB" in said and float(psnr(ours, theirs) or 0) >= LEAST_DB["spark", "matched"]
    )
