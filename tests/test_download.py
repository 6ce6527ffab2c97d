"""``mastd3r download`` against a server on this machine that holds the archives of the datasets in miniature."""

from __future__ import annotations

import hashlib
import io
import json
import tarfile
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import miniatures
from local_server import FileServer, file_server
from mastd3r.cli.main import main
from mastd3r.config import SourceConfig
from mastd3r.download import datasets as module
from mastd3r.download.dataset_types import Dataset
from mastd3r.download.datasets_known import KNOWN
from mastd3r.download.fetch import Interrupted, fetch
from mastd3r.errors import ConfigError, InputError, OutputError
from mastd3r.sources import open_source

Files = dict[str, bytes]
SEQUENCES = {  # dataset -> (miniature, the sequence that it is of)
    "tum": ("tum", "freiburg1_xyz"),
    "bonn": ("bonn", "balloon"),
    "kitti-raw": ("kitti-raw", "2011_09_26_drive_0001"),
    "kitti-odometry": ("kitti-odometry", "03"),
    "kitti-odometry-color": ("kitti-odometry", "03"),
    "7scenes": ("7scenes", "chess/seq-01"),
    "euroc": ("euroc", "MH_01_easy"),
    "replica": ("replica", "room0"),
}


def files_of(root: Path, under: str = "") -> Files:
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in sorted((root / under).rglob("*")) if p.is_file()}


def zipped(files: Files) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def tgz(files: Files) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
        for name, data in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
    return buffer.getvalue()


def archives_of(name: str, root: Path) -> dict[str, bytes]:
    """The archives as the dataset's server has them: key of the table -> bytes."""
    files = files_of(root)
    if name.startswith("kitti"):
        return kitti_archives(name, files)
    if name == "7scenes":
        inner = zipped({k.removeprefix("chess/"): v for k, v in files.items()} | {"seq-01/Thumbs.db": b"x"})
        return {"chess": zipped({"chess/seq-01.zip": inner, "chess/seq-02.zip": inner, "chess/TrainSplit.txt": b"1"})}
    if name == "euroc":
        inner = zipped({k.removeprefix("MH_01_easy/"): v for k, v in files.items()})
        outer = {f"machine_hall/{n}/{n}{end}": inner for n in ("MH_01_easy", "MH_02_easy") for end in (".zip", ".bag")}
        return {"machine_hall": zipped(outer)}
    if name == "replica":
        return {"all": zipped(files | {"Replica/office0/traj.txt": b"another scene"})}
    return {SEQUENCES[name][1]: tgz(files) if name == "tum" else zipped(files)}


def kitti_archives(name: str, files: Files) -> dict[str, bytes]:
    if name == "kitti-raw":
        calib = {k: v for k, v in files.items() if k.count("/") == 1}
        drive = {k: v for k, v in files.items() if k not in calib}
        drive["2011_09_26/2011_09_26_drive_0001_sync/velodyne_points/data/0000000000.bin"] = b"scan" * 99
        return {"2011_09_26_calib": zipped(calib), "2011_09_26_drive_0001": zipped(drive)}
    texts = {k: v for k, v in files.items() if k.endswith(("times.txt", "calib.txt"))}
    images = {k: v for k, v in files.items() if k.endswith(".png")}
    images["dataset/sequences/04/image_0/000000.png"] = b"another sequence"
    poses = {k: v for k, v in files.items() if "/poses/" in k}
    kind = "color" if name.endswith("color") else "gray"
    return {kind: zipped(images), "calib": zipped(texts), "poses": zipped(poses)}


@pytest.fixture
def server() -> Iterator[FileServer]:
    with file_server() as state:
        yield state


def served(server: FileServer, name: str, root: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Dataset, Any]:
    """The dataset of the table with its server on this machine, in the table for the length of a test."""
    maker, _ = SEQUENCES[name]
    camera = {"camera": 0} if name == "kitti-odometry" else {}
    made = miniatures.ALL[maker](root, **camera)
    archives = dict(KNOWN[name].archives)
    for key, data in archives_of(name, root).items():
        md5 = hashlib.md5(data).hexdigest() if archives[key].md5 else None
        size = len(data) if archives[key].size_bytes else None
        archives[key] = replace(archives[key], size_bytes=size, md5=md5)
        server.files[f"/{archives[key].path}"] = data
    dataset = replace(KNOWN[name], root=server.url, archives=archives)
    monkeypatch.setitem(KNOWN, name, dataset)
    monkeypatch.setattr(module, "fetch", partial(fetch, attempts=1, pause_s=0.01, timeout_s=5.0))
    return dataset, made


