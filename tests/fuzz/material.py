"""What bad inputs are made of: good ones, made once, and ways to damage them."""

from __future__ import annotations

import json
import os
import random
import socket
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from PIL import Image

from helpers import blobs, write_video
from made_runs import made_run
from mastd3r.camera.pinhole import Camera
from mastd3r.config import Config, config_to_yaml
from mastd3r.mapping.gaussians import GaussianArrays
from mastd3r.mapping.ply import write_gaussians_ply

NUMBERS = (
    "nan",
    "inf",
    "-inf",
    "-1",
    "0",
    "-0.0",
    "1e400",
    "1e308",
    "-1e200",
    "1e-320",
    "1" * 400,
    "0x10",
    "1_000",
    "²",
    "1e9",
    "999999999999",
    "-999999999999",
    "2147483648",
    "4294967297",
    "",
    " ",
    "x",
    "None",
    "true",
    "1,5",
    "½",
)
VALUES = (
    None,
    True,
    -1,
    0,
    10**400,
    1e308,
    float("nan"),
    float("inf"),
    "",
    "x",
    "[/x]",
    "\x1b[31m",
    "a\nb",
    [],
    [[]],
    {},
    {"a": {}},
    [None],
    ["x"] * 3,
    "9" * 400,
    [1e400],
    -1e-320,
    [["tracked", 10**10]],
    "../../../etc/passwd",
    "\ud800",
)
NAMES = (
    "[/x]",
    "[red]x[/red]",
    "a\x1b[2Jb",
    "a\nb",
    "tab\tx",
    "\r\r",
    "\u202egpj.exe",
    "é" * 60,
    "😀",
    "-x",
    "--out",
    "~nobody",
    "n" * 255,
    "n" * 256,
    "n" * 5000,
    "a/" * 200,
    os.fsdecode(b"\xff\xfe"),
    "%s%d{0}",
    "con",
    "a:b",
    "x" + chr(0x9B) + "y",
    " ",
)
WALL, HUGE_BYTES = 4, 5 * 2**30


@dataclass(frozen=True)
class Shared:
    """Good inputs that cases copy; made when they are first wanted."""

    root: Path
    quick: bool = (
        False  # cases end before anything is tracked or drawn: kernels that are not compiled yet take a minute
    )

    @cached_property
    def one_image(self) -> Path:
        folder = self.root / "one"
        folder.mkdir()
        Image.fromarray(blobs(1)[0]).save(folder / "a.png")
        return folder

    @cached_property
    def run(self) -> Path:
        """A finished run with everything, ``photos`` beside it."""
        lens = Camera(70.0, 70.0, 31.5, 23.5, 64, 48)
        made = made_run(self.root / "made", lens)
        rng = np.random.default_rng(0)
        n = 40
        quats = rng.normal(size=(n, 4)).astype(np.float32)
        splat = GaussianArrays(
            means=rng.normal(0, 1, (n, 3)).astype(np.float32) + np.float32(4),
            scales=np.full((n, 3), 0.1, np.float32),
            quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
            opacities=np.full(n, 0.6, np.float32),
            colors=rng.random((n, 3)).astype(np.float32),
            kf_id=np.zeros(n, np.int32),
            sh_rest=np.zeros((n, 0, 3), np.float32),
        )
        write_gaussians_ply(made.path / "gaussians.ply", splat)
        (made.path / "config.yaml").write_text(config_to_yaml(Config()))
        (made.path / "report.html").write_text("<html></html>")
        record = json.loads((made.path / "run.json").read_text())
        record |= {"median_depth": 4.0, "graph": {"keyframes": 3, "edges": 2}, "observability": {"kind": "parallax"}}
        (made.path / "run.json").write_text(json.dumps(record))
        return made.path

    @cached_property
    def map(self) -> Path:
        """A saved map of that run."""
        in_a_child(["save", str(self.run), "--map", str(self.root / "map")])
        return self.root / "map"

    @cached_property
    def map_digest(self) -> str:
        """What a run that went on in that map says of it."""
        from mastd3r.export.map_folder import read_map
        from mastd3r.offline.map_drawing import digest_of

        return digest_of(read_map(self.map))

    @cached_property
    def video(self) -> bytes:
        return write_video(self.root / "v.mp4", blobs(8)).read_bytes()

    @cached_property
    def pictures(self) -> list[bytes]:
        """One image as PNG, JPEG and WebP."""
        out = []
        for suffix in ("png", "jpg", "webp"):
            Image.fromarray(blobs(1)[0]).save(self.root / f"p.{suffix}")
            out.append((self.root / f"p.{suffix}").read_bytes())
        return out


