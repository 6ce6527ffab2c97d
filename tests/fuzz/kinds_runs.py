"""Run folders that were damaged, and files of other programs in their place."""

from __future__ import annotations

import copy
import json
import os
import random
import shutil
from pathlib import Path
from typing import Any

from fuzz.case import Case, Room, kind
from fuzz.material import NUMBERS, VALUES, Shared, garbled, garbled_text, nasty
from mastd3r.export.kinds import KINDS as FORMATS

WEIGHTED = ("run.json",) * 3 + (
    "camera.json",
    "camera.json",
    "trajectory.txt",
    "metrics.json",
    "config.yaml",
    "cloud.ply",
    "gaussians.ply",
    "tracks.npz",
    "keyframes.txt",
    "report.html",
)
DRAWN = ("flight", "depth", "plates", "mesh", "cloud")  # formats that need kernels
HEADER_WORDS = ("vertex 10", "vertex -1", "vertex 99999999999", "vertex x", "vertex 0", "vertex nan", "vertex ²")
PROPERTIES = (
    "property double x",
    "property list uchar int x",
    "property float",
    "property nothing x",
    "property float x y",
    "property uchar z",
)


def commands_on(rng: random.Random, run: Path, room: Room, shared: Shared) -> list[str | Path]:
    """One of the commands that read a run folder."""
    form = rng.choice(tuple(f for f in FORMATS if not (shared.quick and f in DRAWN)))
    photos = shared.run.parent / "photos"
    suffix = {"flight": ".mp4", "mesh": ".ply", "cloud": ".ply", "spz": ".spz"}.get(form, "")
    words: list[list[str | Path]] = [
        ["export", run, "--to", form, "--out", room.path / f"exported{suffix}", "--quiet"],
        ["export", run, "--to", form, "--out", room.path / f"exported{suffix}", "--quiet"],
        [
            "export",
            run,
            "--to",
            rng.choice(("colmap", "nerfstudio", "spz", "tum", "ros")),
            "--out",
            room.path / "x",
            "--quiet",
        ],
        ["eval", run, photos],
        ["view", run],
        ["resume", run, "--quiet"],
        ["map", run, "--minutes", "nan" if shared.quick else "0.001", "--quiet"],
        ["run", shared.one_image, "--out", run, "--no-map", "--quiet"],
    ]
    return rng.choice(words)


def copied(room: Room, shared: Shared) -> Path:
    """A good run that a command may write in."""
    return Path(shutil.copytree(shared.run, room.path / "run"))


@kind("records", 130)
def records(rng: random.Random, room: Room, shared: Shared) -> Case:
    """run.json, camera.json, metrics.json with values of other types and other sizes."""
    run = copied(room, shared)
    if rng.random() < 0.3:
        record = json.loads((run / "run.json").read_text())
        record |= {"status": rng.choice(("running", "incomplete", 3)), "reason": "x"}
        (run / "run.json").write_text(json.dumps(record))
    for name in rng.sample(("run.json", "camera.json", "metrics.json"), rng.choice((1, 1, 2))):
        data: Any = json.loads((run / name).read_text())
        for _ in range(rng.choice((1, 1, 3))):
            replace_somewhere(rng, data)
        (run / name).write_text(json.dumps(data if rng.random() < 0.95 else rng.choice(VALUES)))
    return Case(commands_on(rng, run, room, shared))


def replace_somewhere(rng: random.Random, data: Any) -> None:
    """Another value in the place of one in an object or list, at any depth."""
    while True:
        keys = list(data) if isinstance(data, dict) else list(range(len(data)))
        if not keys:
            return
        key = rng.choice(keys)
        if isinstance(data[key], dict | list) and data[key] and rng.random() < 0.6:
            data = data[key]
            continue
        if rng.random() < 0.15:
            del data[key]
        else:
            data[key] = copy.deepcopy(rng.choice(VALUES))
        return


@kind("run files", 130)
def run_files(rng: random.Random, room: Room, shared: Shared) -> Case:
    """Any file of a run cut, flipped, replaced by something else or gone."""
    run = copied(room, shared)
    everything = [p.relative_to(run).as_posix() for p in run.rglob("*") if p.is_file()]
    for name in rng.sample(WEIGHTED, rng.choice((1, 1, 2))) if rng.random() < 0.85 else [rng.choice(everything)]:
        path = run / name
        data = path.read_bytes() if path.is_file() and not path.is_symlink() else b""
        which = rng.randrange(5)
        if which == 0:
            nasty(rng, path, data)
        elif which == 1 and path.suffix in (".txt", ".json", ".yaml"):
            text = garbled_text(rng, data.decode("utf-8", "replace"))
            path.write_text(text, encoding="utf-8", errors="replace", newline="")
        elif which == 2:
            path.unlink(missing_ok=True)
        elif data:
            path.write_bytes(garbled(rng, data))
    return Case(commands_on(rng, run, room, shared))


@kind("ply headers", 60)
def ply_headers(rng: random.Random, room: Room, shared: Shared) -> Case:
    run = copied(room, shared)
    name = rng.choice(("cloud.ply", "gaussians.ply"))
    head, end, body = (run / name).read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    which = rng.randrange(5)
    n = rng.randrange(3, len(lines))
    if which == 0:
        lines = [f"element {rng.choice(HEADER_WORDS)}" if line.startswith("element") else line for line in lines]
    elif which == 1:
        lines[n] = rng.choice(PROPERTIES)
    elif which == 2:
        lines.insert(
            n, rng.choice((lines[n], "element face 3", "comment \x1b[2J", "property float extra", "obj_info x", ""))
        )
    elif which == 3:
        lines[rng.randrange(3)] = rng.choice(
            ("ply2", "format ascii 1.0", "format binary_big_endian 1.0", "element vertex", "element")
        )
    else:
        floats = bytearray(body)
        for _ in range(20):
            at = rng.randrange(len(floats) // 4) * 4
            floats[at : at + 4] = rng.choice((b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\xff\xff\x7f\x7f", b"\0\0\x80\xff"))
        body = bytes(floats)
    (run / name).write_bytes("\n".join(lines).encode() + b"\n" + end + body)
    forms = (
        ("colmap", "nerfstudio")
        if name == "cloud.ply"
        else ("spz", *(() if shared.quick else ("flight", "depth", "plates")))
    )
    words: list[str | Path] = ["export", run, "--to", rng.choice(forms), "--out", room.path / "exported", "--quiet"]
    if rng.random() < 0.2 and not shared.quick:
        words = ["map", run, "--minutes", "0.001", "--quiet"]
    return Case(words)


@kind("stopped runs", 30)
def stopped_runs(rng: random.Random, room: Room, shared: Shared) -> Case:
    """resume, of a folder whose record, options or checkpoint are damaged."""
    run = copied(room, shared)
    record = json.loads((run / "run.json").read_text()) | {"status": "incomplete", "reason": "stopped"}
    record["source"] = rng.choice(
        (record["source"], *VALUES, {"path": rng.choice((*VALUES, *NUMBERS)), "maps": rng.choice(VALUES)})
    )
    (run / "run.json").write_text(json.dumps(record))
    checkpoint = run / "checkpoint"
    checkpoint.mkdir()
    for name in ("a.pickle", "latest", "state.bin", "arrays-0.bin", "checkpoint.json"):
        if rng.random() < 0.5:
            nasty(rng, checkpoint / name, os.urandom(0) + b"\x80\x04cos\nsystem\n")
    if rng.random() < 0.5:
        text = (run / "config.yaml").read_text()
        (run / "config.yaml").write_text(garbled_text(rng, text), errors="replace")
    return Case(["resume", run, "--quiet"])
