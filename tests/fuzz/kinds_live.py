"""Cameras that are none, streams that break, pipes and bags of something else; and what live runs keep, damaged."""

from __future__ import annotations

import io
import json
import os
import random
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from fuzz.case import Case, Room, kind
from fuzz.kinds_download import ANSWERS, free_port, serve
from fuzz.kinds_runs import copied, replace_somewhere
from fuzz.material import NAMES, NUMBERS, VALUES, Shared, garbled, garbled_text, nasty
from helpers import blobs

FRAME_PX = (64, 48)
Y4M_WORDS = ("W64", "H48", "F30:1", "C420", "Cmono", "Ip", "A1:1", "XYSCSS=420")
DEVICES = (
    *("/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/stdin", "/dev/fd/0", "/dev/tty", "/dev/mem"),
    *("77", "9" * 400, "00", "2147483648", "²", "/dev/../etc/passwd", "/dev/[/x]", "/dev/a\x1b[2J", "/dev/x\0y"),
)
URLS = (
    *("rtsp://127.0.0.1:{port}/x", "http://127.0.0.1:{port}/x.ts", "http://127.0.0.1:{port}/[/x]\x1b[2J", "tcp://127.0.0.1:{port}"),
    *("http://me:secret@127.0.0.1:{port}/x", "http://[", "http://", "://", "x://y", "ftp://127.0.0.1:{port}/x"),
    *("file:///etc/passwd", "file:///dev/zero", "file:///proc/self/mem", "pipe://0", "fd://0", "concat://a|b", "crypto://x"),
    *("rtp://127.0.0.1:{port}", "udp://127.0.0.1:{port}", "unix:///x", "rtsp://127.0.0.1:99999/x", "hls://127.0.0.1/x"),
    *("http://nowhere.invalid/x", "rtmp://127.0.0.1:{port}/a/b", "http://127.0.0.1:{port}/" + "n" * 5000, "gopher://x"),
)  # fmt: skip
LIVE_NUMBERS = ("seconds", "fps", "pace", "timeout", "reconnect", "start", "end", "stride")
SIZES = (
    "64x48",
    "0x0",
    "1x1",
    "-1x5",
    "16384x16384",
    "99999x99999",
    "64",
    "x",
    "64x48x3",
    "²x²",
    "1e3x2",
    "",
    "40x16384",
)
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


def _reads(file: Path) -> None:
    """Standard input is this file."""
    os.dup2(os.open(file, os.O_RDONLY), 0)
    sys.stdin = io.TextIOWrapper(io.FileIO(0, closefd=False))


def _live(camera: str | Path, room: Room, *words: str | Path) -> list[str | Path]:
    return ["live", "--out", room.out, "--no-map", "--quiet", *words, "--", camera]


