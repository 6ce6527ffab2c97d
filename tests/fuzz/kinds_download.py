"""Servers, archives and weights."""

from __future__ import annotations

import io
import json
import random
import socket
import struct
import tarfile
import threading
import time
import zipfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from fuzz.case import Case, Room, kind
from fuzz.kinds_words import short_run
from fuzz.material import Shared, garbled, nasty, sparse

MEMBERS = (
    "a/b.txt",
    "../x",
    "/etc/x",
    "a/" * 2000 + "x",
    "n" * 300,
    "a\x1b[2J",
    "C:\\x",
    "a\0b",
    "é\udcff",
    "rgb.txt",
    "a/../../x",
    ".",
    "con",
    "[/x]",
    "a\nb",
    "x" * 100 + "/" + "y" * 200,
)
BOMB_BYTES = 60 * 2**20  # of zeros
NAME = "rgbd_dataset_freiburg1_xyz"


@kind("archives", 70)
def archives(rng: random.Random, room: Room, shared: Shared) -> Case:
    """A dataset's archive, which comes from the disk as if it had been fetched."""
    file = room.given / "x.tgz"
    which = rng.randrange(5)
    if which == 0:
        nasty(rng, file, _zip(rng), 2**26)
    elif which in (1, 2):
        file.write_bytes(_tar(rng))
    elif which == 3:
        file.write_bytes(_zip(rng))
    else:
        file.write_bytes(garbled(rng, rng.choice((_tar(rng), _zip(rng)))))
    return Case(["download", "tum", "freiburg1_xyz", "--yes", "--quiet", "--to", room.out], partial(_serve_file, file))


def _serve_file(file: Path) -> None:
    from mastd3r.download import datasets
    from mastd3r.download.datasets_known import KNOWN

    tum = KNOWN["tum"]
    archives = {key: replace(a, path=file.name, size_bytes=None, md5=None) for key, a in tum.archives.items()}
    KNOWN["tum"] = replace(tum, root=file.parent.as_uri(), archives=archives)  # type: ignore[index]
    datasets.fetch = partial(datasets.fetch, attempts=1, pause_s=0.01)


def _zip(rng: random.Random) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in rng.sample(MEMBERS, rng.choice((1, 3))):
            data = b"\0" * (BOMB_BYTES if rng.random() < 0.15 else 10)
            archive.writestr((f"{NAME}/" * (rng.random() < 0.7) + name).encode("utf-8", "replace").decode(), data)
    data = bytearray(buffer.getvalue())
    if rng.random() < 0.3:  # another size than there is, in the directory
        at = data.rfind(b"PK\x01\x02")
        data[at + 24 : at + 28] = struct.pack("<I", rng.choice((0, 2**31, 2**32 - 1)))
    return bytes(data)


def _tar(rng: random.Random) -> bytes:
    buffer = io.BytesIO()
    form = rng.choice((tarfile.PAX_FORMAT, tarfile.GNU_FORMAT))
    with tarfile.open(fileobj=buffer, mode=rng.choice(("w:gz", "w", "w:bz2", "w:xz")), format=form) as archive:
        for name in rng.sample(MEMBERS, rng.choice((1, 3))):
            info = tarfile.TarInfo(f"{NAME}/" * (rng.random() < 0.7) + name)
            data = b"\0" * (BOMB_BYTES if rng.random() < 0.1 else 20)
            info.type = rng.choice(
                (tarfile.REGTYPE,) * 6 + (tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE, b"Z", tarfile.DIRTYPE)
            )
            info.size = len(data) if info.type == tarfile.REGTYPE else 0
            info.linkname = "../../x"
            if rng.random() < 0.3 and form == tarfile.PAX_FORMAT:
                sparse_map = rng.choice(("0,1", "0,99999999999", "x", "-1,5", ",".join(["1"] * 1001)))
                info.pax_headers = {
                    "GNU.sparse.major": rng.choice(("0", "1", "9", "x")),
                    "GNU.sparse.minor": "0",
                    "GNU.sparse.map": sparse_map,
                    "GNU.sparse.size": rng.choice(("10", "x", "-5", "9" * 30)),
                    "GNU.sparse.realsize": "99999999999",
                    "GNU.sparse.name": rng.choice(MEMBERS[:4]),
                }
            archive.addfile(info, io.BytesIO(data) if info.size else None)
    data = bytearray(buffer.getvalue())
    return bytes(data)


@kind("servers", 50)
def servers(rng: random.Random, room: Room, shared: Shared) -> Case:
    """A server whose answers are wrong in every way."""
    answer = rng.choice(ANSWERS)
    seed = rng.randrange(10**6)
    port = free_port()
    name = rng.choice(("x.safetensors", "x.pth", "n" * 300 + ".pth", "a%1b.pth", "[x].pth", "x.pth?a=b", "..%2fx.pth"))
    words: list[list[str | Path]] = [
        ["weights", "download", f"http://127.0.0.1:{port}/{name}", "--as", "mine", "--yes", "--quiet"],
        ["weights", "download", f"http://127.0.0.1:{port}/{name}", "--yes", "--quiet"],
        ["weights", "download", "owner/name", "--yes", "--quiet"],
    ]
    return Case(rng.choice(words), partial(serve, answer, port, seed), {"HF_ENDPOINT": f"http://127.0.0.1:{port}"})


