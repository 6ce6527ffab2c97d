"""Many videos and videos in pieces: lists, what tasks say and leave, clusters that are none."""

from __future__ import annotations

import json
import random
import shutil
import sys
import types
from functools import partial
from pathlib import Path
from typing import Any

from fuzz.case import Case, Room, kind
from fuzz.kinds_runs import replace_somewhere
from fuzz.kinds_words import short_run
from fuzz.material import NAMES, NUMBERS, VALUES, Shared, garbled, garbled_text, nasty, sparse
from helpers import blobs, give_up_rights, write_video

CODES = (0, 2, 2, 3, 99, 130, 137, 255)  # 1 would be a fault of ours
SAID = (
    *(b"mastd3r: a.mp4: expected a video, got [/x]", b"\x1b[2J\x9b", b"\xff\xfe\x00", b"", b"\n" * 50, b"x" * 100_000),
    *(b"Traceback (most recent call last):\n  File x\nValueError: 3", "mastd3r: ²\u202e".encode(), b"a\rb\n"),
)
ADDRESSES = (
    *("auto", "127.0.0.1:9", "127.0.0.1:0", "127.0.0.1:99999", "nowhere.invalid:6379", "[::1]:9", "x", "", " ", "ray://x"),
    *("http://127.0.0.1:9", "127.0.0.1", "a:b", "127.0.0.1:²", "local host:1", "[/x]:1", "a\x1b[2J:5", "n" * 5000),
)  # fmt: skip
MANY_NUMBERS = ("jobs", "memory-mib", "retries", "task-cores", "task-gpus", "segment-frames")
BATCH = {"made_by": "mastd3r batch", "options": [], "runs": []}


def _program(rng: random.Random, room: Room) -> list[str]:
    """What is run in the place of each task: says something, leaves something, ends somehow."""
    said = room.path / "said"
    said.write_bytes(rng.choice(SAID))
    leaves = rng.choice(("{}", '{"status": "complete", "command": 3}', "[" * 9000, "\x00", ""))
    (room.path / "leaves").write_text(leaves)
    script = room.path / "task.sh"
    end = rng.choice((f"exit {rng.choice(CODES)}", "kill -9 $$", "kill -15 $$"))
    script.write_text(
        '#!/bin/sh\nwhile [ $# -gt 1 ]; do [ "$1" = --out ] && out=$2; shift; done\n'
        f'mkdir -p "$out/checkpoint"; cat \'{room.path}/leaves\' > "$out/run.json"\n'
        f"cat '{room.path}/leaves' > \"$out/checkpoint/1.state\"; cat '{said}' >&2\n{end}\n"
    )
    script.chmod(0o755)
    return [str(script)]


def _tasks_are(program: list[str]) -> None:
    """Tasks of a batch, and segments, are this program."""
    from mastd3r.tasks import batch, lock

    batch.Batch.__init__.__kwdefaults__["program"] = program
    sys.executable = program[0]
    lock.LOCK_WAIT_S = 0.2


def _ray_that_is_none(program: list[str]) -> None:
    """A package ray which finds no cluster: what is asked of addresses comes before."""
    _tasks_are(program)

    def init(*_: object, **__: object) -> None:
        raise ConnectionError("[/x] no cluster\x1b[2J\nhere")

    made = types.ModuleType("ray")
    made.init, made.shutdown = init, lambda: None  # type: ignore[attr-defined]
    sys.modules["ray"] = made


def _sources(rng: random.Random, room: Room, shared: Shared) -> list[str | Path]:
    """A list, a folder of videos, sources; good ones, and what is none."""
    good = room.given / "videos"
    good.mkdir()
    for n in range(2):
        (good / f"{n}{rng.choice(('', '[', ' x'))}.mp4").write_bytes(shared.video)
    listed = room.given / "list.txt"
    which = rng.randrange(6)
    names = [str(p) for p in good.iterdir()] + [rng.choice(NAMES) for _ in range(rng.choice((0, 1, 3)))]
    text = "\n".join(["# videos", *names]).encode("utf-8", "surrogateescape")
    if which == 0:
        nasty(rng, listed, text)
    elif which == 1:
        listed.write_bytes(garbled(rng, text))
    elif which == 2:
        listed.write_text(garbled_text(rng, "\n".join(names[:2])), errors="replace", newline="")
    elif which == 3:
        sparse(listed, text)
    elif which == 4:
        listed.write_bytes(text if rng.random() < 0.5 else b"x\n" * 30_000)
    else:
        return [rng.choice((good, room.given, *NAMES, "/dev/zero", "", "-")) for _ in range(rng.choice((1, 3)))]
    return [listed, *([good] if rng.random() < 0.2 else [])]


@kind("batches", 50)
def batches(rng: random.Random, room: Room, shared: Shared) -> Case:
    """Lists of sources; a folder that has another batch's record; tasks that end in every way."""
    sources = _sources(rng, room, shared)
    if rng.random() < 0.3:
        room.out.mkdir()
        record: Any = json.loads(json.dumps(BATCH))
        record["runs"] = [{"name": "0", "source": str(room.given / "videos/0.mp4"), "state": "complete", "wall_s": 1}]
        replace_somewhere(rng, record)
        (room.out / "batch.json").write_text(json.dumps(record if rng.random() < 0.8 else rng.choice(VALUES)))
        if rng.random() < 0.3:
            nasty(rng, room.out / rng.choice(("batch.json", "logs", "0", "1", ".lock")))
    options: list[str] = []
    if rng.random() < 0.3:
        options += [f"--{rng.choice(MANY_NUMBERS[:5])}={rng.choice(NUMBERS)}"]
    if rng.random() < 0.2:
        options += [
            f"--{rng.choice(('seed', 'scale', 'intrinsics', 'set', 'config'))}={rng.choice((*NUMBERS, *NAMES))}"
        ]
    words: list[str | Path] = ["batch", "--out", room.out, "--no-map", "--retries=1", *options, "--", *sources]
    return Case(words, partial(_tasks_are, _program(rng, room)))