@kind("pipes", 40)
def pipes(rng: random.Random, room: Room, shared: Shared) -> Case:
    """Raw frames and y4m that are cut, lie about their size, or are something else."""
    count = 1 if shared.quick else rng.choice((1, 3, 12))
    images = [np.full_like(i, 90) for i in blobs(count, *FRAME_PX)] if shared.quick else blobs(count, *FRAME_PX)
    file, options = room.given / "frames", list[str | Path]()
    if rng.random() < 0.5:
        words = [w for w in Y4M_WORDS if rng.random() < 0.8]
        if rng.random() < 0.5:
            words[rng.randrange(len(words))] = rng.choice(("W", "H", "F", "C")) + rng.choice(
                (*NUMBERS, *NAMES[:8], "1:0", "0:1")
            )
        head = " ".join(["YUV4MPEG2", *words]).encode("utf-8", "surrogateescape") + rng.choice((b"\n", b"\r\n", b""))
        body = b"".join(b"FRAME\n" + rng.randbytes(64 * 48 * 3 // 2) for _ in images)
        file.write_bytes(garbled(rng, head + body) if rng.random() < 0.4 else head + body)
    else:
        file.write_bytes(b"".join(i.tobytes() for i in images)[: rng.choice((None, 0, 1, 5000))])
        options += [f"--size={rng.choice(SIZES)}"]
        options += [f"--pixel-format={rng.choice(('bgr24', 'rgb24', 'gray8', 'yuv'))}"] if rng.random() < 0.4 else []
    if rng.random() < 0.3:
        options += [f"--{rng.choice(('fps', 'seconds', 'timeout'))}={rng.choice(NUMBERS)}"]
    return Case(_live("-", room, *options), partial(_reads, file))


@kind("cameras", 40)
def cameras(rng: random.Random, room: Room, shared: Shared) -> Case:
    """Devices, addresses and paths at which no camera is; options out of their range."""
    what: str | Path = rng.choice((*DEVICES, *NAMES, *URLS, str(room.given), "", "-")).replace("{port}", "9")
    if rng.random() < 0.3:
        what = room.given / "there"
        nasty(rng, what, shared.video)
    name = rng.choice(LIVE_NUMBERS)
    options = [f"--{name}={rng.choice(NUMBERS)}"] if rng.random() < 0.5 else ["--timeout=1", "--end=1"]
    if rng.random() < 0.3:
        options += [f"--topic={rng.choice(NAMES)}"]
    return Case(_live(what, room, *options))


@kind("streams", 30)
def streams(rng: random.Random, room: Room, shared: Shared) -> Case:
    """A server whose answers are no video, or one that breaks."""
    seed = rng.randrange(10**6)
    port = free_port()
    which = rng.randrange(3)
    answer = rng.choice(ANSWERS) if which < 2 else _broken_video(rng, shared)
    url = rng.choice(URLS[:5]).format(port=port) if which < 2 else f"http://127.0.0.1:{port}/x.mp4"
    options = ["--timeout=1", f"--reconnect={rng.choice(('0.2', '0.2', *NUMBERS))}"]

    def prepare() -> None:
        serve(answer, port, seed)

    return Case(_live(url, room, *options), prepare)


def _broken_video(rng: random.Random, shared: Shared) -> Callable[[int, random.Random], bytes]:
    data = garbled(rng, shared.video)
    head = f"HTTP/1.1 200 OK\r\nContent-Type: video/mp4\r\nContent-Length: {len(data)}\r\nConnection: close\r\n\r\n"
    return lambda port, rng: head.encode() + data


@kind("bags", 30)
def bags(rng: random.Random, room: Room, shared: Shared) -> Case:
    """ROS bags that were damaged, and images in them that are not what they say."""
    folder = room.given / "bag"
    store: Any = get_typestore(Stores.ROS2_HUMBLE)
    image = blobs(1, *FRAME_PX)[0]
    plugin = rng.choice((StoragePlugin.MCAP, StoragePlugin.SQLITE3))
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        for topic in rng.sample(("/a", "/b\x1b[2J", "/[red]"), rng.choice((1, 1, 1, 2))):
            message, name = _message(rng, store, image)
            connection = writer.add_connection(topic, name, typestore=store)
            for n in range(1 if shared.quick else rng.choice((1, 4))):
                data = bytes(store.serialize_cdr(message, name))
                writer.write(connection, 10**9 * n, garbled(rng, data) if rng.random() < 0.3 else data)
    files = sorted(p for p in folder.iterdir() if p.is_file())
    path = rng.choice(files)
    which = rng.randrange(4)
    if which == 0:
        nasty(rng, path, path.read_bytes(), 2**26)
    elif which == 1:
        path.write_bytes(garbled(rng, path.read_bytes()))
    elif which == 2 and path.suffix == ".yaml":
        path.write_text(garbled_text(rng, path.read_text()), encoding="utf-8", errors="replace", newline="")
    given = rng.choice((folder, folder, *(p for p in files if p.suffix != ".yaml")))
    options = [f"--topic={rng.choice(('/a', '/[red]', *NAMES[:6]))}"] if rng.random() < 0.4 else []
    return Case(_live(given, room, *options))


def _message(rng: random.Random, store: Any, image: Any) -> tuple[Any, str]:
    """An image message; most say of themselves what is not so."""
    types = store.types
    head = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](5, rng.choice((0, 10**9, 4 * 10**9))), "c")
    if rng.random() < 0.3:
        data = rng.choice((shared_bytes := image.tobytes(), rng.randbytes(50), b"", b"\x89PNG" + shared_bytes[:50]))
        form = rng.choice(("png", "jpeg", "[/x]\x1b[2J", ""))
        return types[COMPRESSED](head, form, np.frombuffer(data, np.uint8)), COMPRESSED
    encoding = rng.choice(("rgb8", "bgr8", "mono8", "16UC1", "bayer_rggb8", "[/x]\x1b[2J", ""))
    width, height, step = rng.choice(
        ((64, 48, 192), (64, 48, 0), (2**31, 2**31, 5), (0, 0, 0), (1, 1, 3), (4000, 2, 12000))
    )
    return types[IMAGE](head, height, width, encoding, 0, step, image.ravel()), IMAGE


@kind("live folders", 30)
def live_folders(rng: random.Random, room: Room, shared: Shared) -> Case:
    """finish, of a live run whose record, options or recorded frames are damaged."""
    run = copied(room, shared)
    record: dict[str, Any] = json.loads((run / "run.json").read_text())
    record |= {
        "live": {"recorded": True, "camera": "x"},
        "timings_s": {},
        "status": rng.choice(("complete", "incomplete", 3)),
    }
    if rng.random() < 0.4:
        replace_somewhere(rng, record)
    if rng.random() < 0.2:
        record["live"] = rng.choice(VALUES)
    (run / "run.json").write_text(json.dumps(record))
    recorded = run / "recorded"
    recorded.mkdir()
    rows = []
    for n in range(1 if shared.quick else 3):
        name = f"{n / 30:.6f}.png"
        (recorded / name).write_bytes(shared.pictures[0])
        rows.append(f"{n / 30:.6f} {name}")
    listed = "\n".join(["# timestamp_s filename", *rows])
    (recorded / "rgb.txt").write_text(listed + "\n")
    for path in rng.sample(sorted(recorded.iterdir()), rng.choice((0, 1, 2))):
        nasty(rng, path, path.read_bytes())
    if rng.random() < 0.4 and (recorded / "rgb.txt").is_file():
        (recorded / "rgb.txt").unlink()
        (recorded / "rgb.txt").write_text(garbled_text(rng, listed), errors="replace", newline="")
    if rng.random() < 0.3:
        (run / "config.yaml").write_text(garbled_text(rng, (run / "config.yaml").read_text()), errors="replace")
    if rng.random() < 0.2:
        nasty(rng, run / rng.choice(("live_frames.csv", "trajectory_live.txt")))
    command = rng.choice(("finish", "finish", "finish", "resume"))
    return Case([command, run, "--quiet"])
