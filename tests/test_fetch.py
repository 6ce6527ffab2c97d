"""A download survives what networks do to it, and nothing wrong ever gets the name of the file that was asked for."""

from __future__ import annotations

import hashlib
import io
import os
import shutil
import socket
import tarfile
import zipfile
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from local_server import FileServer, file_server
from mastd3r.download.archives import check_archive
from mastd3r.download.fetch import (
    ANYTHING,
    Interrupted,
    Unreachable,
    Wanted,
    fetch,
    human_bytes,
    local_path,
    md5_of,
    sha256_of,
)
from mastd3r.errors import InputError, OutputError

SIZE = 3_000_000
DATA = np.random.default_rng(0).bytes(SIZE)
OTHER = np.random.default_rng(1).bytes(SIZE)
SHA = hashlib.sha256(DATA).hexdigest()


@pytest.fixture
def server() -> Iterator[FileServer]:
    with file_server() as state:
        state.files["/w.bin"] = DATA
        yield state


def get(server: FileServer, folder: Path, want: Wanted = ANYTHING, **options: Any) -> Any:
    return fetch(server.url + "/w.bin", folder / "w.bin", want, pause_s=0.01, timeout_s=5.0, **options)


def interrupted(server: FileServer, folder: Path, share: float = 0.4) -> None:
    """Leave the first part of a download behind, as a command that was stopped would."""
    server.drop_always = share
    with pytest.raises(Interrupted):
        get(server, folder, attempts=1)
    server.drop_always = None
    assert (folder / "w.bin.part").stat().st_size == int(share * SIZE)
    server.sent_bytes = 0


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def test_a_file_arrives_whole_with_its_checksum(server: FileServer, tmp_path: Path) -> None:
    told: list[tuple[int, int | None]] = []
    got = get(server, tmp_path / "new" / "folder", progress=lambda done, total: told.append((done, total)))
    assert got.path.read_bytes() == DATA and (got.size_bytes, got.sha256, got.resumed_bytes) == (SIZE, SHA, 0)
    assert names(got.path.parent) == ["w.bin"]
    assert told[0] == (0, SIZE) and told[-1] == (SIZE, SIZE) and told == sorted(told)


def test_the_md5_of_a_server_is_held_to(server: FileServer, tmp_path: Path) -> None:
    got = get(server, tmp_path / "right", Wanted(md5=hashlib.md5(DATA).hexdigest()))
    assert got.path.read_bytes() == DATA and md5_of(got.path) == hashlib.md5(DATA).hexdigest()
    wrong = hashlib.md5(OTHER).hexdigest()
    with pytest.raises(InputError, match=rf"expected md5 {wrong}, got .*removed"):
        get(server, tmp_path / "wrong", Wanted(md5=wrong))
    assert names(tmp_path / "wrong") == []


def test_connections_dropped_again_and_again_send_no_byte_twice(server: FileServer, tmp_path: Path) -> None:
    server.drop_at = [0.1, 0.4, 0.4, 0.4, 0.7, 0.71, 0.95]
    assert get(server, tmp_path, Wanted(SHA), attempts=4).path.read_bytes() == DATA
    assert server.sent_bytes == SIZE and len(server.seen) == 8


def test_a_stopped_command_goes_on_where_it_was(server: FileServer, tmp_path: Path) -> None:
    interrupted(server, tmp_path)
    told: list[int] = []
    got = get(server, tmp_path, progress=lambda done, total: told.append(done))
    assert got.path.read_bytes() == DATA and got.resumed_bytes == told[0] == int(0.4 * SIZE)
    assert server.sent_bytes == SIZE - int(0.4 * SIZE) and names(tmp_path) == ["w.bin"]
    assert server.seen[-1][1]["range"] == f"bytes={int(0.4 * SIZE)}-" and server.seen[-1][1]["if-range"].startswith('"')


def test_a_resumed_download_follows_redirects(server: FileServer, tmp_path: Path) -> None:
    server.redirects["/moved"] = server.url + "/w.bin"
    server.drop_at = [0.4]
    fetch(server.url + "/moved", tmp_path / "w.bin", Wanted(SHA), pause_s=0.01)
    assert server.sent_bytes == SIZE


@pytest.mark.parametrize("weak", [False, True])
def test_a_file_that_changed_on_the_server_begins_again(server: FileServer, tmp_path: Path, weak: bool) -> None:
    server.weak = weak  # If-Range may not carry a weak ETag, and the date is the same: the answer's ETag tells
    interrupted(server, tmp_path)
    server.files["/w.bin"] = OTHER
    got = get(server, tmp_path)
    assert got.path.read_bytes() == OTHER and got.resumed_bytes == 0


def test_without_validators_the_length_is_compared(server: FileServer, tmp_path: Path) -> None:
    server.validators = False
    interrupted(server, tmp_path)
    server.files["/w.bin"] = OTHER[:-5]
    assert get(server, tmp_path).path.read_bytes() == OTHER[:-5]
    server.files["/w.bin"] = DATA
    interrupted(server, tmp_path / "same")
    assert get(server, tmp_path / "same").resumed_bytes == int(0.4 * SIZE)