def free_port() -> int:
    """One of this machine that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _head(status: str, *lines: str) -> bytes:
    return "\r\n".join([f"HTTP/1.1 {status}", *lines, "Connection: close", "", ""]).encode("latin-1", "replace")


Answer = Callable[[int, random.Random], bytes]
ANSWERS: tuple[Answer, ...] = (
    lambda port, rng: _head(
        "429 No", f"Retry-After: {rng.choice(('²', '-5', '1e9', '99999999999', 'Thu, 99 Foo', 'nan', ''))}"
    ),
    lambda port, rng: _head("503 No", "Retry-After: 0"),
    lambda port, rng: _head("302 Found", f"Location: http://127.0.0.1:{port}/x.pth"),
    lambda port, rng: _head(
        "302 Found",
        f"Location: {rng.choice(('ftp://127.0.0.1/x', 'file:///etc/passwd', 'http://[', '//', 'gopher://x', ''))}",
    ),
    lambda port, rng: _head("302 Found"),
    lambda port, rng: _head("404 \x1b[2Jgone [/x]"),
    lambda port, rng: _head("403 a\x85b\x9bc"),
    lambda port, rng: (
        _head("200 OK", f"Content-Length: {rng.choice(('x', '-1', '99999999999999999999', '1e3', ''))}") + b"abc"
    ),
    lambda port, rng: _head("200 OK", "Content-Length: 1000") + b"abc",
    lambda port, rng: _head("200 OK", "Transfer-Encoding: chunked") + b"zz\r\nabc",
    lambda port, rng: (
        _head("206 Part", f"Content-Range: {rng.choice(('bytes 5-9/10', 'x', 'bytes */*', 'bytes 0-²/3'))}") + b"abc"
    ),
    lambda port, rng: b"\x16\x03\x01\x00" + b"\xff" * 50,
    lambda port, rng: b"",
    lambda port, rng: b"HTTP/1.1 " + b"x" * 100_000,
    lambda port, rng: b"HTTP/1.1 200 OK\r\n" + b"a: b\r\n" * 500 + b"\r\n",
    lambda port, rng: (
        _head("200 OK")
        + json.dumps(
            {
                "siblings": rng.choice(
                    (
                        None,
                        3,
                        [None],
                        [{}],
                        [{"rfilename": 3}],
                        "x",
                        [{"rfilename": "a\x1b.safetensors"}],
                        [{"rfilename": "..", "size": "x"}],
                    )
                )
            }
        ).encode()
    ),
    lambda port, rng: _head("200 OK") + b"[" * 100_000,
    lambda port, rng: _head("200 OK", f"ETag: {'x' * 3000}\x01", "Last-Modified: ²") + b"abc",
    lambda port, rng: b"drip",
    lambda port, rng: b"endless",
)


def serve(answer: Answer, port: int, seed: int) -> None:
    """From now on this process has a server that answers so; downloads are not patient."""
    from mastd3r.download import datasets, fetch, weights_download

    server = socket.create_server(("127.0.0.1", port))

    def one(connection: socket.socket, rng: random.Random) -> None:
        with connection:
            try:
                connection.recv(65536)
                _say(connection, answer(port, rng))
            except OSError:
                pass

    def forever() -> None:
        rng = random.Random(seed)
        while True:
            connection, _ = server.accept()
            threading.Thread(target=one, args=(connection, rng), daemon=True).start()

    threading.Thread(target=forever, daemon=True).start()
    quick = partial(fetch.fetch, attempts=2, pause_s=0.01, timeout_s=2.0)
    weights_download.fetch = datasets.fetch = quick
    fetch.MAX_PAUSE_S = 0.1


def _say(connection: socket.socket, data: bytes) -> None:
    if data == b"drip":
        connection.sendall(_head("200 OK", "Content-Length: 1000000"))
        while True:
            connection.sendall(b"x")
            time.sleep(0.2)
    if data == b"endless":
        connection.sendall(_head("200 OK"))
        for _ in range(200):
            connection.sendall(b"[" * 65536)
    connection.sendall(data)


@kind("weights", 40)
def weights(rng: random.Random, room: Room, shared: Shared) -> Case:
    """Files that say they are weights."""
    file = room.given / f"w.{rng.choice(('safetensors', 'pth', 'pt'))}"
    which = rng.randrange(6)
    if which == 0:
        nasty(rng, file, b"PK\x03\x04" + b"\0" * 30, 2**26)
    elif which == 1:
        head = json.dumps(
            {
                "a": {
                    "dtype": rng.choice(("F32", "X")),
                    "shape": rng.choice(([10**9, 10**9], [-1], [2], "x")),
                    "data_offsets": rng.choice(([0, 8], [0, 10**18], [5, 1], [-1, 3])),
                }
            }
        ).encode()
        file.write_bytes(struct.pack("<Q", rng.choice((len(head), 2**63, 10**7, 0))) + head + b"\0" * 8)
    elif which == 2:
        file.write_bytes(_zip(rng))
    elif which == 3:
        file.write_bytes(b"\x80\x02cos\nsystem\n(S'touch /tmp/never'\ntR.")
    elif which == 4:
        sparse(file, struct.pack("<Q", 2) + b"{}", 2**26)
    else:
        file.write_bytes(rng.randbytes(200))
    words: list[list[str | Path]] = [
        ["weights", "check", file],
        ["weights", "download", file, "--as", "mine", "--yes", "--quiet"],
        ["weights", "download", file, "--as", "mast3r", "--yes", "--quiet"],
        ["weights", "path", file],
        short_run(room, shared, "--pointmaps=mast3r", "--set", f"networks.mast3r={file}"),
    ]
    return Case(rng.choice(words))