def aside(make: Callable[[], object]) -> None:
    """Call it in a process of its own, whatever comes of it: threads that it starts here would be dead in every fork,
    and be waited for there."""
    pid = os.fork()
    if pid:
        os.waitpid(pid, 0)
        return
    for number in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), number)
    try:
        make()
    finally:
        os._exit(0)


def in_a_child(words: list[str]) -> None:
    """One command in a process of its own, whatever comes of it."""
    from mastd3r.cli.main import main as command

    aside(lambda: command(words))


def garbled(rng: random.Random, data: bytes) -> bytes:
    """The same with some of it cut, flipped, doubled or replaced."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8))):
        at, length = rng.randrange(len(out) + 1), rng.choice((1, 2, 4, 30))
        change = rng.randrange(5)
        if change == 0:
            del out[at:]
        elif change == 1:
            out[at : at + length] = rng.randbytes(length)
        elif change == 2:
            out[at:at] = out[max(0, at - length) : at] * 3
        elif change == 3:
            del out[at : at + length]
        else:
            out[at : at + length] = rng.choice((b"\0", b"\xff", b"\n", b"-", b"9", b"\x1b[")) * length
    return bytes(out)


def garbled_text(rng: random.Random, text: str) -> str:
    """The same with some words or lines replaced by what nobody expects, or the whole in another encoding's clothes."""
    lines = text.splitlines()
    for _ in range(rng.choice((1, 1, 3))):
        if not lines:
            break
        n = rng.randrange(len(lines))
        words = lines[n].split(" ")
        change = rng.randrange(8)
        if change <= WALL:
            words[rng.randrange(len(words))] = rng.choice(NUMBERS + NAMES[:8])
            lines[n] = " ".join(words)
        elif change == WALL + 1:
            lines[n] = rng.choice((lines[n] + " 1 2 3", "", "\0", " ".join(words[:-1]), "x" * 100_000, lines[0]))
        elif change == WALL + 2:
            lines = lines[:n] if rng.random() < 0.5 else [*lines, *lines]
        else:
            rng.shuffle(lines)
    between = rng.choice(("\n", "\n", "\r\n", "\r", "\x85"))
    text = between.join(lines) + rng.choice(("\n", ""))
    return rng.choice((text, text, "\ufeff" + text, text.replace(" ", ","), text.replace(" ", "\t")))


def nasty(rng: random.Random, path: Path, good: bytes = b"", huge: int = HUGE_BYTES) -> None:
    """Put something at ``path`` that is not what belongs there."""
    kinds: tuple[Callable[[], object], ...] = (
        lambda: os.mkfifo(path),
        path.mkdir,
        lambda: path.symlink_to("nowhere"),
        lambda: path.symlink_to(path.name),
        lambda: path.symlink_to("/dev/zero"),
        lambda: path.write_bytes(b""),
        lambda: path.write_bytes(rng.randbytes(rng.choice((1, 100, 5000)))),
        lambda: path.write_bytes(b"\0" * 5000),
        lambda: sparse(path, size=huge),
        partial(_socket, path),
    )
    if path.is_symlink() or path.exists():
        path.unlink()
    if good and rng.random() < 0.5:
        path.write_bytes(garbled(rng, good))
    else:
        rng.choice(kinds)()


def sparse(path: Path, head: bytes = b"", size: int = HUGE_BYTES) -> None:
    """A file that says that it is huge, and takes no room."""
    with open(path, "wb") as file:
        file.write(head)
        file.truncate(size)


def _socket(path: Path) -> None:
    if len(os.fsencode(path)) > 100:
        path.write_bytes(b"")
        return
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(os.fspath(path))


def png_of(width: int, height: int, depth: int = 8, colour: int = 2, data: bytes = b"") -> bytes:
    """A PNG whose header says so, with whatever data."""

    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


def npy_of(shape: tuple[int, ...], dtype: str = "<f4", data: bytes = b"") -> bytes:
    """A .npy whose header says so, with whatever data."""
    head = repr({"descr": dtype, "fortran_order": False, "shape": shape}).encode()
    head += b" " * (-(len(head) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + data
