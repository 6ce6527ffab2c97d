"""Files of others: refused by what they are and by their size, in one line, before anything is read of them."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fuzz.material import npy_of, png_of, sparse
from helpers import blobs
from mastd3r.config import SourceConfig
from mastd3r.errors import ConfigError, InputError
from mastd3r.export.run_record import checked_camera, checked_metrics, checked_record
from mastd3r.reading.arrays import array_of, arrays_of
from mastd3r.reading.files import entries_of, user_path, whole_bytes, whole_json, whole_text
from mastd3r.reading.pictures import opened
from mastd3r.reading.ply import read_vertices
from mastd3r.reading.yaml_text import yaml_value
from mastd3r.sources import open_source

HEAD = b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\nend_header\n"


@pytest.mark.parametrize(
    ("make", "got"),
    [
        (os.mkfifo, "a named pipe"),
        (os.mkdir, "a folder"),
        (lambda p: p.symlink_to("/dev/zero"), "a device"),
        (lambda p: p.symlink_to(p.name), "links that lead in a circle"),
        (lambda p: p.symlink_to("nowhere"), "no such file"),
        (lambda p: sparse(p, size=2**31), "of at most"),
    ],
)
def test_what_is_no_plain_file_is_not_opened(tmp_path: Path, make: Callable[[Path], None], got: str) -> None:
    path = tmp_path / "x"
    make(path)
    for read in (whole_bytes, whole_text):
        with pytest.raises(InputError, match=f"{path}: expected words.*{got}"):
            read(path, "words")


@pytest.mark.parametrize("text", ["n" * 256, "a/" + "é" * 128, "a\0b", "~nobody_of_that_name/x", "\ud800"])
def test_paths_that_no_file_can_have(text: str) -> None:
    with pytest.raises(InputError, match="--out: expected"):
        user_path(text, "--out")


def test_a_home_folder_is_expanded_and_odd_names_stay(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert user_path("~/x") == tmp_path / "x"
    name = os.fsdecode(b"\xff\xfe")
    assert user_path(name) == Path(name) and user_path("n" * 255) == Path("n" * 255)


def test_a_folder_that_cannot_be_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "shut").mkdir()

    def listed(path: object) -> list[str]:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "listdir", listed)  # as root every folder can be
    for read in (entries_of, lambda p: open_source(p, SourceConfig())):
        with pytest.raises(InputError, match=r"shut: expected .*, got permission denied"):
            read(tmp_path / "shut")


@pytest.mark.parametrize("data", [b"[" * 100_000, b"{", b"[1]", b"\xff{}", b"", b"nul"])
def test_json_that_is_no_object(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "x.json").write_bytes(data)
    with pytest.raises(InputError, match=r"x\.json: expected"):
        whole_json(tmp_path / "x.json")


@pytest.mark.parametrize(
    "text",
    [
        "[" * 5000,
        "a: &a [*a]",
        "!!int x",
        "!!float ''",
        "!!bool maybe",
        "!!python/object/apply:os.system [ls]",
        "\x00",
        "a: &a [1,1,1,1,1,1,1,1,1,1]\nb: &b [*a,*a,*a,*a,*a,*a,*a,*a,*a,*a]\nc: &c [*b,*b,*b,*b,*b,*b,*b,*b,*b,*b]\n"
        "d: &d [*c,*c,*c,*c,*c,*c,*c,*c,*c,*c]\ne: [*d,*d,*d,*d,*d,*d,*d,*d,*d,*d]",
    ],
)
def test_yaml_that_is_not_read(text: str) -> None:
    with pytest.raises(ConfigError, match=r"^here: expected readable YAML, got ") as refused:
        yaml_value(text, "here", ConfigError)
    assert "\n" not in str(refused.value)


def test_yaml_of_plain_values() -> None:
    assert yaml_value("a: 2024-01-01\nb: [1, .nan]\nc: !!timestamp x", "", ConfigError)["a"] == "2024-01-01"
    assert yaml_value("", "", ConfigError) is None
    assert yaml_value("base: &x {a: 1}\nb: {<<: *x}", "", ConfigError)["b"] == {"a": 1}


def test_arrays_say_their_size_first(tmp_path: Path) -> None:
    path = tmp_path / "x.npy"
    good = np.arange(12, dtype=np.float32).reshape(3, 4)
    np.save(path, good)
    assert np.array_equal(array_of(path, "depth"), good)
    np.save(path, np.asfortranarray(good))
    assert np.array_equal(array_of(path, "depth"), good)
    for data in (
        npy_of((10**6, 10**6)),
        npy_of((2,), "|O", b"\0" * 16),
        npy_of((-3,)),
        b"\x93NUMPY",
        b"PK\x03\x04",
        b"",
    ):
        path.write_bytes(data)
        with pytest.raises(InputError, match=r"x\.npy: expected depth as \.npy, got a broken file"):
            array_of(path, "depth")
    np.savez(tmp_path / "x.npz", a=good.astype(np.int64))
    with pytest.raises(InputError, match="expected tracks, got a of type <i8, not <f4"):
        arrays_of(tmp_path / "x.npz", {"a": "<f4"}, "tracks")


def test_pictures_say_their_size_first(tmp_path: Path) -> None:
    path = tmp_path / "x.png"
    path.write_bytes(png_of(13_000, 13_000))
    with pytest.raises(InputError, match="expected at most 80000000 pixels, got 13000x13000"), opened(path):
        pass


@pytest.mark.parametrize(
    "data",
    [
        HEAD + b"\0" * 7,
        HEAD + b"\0" * 9,
        HEAD.replace(b"vertex 2", b"vertex -2"),
        HEAD.replace(b"vertex 2", "vertex ²".encode()),
        HEAD.replace(b"vertex 2", b"vertex"),
        HEAD.replace(b"vertex 2", b"face 2"),
        HEAD.replace(b"float x", b"list uchar int x"),
        HEAD.replace(b"property float x\n", b""),
        HEAD.replace(b"property float x\n", b"property float x\n" * 2),
        HEAD.replace(b"little", b"big"),
        b"",
    ],
)
def test_ply_that_is_not_what_its_header_says(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "x.ply").write_bytes(data)
    with pytest.raises(InputError, match=r"x\.ply: expected"):
        read_vertices(tmp_path / "x.ply")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("status", "done"),
        ("choices", "x"),
        ("states", [["tracked", 10**10, 1]]),
        ("states", [["asleep", 1]]),
        ("source", ["x"]),
        ("source.path", 3),
        ("map.median_depth", 0),
        ("map.median_depth", "near"),
        ("timings_s", {"a": float("inf")}),
        ("files", {"1.0": []}),
    ],
)
def test_a_record_is_refused_by_the_name_of_its_field(field: str, value: object) -> None:
    outer, _, inner = field.partition(".")
    record = {outer: {inner: value} if inner else value}
    with pytest.raises(InputError, match=rf"^run\.json {field}: expected "):
        checked_record(record, Path("run.json"))


def test_a_camera_and_figures_are_refused_by_the_name_of_their_field(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    good = (
        '{"fx_px": 60.0, "fy_px": 60.0, "cx_px": 31.5, "cy_px": 23.5, "width": 64, "height": 48, "distortion": [0, 0]}'
    )
    path.write_text(good)
    assert checked_camera(path)[0].width == 64
    for old, new, key in (
        ('"width": 64', '"width": 0', "width"), ('"fx_px": 60.0', '"fx_px": 0', "fx_px"),
        ('"cy_px": 23.5', '"cy_px": NaN', "cy_px"), ("[0, 0]", '["x"]', "distortion"), ("64", "10000000", "pixels"),
        ('"fy_px": 60.0, ', "", "fy_px"),
    ):  # fmt: skip
        path.write_text(good.replace(old, new))
        with pytest.raises(InputError, match=rf"camera\.json.*{key}"):
            checked_camera(path)
    (tmp_path / "metrics.json").write_text('{"ate_rmse_all": "low"}')
    with pytest.raises(InputError, match=r"metrics\.json ate_rmse_all: expected a number"):
        checked_metrics(tmp_path / "metrics.json")


@pytest.mark.skipif(os.name == "nt", reason="files have no mode there")
@pytest.mark.parametrize("shut", ["photos", "photos/rgb", "photos/rgb.txt", "run", "run/run.json"])
def test_what_may_not_be_read_is_one_line(tmp_path: Path, shut: str) -> None:
    (tmp_path / "photos" / "rgb").mkdir(parents=True)
    (tmp_path / "photos" / "rgb.txt").write_text("0 rgb/0.png\n1 rgb/1.png\n")
    for n in range(2):
        Image.fromarray(blobs(1)[0]).save(tmp_path / f"photos/rgb/{n}.png")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text("{}")
    run = ["run", "photos", "--out", "out", "--no-map", "--quiet"]
    commands = [run] if shut.startswith("photos") else [["eval", "run", "photos"], ["resume", "run"]]
    code = f"import helpers, os; from mastd3r.cli.main import main; helpers.give_up_rights(); os.chmod({shut!r}, 0)"
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    words = [sys.executable, "-c", f"{code}; print([main(words) for words in {commands!r}])"]
    done = subprocess.run(words, cwd=tmp_path, env=env, capture_output=True, text=True, check=False)
    (tmp_path / shut).chmod(0o755)
    lines = done.stderr.splitlines()
    assert done.stdout.strip() == str([2] * len(commands)) and len(lines) == len(commands), done.stderr
    assert all(line.startswith("mastd3r: ") and "expected" in line for line in lines), lines
    told = ("permission denied", "may not be read", "got no rgb/0.png")
    assert any(words in lines[0] for words in told), lines


def test_reading_leaves_pipes_alone(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "v.mp4")
    with pytest.raises(InputError, match="got a named pipe, a socket or a device"):
        open_source(tmp_path / "v.mp4", SourceConfig())
    assert stat.S_ISFIFO((tmp_path / "v.mp4").lstat().st_mode)