def yes(dataset: Dataset) -> bool:
    return True


def everything_in(folder: Path) -> list[str]:
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


@pytest.mark.parametrize("name", SEQUENCES)
def test_what_is_downloaded_the_loaders_know(
    server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    dataset, made = served(server, name, tmp_path / "made", monkeypatch)
    sequence = SEQUENCES[name][1]
    (brought,) = module.download(dataset, [sequence], tmp_path / "to", yes)
    assert brought.fetched and brought.path.is_relative_to(tmp_path / "to" / name)
    source = open_source(brought.path, SourceConfig())
    assert source.kind == SEQUENCES[name][0]
    for frame, image in zip(source.frames(), made.images, strict=True):
        np.testing.assert_array_equal(frame.image, image)
    truth = source.truth()
    assert truth is not None and source.calibration == made.calibration
    np.testing.assert_allclose(truth.world_from_cam, made.world_from_cam, rtol=0, atol=1e-8)
    left = everything_in(tmp_path / "to" / name)
    assert not [f for f in left if "unpacking" in f or f.endswith((".part", ".bag", ".bin")) or "Thumbs" in f]
    kept = module.kept_archives(dataset, tmp_path / "to")
    assert bool(kept) == any(part.archive in dataset.shared for part in dataset.sequences[sequence].parts)
    server.seen.clear()
    (again,) = module.download(dataset, [sequence], tmp_path / "to", yes)
    assert not again.fetched and again.path == brought.path and server.seen == []
    assert everything_in(tmp_path / "to" / name) == left


@pytest.mark.parametrize("name", ["tum", "euroc"])
def test_interrupted_at_forty_per_cent_it_goes_on(
    server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    dataset, made = served(server, name, tmp_path / "made", monkeypatch)
    (data,) = server.files.values()
    server.drop_always = 0.4
    with pytest.raises(Interrupted, match="the same command again goes on from there"):
        module.download(dataset, [SEQUENCES[name][1]], tmp_path / "to", yes)
    assert server.sent_bytes == int(0.4 * len(data))
    assert not open_folders(tmp_path / "to" / name)
    server.drop_always = None
    (brought,) = module.download(dataset, [SEQUENCES[name][1]], tmp_path / "to", yes)
    assert server.sent_bytes == len(data)  # no byte was sent twice
    assert open_source(brought.path, SourceConfig()).length == len(made.images)


def middle_of_data(archive: bytes) -> int:
    """Where a byte of contents is, and none of a header that no checksum covers: of a zip, in its first large file."""
    if not archive.startswith(b"PK"):
        return len(archive) // 2  # gzip: one stream
    with zipfile.ZipFile(io.BytesIO(archive)) as names:
        info = next(i for i in names.infolist() if i.compress_size > 500)
    return info.header_offset + 30 + len(info.filename) + info.compress_size // 2


def open_folders(folder: Path) -> list[str]:
    """What is there beside the record and the archives."""
    return sorted(p.name for p in folder.iterdir() if p.name not in ("dataset.json", "archives"))


@pytest.mark.parametrize("name", ["tum", "bonn", "7scenes", "euroc"])
def test_a_corrupted_archive_is_refused_and_leaves_nothing(
    server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """One bit in the middle of its data; for EuRoC its server's MD5 tells, for the others the archive itself."""
    dataset, _ = served(server, name, tmp_path / "made", monkeypatch)
    ((path, whole),) = server.files.items()
    at = middle_of_data(whole)
    server.files[path] = whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :]
    words = "expected md5" if name == "euroc" else r"expected a whole zip or tar archive.*the same command fetches it"
    with pytest.raises(InputError, match=words):
        module.download(dataset, [SEQUENCES[name][1]], tmp_path / "to", yes)
    folder = tmp_path / "to" / name
    assert not open_folders(folder) and everything_in(folder) == ["dataset.json"]
    assert json.loads((folder / "dataset.json").read_text())["sequences"] == {}
    server.files[path] = whole
    (brought,) = module.download(dataset, [SEQUENCES[name][1]], tmp_path / "to", yes)
    assert brought.fetched and open_source(brought.path, SourceConfig()).length


def test_a_download_stopped_while_unpacking_leaves_nothing_half(
    server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, _ = served(server, "tum", tmp_path / "made", monkeypatch)

    def watch(what: str) -> Any:
        def tell(done: int, total: int | None) -> None:
            if what.startswith("unpacking") and total and done > total // 2:
                raise KeyboardInterrupt

        return tell

    with pytest.raises(KeyboardInterrupt):
        module.download(dataset, ["freiburg1_xyz"], tmp_path / "to", yes, watch=watch)
    folder = tmp_path / "to" / "tum"
    assert not open_folders(folder) and everything_in(folder) == [
        "archives/rgbd_dataset_freiburg1_xyz.tgz", "dataset.json",
    ]  # fmt: skip
    (folder / ".unpacking-rgbd_dataset_freiburg1_xyz.tgz" / "half").mkdir(parents=True)  # killed, this time
    server.seen.clear()
    (brought,) = module.download(dataset, ["freiburg1_xyz"], tmp_path / "to", yes)
    assert server.seen == [] and brought.fetched  # the archive was whole and is not fetched again
    assert open_folders(folder) == ["rgbd_dataset_freiburg1_xyz"] and not (folder / "archives").exists()


def test_sequences_of_one_archive_are_fetched_once(
    server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, _ = served(server, "euroc", tmp_path / "made", monkeypatch)
    module.download(dataset, ["MH_01_easy"], tmp_path / "to", yes)
    module.download(dataset, ["MH_02_easy", "MH_01_easy"], tmp_path / "to", yes)
    assert len(server.seen) == 1
    with pytest.raises(InputError, match=r"expected machine_hall/MH_03_medium/MH_03_medium\.zip in it, got none"):
        module.download(dataset, ["MH_03_medium"], tmp_path / "to", yes)
    assert [p.name for p in module.kept_archives(dataset, tmp_path / "to")] == ["machine_hall.zip"]


def test_a_hostile_archive_writes_nothing_outside(
    server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, _ = served(server, "bonn", tmp_path / "made", monkeypatch)
    server.files["/rgbd_bonn_balloon.zip"] = zipped({"rgbd_bonn_balloon/rgb.txt": b"x", "../../evil.txt": b"evil"})
    dataset = replace(
        dataset, archives={**dataset.archives, "balloon": replace(dataset.archives["balloon"], size_bytes=None)}
    )
    with pytest.raises(InputError, match="a path that leads out"):
        module.download(dataset, ["balloon"], tmp_path / "to", yes)
    assert not list(tmp_path.rglob("evil*")) and not open_folders(tmp_path / "to" / "bonn")


def test_the_licence_is_asked_once_and_may_be_declined(
    server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, _ = served(server, "replica", tmp_path / "made", monkeypatch)
    with pytest.raises(ConfigError, match="replica: licence not accepted, nothing was fetched"):
        module.download(dataset, ["room0"], tmp_path / "to", lambda d: False)
    assert server.seen == [] and not (tmp_path / "to").exists()
    asked: list[str] = []
    module.download(dataset, ["room0"], tmp_path / "to", lambda d: not asked.append(d.name))
    module.download(dataset, ["room0"], tmp_path / "to", lambda d: not asked.append(d.name))
    assert asked == ["replica"]
    record = json.loads((tmp_path / "to" / "replica" / "dataset.json").read_text())
    assert record["home"] == KNOWN["replica"].home and record["licence"] == KNOWN["replica"].licence


def test_names_that_stand_for_several_and_names_of_nothing() -> None:
    tum, scenes = KNOWN["tum"], KNOWN["7scenes"]
    names = [s.name for s in module.sequences_of(tum, ["rgbd_dataset_freiburg3_walking_xyz", "freiburg3_walking_xyz"])]
    assert names == ["freiburg3_walking_xyz"]
    assert [s.name for s in module.sequences_of(scenes, ["heads/"])] == ["heads/seq-01", "heads/seq-02"]
    assert len(module.sequences_of(KNOWN["bonn"], ["all"])) == 26
    with pytest.raises(ConfigError, match="expected a sequence of tum, got another; perhaps freiburg3_walking_xyz"):
        module.sequences_of(tum, ["freiburg3_walking_xzy"])
    with pytest.raises(ConfigError, match=r"kity-raw: expected one of tum, bonn, .* perhaps you meant kitti-raw"):
        module.dataset_of("kity-raw")


def test_a_folder_that_cannot_be_written(server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset, _ = served(server, "bonn", tmp_path / "made", monkeypatch)
    (tmp_path / "to").write_text("a file, not a folder")
    with pytest.raises(OutputError, match=r"dataset\.json: expected to write, got Not a directory"):
        module.download(dataset, ["balloon"], tmp_path / "to", yes)


@pytest.mark.parametrize("dataset", KNOWN.values(), ids=str)
def test_the_table_is_consistent(dataset: Dataset) -> None:
    assert dataset.root.startswith("https://") and not dataset.root.endswith("/")
    assert dataset.home.startswith("https://") and dataset.licence
    used = set()
    for name, sequence in dataset.sequences.items():
        assert sequence.name == name and sequence.folder and not sequence.folder.endswith("/")
        for part in sequence.parts:
            used.add(part.archive)
            assert dataset.archives[part.archive].file_name.endswith((".zip", ".tgz"))
    assert used == set(dataset.archives)
    assert len({a.path for a in dataset.archives.values()}) == len(dataset.archives)


# -- the command -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("words", [["download"], ["download", "list"]])
def test_the_list_shows_homes_and_licences(capfd: pytest.CaptureFixture[str], words: list[str]) -> None:
    assert main(words) == 0
    shown = capfd.readouterr().out
    for dataset in KNOWN.values():
        assert dataset.home in shown and dataset.licence in shown and dataset.name in shown
    assert "freiburg3_walking_xyz" in shown and "12.7 GB" not in shown and "1.48 GB" in shown


def test_a_dataset_alone_lists_its_sequences(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["download", "euroc"]) == 0
    shown = capfd.readouterr().out
    assert (
        all(name in shown for name in KNOWN["euroc"].sequences) and "12.7 GB" in shown and "machine_hall.zip" in shown
    )


def test_the_command_brings_a_sequence_and_says_what_it_is(
    server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    served(server, "replica", tmp_path / "made", monkeypatch)
    words = ["download", "replica", "room0", "--to", str(tmp_path / "to")]
    monkeypatch.setattr("sys.stdin.isatty", lambda: False, raising=False)
    assert main(words) == 2
    said = capfd.readouterr().err
    assert KNOWN["replica"].home in said and "no terminal; --yes accepts it" in said and server.seen == []
    assert main([*words, "--yes"]) == 0
    said = capfd.readouterr()
    assert f"ready: {tmp_path / 'to' / 'replica' / 'Replica' / 'room0'}" in said.out
    assert KNOWN["replica"].licence in said.err and "kept, other sequences come out of it" in said.err
    assert main(words) == 0  # nothing to ask any more
    assert "was there: " in capfd.readouterr().out


def test_an_interrupted_command_says_so_in_one_line(
    server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    served(server, "tum", tmp_path / "made", monkeypatch)
    server.drop_always = 0.4
    words = ["download", "tum", "freiburg1_xyz", "--to", str(tmp_path / "to"), "--yes", "--quiet"]
    assert main(words) == 2
    last = capfd.readouterr().err.splitlines()[-1]
    assert last.startswith("mastd3r: ") and "the same command again goes on from there" in last
    server.drop_always = None
    assert main(words) == 0 and "ready: " in capfd.readouterr().out


def test_ctrl_c_says_that_the_download_goes_on(
    server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    served(server, "tum", tmp_path / "made", monkeypatch)

    def stopped(*args: Any, **options: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "fetch", stopped)
    assert main(["download", "tum", "freiburg1_xyz", "--to", str(tmp_path / "to"), "--yes", "--quiet"]) == 130
    assert "the same command goes on from there" in capfd.readouterr().err.splitlines()[-1]
