"""Saved maps that were damaged, made up or are something else: to localise, to save and to run --map."""

from __future__ import annotations

import io
import json
import os
import random
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from fuzz.case import Case, Room, kind
from fuzz.kinds_runs import replace_somewhere
from fuzz.material import NUMBERS, VALUES, Shared, garbled, garbled_text, nasty, npy_of, sparse

EXTREMES = (0.0, -1.0, 1e-300, 1e-30, 1e30, 1e300, 5e-324, float("nan"), float("inf"), -float("inf"))
SHAPES = ((), (0,), (1,), (10**10,), (2, 10**9), (48, 64, 3), (-1, 4))
TYPES = ("<f8", "<f4", "|u1", "<f2", "|O", "<U9", "<c16", "|b1", ">f8")
LENS_KEYS = ("fx_px", "fy_px", "cx_px", "cy_px", "width", "height", "k1", "k2", "k3")
LENSES = ("70", "0", "-1", "nan", "1e9", "70,70,31.5,23.5", "70,70,31.5,23.5,-5,80", "1,1,1e9,1", "x", "")


def _values(rng: random.Random, folder: Path) -> None:
    """map.json and camera.json with values of other types and sizes."""
    path = folder / rng.choice(("map.json", "map.json", "camera.json"))
    data: Any = json.loads(path.read_text())
    for _ in range(rng.choice((1, 1, 3))):
        replace_somewhere(rng, data)
    path.write_text(json.dumps(data if rng.random() < 0.95 else rng.choice(VALUES)))


def _files(rng: random.Random, folder: Path) -> None:
    """Any file cut, flipped, replaced by something else or gone; others beside them."""
    everything = sorted(p for p in folder.rglob("*") if p.is_file())
    path = rng.choice(everything)
    which = rng.randrange(5)
    if which == 0:
        path.unlink()
    elif which == 1:
        nasty(rng, path, path.read_bytes())
    elif which == 2 and path.suffix in (".json", ".yaml"):
        text = garbled_text(rng, path.read_text())
        path.write_text(text, encoding="utf-8", errors="replace", newline="")
    elif which == 3:
        nasty(rng, folder / rng.choice(("gaussians.ply", "keyframes/000003.npz", "x", "keyframes/x")))
    else:
        path.write_bytes(garbled(rng, path.read_bytes()))


