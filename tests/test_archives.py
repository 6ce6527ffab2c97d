"""Unpacking: what is in an archive, and nothing outside the folder that was named."""

from __future__ import annotations

import io
import shutil
import tarfile
import zipfile
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest

from mastd3r.download import archives
from mastd3r.download.archives import Damaged, check_archive, unpack
from mastd3r.errors import InputError, OutputError

FILES = {"a/one.txt": b"one" * 1000, "a/b/two.bin": np.random.default_rng(0).bytes(50_000), "c/three.txt": b""}


def tar_of(path: Path, files: dict[str, bytes], mode: str = "w:gz") -> Path:
    with tarfile.open(path, mode) as archive:  # type: ignore[call-overload]
        for name, data in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
    return path


def zip_of(path: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return path


def made(kind: str, folder: Path, files: dict[str, bytes]) -> Path:
    path = folder / f"x.{kind}"
    return zip_of(path, files) if kind == "zip" else tar_of(path, files, {"tgz": "w:gz", "tar": "w"}[kind])


def read_back(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("kind", ["zip", "tgz", "tar"])
def test_everything_comes_out(tmp_path: Path, kind: str) -> None:
    path = made(kind, tmp_path, {**FILES, "__MACOSX/a/._one.txt": b"x", "a/Thumbs.db": b"x", "a/._one.txt": b"x"})
    told: list[tuple[int, int | None]] = []
    count = unpack(path, tmp_path / "out", progress=lambda done, total: told.append((done, total)))
    assert count == 3 and read_back(tmp_path / "out") == FILES
    size = path.stat().st_size
    assert told[-1] == (size, size) and told == sorted(told)


@pytest.mark.parametrize("kind", ["zip", "tgz"])
def test_a_part_comes_out(tmp_path: Path, kind: str) -> None:
    path = made(kind, tmp_path, FILES)
    assert unpack(path, tmp_path / "out", ("a/b/", "c/")) == 2
    assert sorted(read_back(tmp_path / "out")) == ["a/b/two.bin", "c/three.txt"]
    with pytest.raises(InputError, match=r"x\..*: expected d/, e/ in it, got none"):
        unpack(path, tmp_path / "none", ("d/", "e/"))


@pytest.mark.parametrize("kind", ["zip", "tgz"])
@pytest.mark.parametrize("name", ["../evil", "a/../../evil", "/evil", "..\\evil", "C:/evil", "a/.."])
def test_a_member_that_leads_out_is_refused(tmp_path: Path, kind: str, name: str) -> None:
    path = made(kind, tmp_path, {**FILES, name: b"evil"})
    with pytest.raises(InputError, match="expected files and folders of its own, got a path that leads out"):
        unpack(path, tmp_path / "deep" / "out")
    assert not list(tmp_path.rglob("*evil*"))


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.FIFOTYPE])
def test_links_and_devices_of_a_tar_are_refused(tmp_path: Path, kind: bytes) -> None:
    path = tmp_path / "x.tar"
    with tarfile.open(path, "w") as archive:
        info = tarfile.TarInfo("a/link")
        info.type, info.linkname = kind, "/etc/passwd"
        archive.addfile(info)
        inside = tarfile.TarInfo("a/link/inside")
        inside.size = 4
        archive.addfile(inside, io.BytesIO(b"evil"))
    with pytest.raises(InputError, match=r"got a (link|device) \(a/link\)"):
        unpack(path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_links_of_a_zip_are_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as archive:
        info = zipfile.ZipInfo("link")
        info.external_attr = 0o120777 << 16
        archive.writestr(info, "/etc/passwd")
    with pytest.raises(InputError, match=r"got a link \(link\)"):
        unpack(tmp_path / "x.zip", tmp_path / "out")


def test_a_file_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    with tarfile.open(tmp_path / "x.tar", "w") as archive:
        for data in (b"one", b"two"):
            info = tarfile.TarInfo("a.txt")
            info.size = 3
            archive.addfile(info, io.BytesIO(data))
    with pytest.raises(InputError, match=r"expected every file once, got a\.txt twice"):
        unpack(tmp_path / "x.tar", tmp_path / "out")


@pytest.mark.parametrize("kind", ["zip", "tgz", "tar"])
@pytest.mark.parametrize("damage", ["cut", "flipped", "html"])
def test_damage_is_found_by_both(tmp_path: Path, kind: str, damage: str) -> None:
    path = made(kind, tmp_path, FILES)
    data = bytearray(path.read_bytes())
    if damage == "flipped" and kind == "tar":
        return  # a plain tar has no checksum over its contents
    if damage == "flipped":
        data[len(data) // 2] ^= 0xFF
    path.write_bytes({"cut": data[: len(data) // 2], "flipped": data, "html": b"<html>not here</html>"}[damage])
    for act in (lambda: check_archive(path), lambda: unpack(path, tmp_path / "out")):
        with pytest.raises(Damaged, match=rf"x\.{kind}: expected a whole zip or tar archive, got a damaged one"):
            act()


def test_more_than_the_disk_holds_is_refused_before_it_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = zip_of(tmp_path / "x.zip", {"zeros": b"\0" * 5_000_000})
    assert path.stat().st_size < 10_000
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(archives.shutil, "disk_usage", lambda place: usage(10**9, 0, 4_000_000))
    with pytest.raises(OutputError, match=r"expected 5000000 bytes of free space for zeros, got 4000000; free some"):
        unpack(path, tmp_path / "out")
    assert read_back(tmp_path / "out") == {}
    monkeypatch.undo()
    shutil.rmtree(tmp_path / "out")
    assert unpack(path, tmp_path / "out") == 1


def test_a_zip_with_a_password(tmp_path: Path) -> None:
    path = zip_of(tmp_path / "x.zip", {"a": b"x"})
    data = bytearray(path.read_bytes())
    data[6] |= 1  # general purpose flag of the local header, and of the directory
    data[data.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(data)
    with pytest.raises(InputError, match="expected no passwords, a in it needs one"):
        unpack(path, tmp_path / "out")