def test_a_changed_file_of_equal_length_is_caught_by_the_checksum(server: FileServer, tmp_path: Path) -> None:
    server.validators = False
    server.files["/w.bin"] = OTHER
    interrupted(server, tmp_path)
    server.files["/w.bin"] = DATA
    got = get(server, tmp_path, Wanted(SHA))
    assert got.path.read_bytes() == DATA and got.resumed_bytes == 0


def test_a_server_without_ranges_begins_again(server: FileServer, tmp_path: Path) -> None:
    server.ranges = False
    server.drop_at = [0.4, 0.6]
    assert get(server, tmp_path).path.read_bytes() == DATA
    assert server.sent_bytes == int(0.4 * SIZE) + int(0.6 * SIZE) + SIZE


def test_a_part_of_another_url_or_without_note_is_not_used(server: FileServer, tmp_path: Path) -> None:
    (tmp_path / "w.bin.part").write_bytes(OTHER[:1000])
    got = get(server, tmp_path)
    assert got.path.read_bytes() == DATA and got.resumed_bytes == 0
    server.files["/other"] = OTHER
    server.validators = False  # nothing but the address tells the two files apart
    (tmp_path / "w.bin").unlink()
    interrupted(server, tmp_path)
    fetch(server.url + "/other", tmp_path / "w.bin", pause_s=0.01)
    assert (tmp_path / "w.bin").read_bytes() == OTHER


def test_a_part_that_was_complete_already_needs_no_byte(server: FileServer, tmp_path: Path) -> None:
    interrupted(server, tmp_path)
    (tmp_path / "w.bin.part").write_bytes(DATA)
    assert get(server, tmp_path, Wanted(SHA)).path.read_bytes() == DATA
    assert server.sent_bytes == 0


def test_a_part_longer_than_the_file_begins_again(server: FileServer, tmp_path: Path) -> None:
    interrupted(server, tmp_path)
    (tmp_path / "w.bin.part").write_bytes(OTHER + b"more")
    assert get(server, tmp_path).path.read_bytes() == DATA


@pytest.mark.parametrize("ranges", [True, False])
def test_a_length_that_never_comes_true_ends_in_one_line(server: FileServer, tmp_path: Path, ranges: bool) -> None:
    server.lie_bytes, server.ranges = 1000, ranges
    with pytest.raises(Interrupted, match=r"expected the whole file, got .* of 3 MB .*again goes on"):
        get(server, tmp_path, attempts=3)
    assert "w.bin" not in names(tmp_path) and len(server.seen) < 10


def test_a_length_other_than_the_known_one_is_refused(server: FileServer, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected 2999999 bytes, the server offers 3000000"):
        get(server, tmp_path, Wanted(size_bytes=SIZE - 1))
    server.lie_bytes = -1000  # the server closes after what it has promised
    with pytest.raises(InputError, match="expected 3000000 bytes, the server offers 2999000"):
        get(server, tmp_path, Wanted(size_bytes=SIZE))
    assert names(tmp_path) == []


def test_a_wrong_checksum_is_refused_and_removed(server: FileServer, tmp_path: Path) -> None:
    (tmp_path / "w.bin").write_bytes(b"what was there before")
    wrong = hashlib.sha256(OTHER).hexdigest()
    with pytest.raises(InputError, match=f"expected sha256 {wrong}, got {SHA}"):
        get(server, tmp_path, Wanted(wrong))
    assert names(tmp_path) == ["w.bin"] and (tmp_path / "w.bin").read_bytes() == b"what was there before"


def test_a_file_that_is_right_already_is_not_asked_for(server: FileServer, tmp_path: Path) -> None:
    get(server, tmp_path)
    before = len(server.seen)
    assert get(server, tmp_path, Wanted(SHA)).size_bytes == SIZE
    assert len(server.seen) == before


def test_a_busy_server_is_asked_again_and_a_refusal_is_final(server: FileServer, tmp_path: Path) -> None:
    server.status = [503, 429, 500]
    assert get(server, tmp_path).path.read_bytes() == DATA
    with pytest.raises(InputError, match="got HTTP 404") as refused:
        fetch(server.url + "/absent", tmp_path / "absent", pause_s=0.01)
    assert not isinstance(refused.value, Unreachable | Interrupted) and server.seen[-2][0] == "/w.bin"


def test_no_server_no_name_no_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        closed = f"http://127.0.0.1:{free.getsockname()[1]}/w.bin"
    place = f"without a network, place w.bin.*as {tmp_path / 'w.bin'}"
    monkeypatch.setenv("no_proxy", "127.0.0.1,nowhere.invalid")
    with pytest.raises(Unreachable, match=place):
        fetch(closed, tmp_path / "w.bin", Wanted(size_bytes=5), pause_s=0.01)

    def unknown(*args: Any, **kwargs: Any) -> Any:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(Unreachable, match=f"Name or service not known.*{place}") as told:
        fetch("https://nowhere.invalid/w.bin", tmp_path / "w.bin", Wanted(size_bytes=2_750_000_000), pause_s=0.01)
    assert "(2.75 GB)" in str(told.value) and "\n" not in str(told.value)


def test_a_disk_too_small_is_said_before_the_first_byte(
    server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10, 0, SIZE - 1))
    with pytest.raises(OutputError, match=r"expected 3 MB of free space, got 3 MB; free some space"):
        get(server, tmp_path)
    assert not (tmp_path / "w.bin").exists()
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10, 0, SIZE))
    assert get(server, tmp_path).size_bytes == SIZE


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full, a disk that is always full")
def test_a_disk_that_fills_up_is_one_line(server: FileServer, tmp_path: Path) -> None:
    (tmp_path / "w.bin.part").symlink_to("/dev/full")
    with pytest.raises(OutputError, match=r"w.bin.part: expected to write, got No space left.*run the same command"):
        get(server, tmp_path)
    (tmp_path / "copy.part").symlink_to("/dev/full")
    (tmp_path / "source").write_bytes(DATA)
    with pytest.raises(OutputError, match="No space left"):
        fetch(tmp_path / "source", tmp_path / "copy")