def _arrays(rng: random.Random, folder: Path) -> None:
    """A keyframe with arrays of another type, size or content, or a file of zip that says what is not so."""
    path = rng.choice(sorted((folder / "keyframes").iterdir()))
    arrays = dict(np.load(path))
    name = rng.choice(tuple(arrays))
    made = {n: _npy(a) for n, a in arrays.items()}
    which = rng.randrange(5)
    if which == 0:
        made[name] = npy_of(rng.choice(SHAPES), rng.choice(TYPES), rng.randbytes(rng.choice((0, 100))))
    elif which == 1 and arrays[name].dtype.kind == "f" and arrays[name].size:
        changed = arrays[name].copy()
        with np.errstate(over="ignore"):
            changed.flat[:: rng.choice((1, 7, changed.size))] = rng.choice(EXTREMES)
        made[name] = _npy(changed)
    elif which == 2:
        del made[name]
    elif which == 3:
        made[name] = _npy(rng.choice((arrays[name][:-1], arrays[name][None], arrays[name].astype(np.float64))))
    else:
        made[name] = garbled(rng, made[name])
    with zipfile.ZipFile(path, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for n, data in made.items():
            archive.writestr(f"{n}.npy", data)


def _npy(array: Any) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def _numbers(rng: random.Random, folder: Path) -> None:
    """What each by itself is a number of a map, and together none: lengths, depths, lenses, sizes of cells."""
    which = rng.randrange(5)
    record = json.loads((folder / "map.json").read_text())
    if which == 0:
        size = rng.choice((1e-12, 1e-3, 1e6, 9e8))
        for row in record["keyframes"]:
            for n in range(3):
                row["world_from_cam"][n][3] *= size
    elif which == 1:
        record["grid"] = rng.choice(([1, 1], [48, 64], [4, 7], [2, 3], [10**4, 1]))
    elif which == 2:
        record["keyframes"] = record["keyframes"] * rng.choice((2, 40000)) if rng.random() < 0.5 else []
    elif which == 3:
        lens = json.loads((folder / "camera.json").read_text())
        lens[rng.choice(LENS_KEYS)] = rng.choice((0, 1, -3, 64, 10**5, 0.5, 1e-3, 400000, 65535))
        lens["distortion"] = rng.choice((lens["distortion"], [9, -9, 9, 9], [0.1] * 8, [-1e3] * 5, [0] * 9))
        (folder / "camera.json").write_text(json.dumps(lens))
    else:
        (folder / "config.yaml").write_text(
            f"tracking:\n  {rng.choice(('area_px', 'cell_px'))}: {rng.choice((*NUMBERS, '1', '7', '100'))}\n"
            f"features: {rng.choice(('orb', 'auto', 'xfeat', 'nothing'))}\n"
        )
    (folder / "map.json").write_text(json.dumps(record))


DAMAGES: tuple[Callable[[random.Random, Path], None], ...] = (_values, _values, _files, _files, _arrays, _numbers)


def _foreign(rng: random.Random, folder: Path, shared: Shared) -> None:
    """Something else in its place."""
    shutil.rmtree(folder)
    which = rng.randrange(5)
    if which == 0:
        nasty(rng, folder)
    elif which == 1:
        shutil.copytree(shared.run, folder)
    elif which == 2:
        folder.mkdir()
        (folder / "map.json").write_text(json.dumps(rng.choice(VALUES)))
    elif which == 3:
        folder.symlink_to(rng.choice((folder, Path("/"), Path("/dev/zero"), Path("nowhere"))))
    else:
        folder.mkdir()
        sparse(folder / "map.json", b'{"made_by": "mastd3r save", "version": 1, "keyframes": [')


def _pictures(rng: random.Random, room: Room, shared: Shared) -> Path:
    """What is looked for: pictures of one colour where nothing may be tracked."""
    if not shared.quick:
        return rng.choice((shared.run.parent / "photos", shared.run.parent / "photos", shared.one_image))
    folder = room.given / "pictures"
    folder.mkdir()
    for n in range(2):
        Image.new("RGB", (64, 48), (90, 90, 90)).save(folder / f"{n}.png")
    return folder


@kind("saved maps", 60)
def saved_maps(rng: random.Random, room: Room, shared: Shared) -> Case:
    """A map in one of these states, given to one of the commands that read maps."""
    folder = Path(shutil.copytree(shared.map, room.given / "map"))
    if rng.random() < 0.15:
        _foreign(rng, folder, shared)
    else:
        for _ in range(rng.choice((1, 1, 2))):
            if (folder / "map.json").is_file() and (folder / "map.json").stat().st_size < 10**6:
                _damaged(rng, folder)
    source = _pictures(rng, room, shared)
    lens = ["--intrinsics", rng.choice(LENSES)] if rng.random() < 0.25 else []
    command = rng.choice(("localise", "run", "run", "save"))
    if command == "localise":
        return Case(["localise", folder, source, "--out", room.out, "--quiet", *lens])
    if command == "run":
        extra: list[str | Path] = rng.choice(([], [], ["--scale", "factor=2"], ["--end", "1"], ["--stride", "2"]))
        return Case(["run", source, "--map", folder, "--out", room.out, "--no-map", "--quiet", *lens, *extra])
    run = Path(shutil.copytree(shared.run, room.path / "run"))
    record = json.loads((run / "run.json").read_text())
    record["continues"] = {"map": os.fspath(folder), "found": True, "digest": shared.map_digest}
    if rng.random() < 0.3:
        replace_somewhere(rng, record["continues"])
    (run / "run.json").write_text(json.dumps(record, default=str))
    return Case(["save", run, "--map", room.out, "--quiet"])


def _damaged(rng: random.Random, folder: Path) -> None:
    try:
        rng.choice(DAMAGES)(rng, folder)
    except (OSError, ValueError, KeyError, TypeError, IndexError, zipfile.BadZipFile):
        shutil.rmtree(folder / "keyframes", ignore_errors=True)  # damaged beyond what can be damaged more