@kind("clusters", 25)
def clusters(rng: random.Random, room: Room, shared: Shared) -> Case:
    """--ray with addresses at which no cluster is, and what is asked of its nodes."""
    video = room.given / "a.mp4"
    video.write_bytes(shared.video)
    options = [f"--ray={rng.choice(ADDRESSES)}"]
    options += [f"--{rng.choice(MANY_NUMBERS)}={rng.choice(NUMBERS)}"] if rng.random() < 0.4 else []
    options = [o for o in options if "segment" not in o]
    return Case(
        ["batch", "--out", room.out, "--no-map", *options, "--", video], partial(_ray_that_is_none, _program(rng, room))
    )


@kind("segments", 25)
def segments(rng: random.Random, room: Room, shared: Shared) -> Case:
    """run --segment-frames, whose pieces are tracked by something that leaves nonsense."""
    if rng.random() < 0.4:
        number = f"--{rng.choice(MANY_NUMBERS)}={rng.choice(NUMBERS)}"
        words = short_run(room, shared, "--segment-frames=60", number)
        return Case(words, partial(_tasks_are, _program(rng, room)))
    video = write_video(room.given / "long.mp4", blobs(2) * 100)
    if rng.random() < 0.3:
        (room.out / "segments").mkdir(parents=True)
        nasty(rng, room.out / "segments" / rng.choice(("x", "000", "config.yaml")))
    words = [
        "run",
        video,
        "--out",
        room.out,
        "--no-map",
        "--quiet",
        f"--segment-frames={rng.choice(('60', '100', '99999'))}",
    ]
    if words[-1].endswith("99999"):
        words = [*words, "--end=1"]
    return Case(words, partial(_tasks_are, _program(rng, room)))


@kind("files that go", 20)
def files_that_go(rng: random.Random, room: Room, shared: Shared) -> Case:
    """What is read disappears, or becomes something else, once the run has begun."""
    going = room.path / "going"
    going.mkdir()
    for n in range(4):
        (going / f"{n}.png").write_bytes(shared.pictures[0])
    video = room.path / "going.mp4"
    video.write_bytes(shared.video)
    source = rng.choice((going, going, video))
    how = rng.randrange(4)
    seed = rng.randrange(10**6)
    end = ["--end=1"] if shared.quick else []
    return Case(["run", source, "--out", room.out, "--no-map", "--quiet", *end], partial(_goes, source, how, seed))


def _goes(source: Path, how: int, seed: int) -> None:
    """After the source was opened, before its frames are read."""
    from mastd3r import pipeline

    opened = pipeline.open_source

    def then_gone(*args: Any, **kwargs: Any) -> Any:
        found = opened(*args, **kwargs)
        paths = sorted(source.iterdir())[-3:] if source.is_dir() else [source]
        if how == 0:
            shutil.rmtree(source) if source.is_dir() else source.unlink()
        for path in paths if how else []:
            data = path.read_bytes()
            path.unlink()
            if how == 2:
                nasty(random.Random(seed), path, data)
            elif how == 3:
                path.write_bytes(data[: len(data) // 2])
        return found

    pipeline.open_source = then_gone


@kind("no right to read", 20)
def no_right_to_read(rng: random.Random, room: Room, shared: Shared) -> Case:
    """Files and folders of mode 0, for somebody who may not read everything."""
    locked = room.path / "locked"
    locked.mkdir()
    inner = locked / "inner"
    inner.mkdir()
    for n in range(3):
        (inner / f"{n}.png").write_bytes(shared.pictures[0])
    (locked / "v.mp4").write_bytes(shared.video)
    (locked / "c.yaml").write_text("seed: 1\n")
    run = Path(shutil.copytree(shared.run, locked / "run"))
    shut = rng.choice(
        (inner, inner / "1.png", locked / "v.mp4", locked / "c.yaml", run, run / "run.json", run / "cloud.ply", locked)
    )
    out: Path = rng.choice((room.out, room.out, inner / "out"))
    quick = ["--end=1"] if shared.quick else []
    words: list[list[str | Path]] = [
        ["run", inner, "--out", out, "--no-map", "--quiet", *quick],
        ["run", locked / "v.mp4", "--out", out, "--no-map", "--quiet", *quick],
        ["run", locked, "--out", out, "--no-map", "--quiet", *quick],
        ["run", inner, "--out", out, "--no-map", "--quiet", "--end=1", "--config", locked / "c.yaml"],
        ["run", inner, "--out", out, "--no-map", "--quiet", "--end=1", "--maps", locked / "inner"],
        ["batch", locked, "--out", out, "--no-map"],
        ["eval", run, inner],
        ["export", run, "--to", rng.choice(("tum", "colmap")), "--out", out, "--quiet"],
        ["resume", run, "--quiet"],
        ["scale", run, "factor=2"],
        ["save", run, "--map", out],
        ["localise", locked, inner, "--out", out],
        ["weights", "check", locked],
    ]
    return Case(rng.choice(words), partial(_shut, shut, _program(rng, room)))


def _shut(path: Path, program: list[str]) -> None:
    _tasks_are(program)
    path.chmod(0)
    give_up_rights()