def test_a_folder_that_cannot_be_made_is_one_line(server: FileServer, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="expected to write"):
        get(server, tmp_path / "file" / "below")


def test_local_files_and_file_urls_are_copied(tmp_path: Path) -> None:
    source = tmp_path / "a file"
    source.write_bytes(DATA)
    for n, given in enumerate((source, str(source), source.as_uri())):
        told: dict[int, int | None] = {}
        got = fetch(given, tmp_path / f"out{n}", Wanted(SHA), progress=told.__setitem__)
        assert got.path.read_bytes() == DATA and told[SIZE] == SIZE and max(told) == SIZE
    with pytest.raises(InputError, match="expected sha256 0"):
        fetch(source, tmp_path / "wrong", Wanted("0" * 64))
    with pytest.raises(InputError, match="expected a file, got no such file"):
        fetch(tmp_path / "absent", tmp_path / "wrong")
    with pytest.raises(InputError, match="expected 5 bytes, got 3000000"):
        fetch(source, tmp_path / "wrong", Wanted(size_bytes=5))
    assert names(tmp_path) == ["a file", "out0", "out1", "out2"]


@pytest.mark.parametrize("source", ["ftp://example.org/x", "file://elsewhere/x", "gopher://x/y"])
def test_other_addresses_are_refused(source: str) -> None:
    with pytest.raises(InputError, match="expected a http, https or file URL"):
        local_path(source)


@pytest.mark.parametrize("source", ["http://", "http://[nothing", "http://a:b/c", "http://a b/c"])
def test_an_address_that_is_none_is_one_line(source: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as told:
        fetch(source, tmp_path / "x", pause_s=0.01)
    assert str(told.value).startswith(f"{source}: ") and "\n" not in str(told.value)


def archive(kind: str) -> bytes:
    out, body = io.BytesIO(), np.random.default_rng(2).bytes(200_000)
    if kind == "zip":
        with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as file:
            file.writestr("a/b.bin", body)
    else:
        with tarfile.open(fileobj=out, mode=f"w:{kind}") as file:  # type: ignore[call-overload]
            info = tarfile.TarInfo("a/b.bin")
            info.size = len(body)
            file.addfile(info, io.BytesIO(body))
    return out.getvalue()


@pytest.mark.parametrize("kind", ["zip", "", "gz", "bz2", "xz"])
def test_damaged_archives_are_refused_and_removed(server: FileServer, tmp_path: Path, kind: str) -> None:
    whole = archive(kind)
    want = Wanted(check=check_archive)
    server.files["/w.bin"] = whole
    assert get(server, tmp_path, want).path.read_bytes() == whole
    for damaged in (whole[: len(whole) // 2], b"<html>not here</html>", _flipped(whole) if kind else b""):
        server.files["/w.bin"] = damaged
        with pytest.raises(InputError, match="archive"):
            get(server, tmp_path, want)
        assert names(tmp_path) == ["w.bin"] and (tmp_path / "w.bin").read_bytes() == whole


def _flipped(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 0xFF]) + data[middle + 1 :]


def test_checksums_and_sizes_for_people(tmp_path: Path) -> None:
    (tmp_path / "x").write_bytes(b"abc")
    assert sha256_of(tmp_path / "x") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert [human_bytes(n) for n in (None, 7, 1500, 88_249_960, 2_754_661_648)] == [
        "unknown size", "7 bytes", "1.5 kB", "88.2 MB", "2.75 GB",
    ]  # fmt: skip
