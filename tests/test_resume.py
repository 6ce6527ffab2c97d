"""Checkpoints: a run that was killed at any moment goes on, and ends as one that was never stopped."""

from __future__ import annotations

import json
import os
import pickle
import random
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mastd3r.cli.main import main
from mastd3r.errors import OutputError
from mastd3r.export import files
from mastd3r.export.checkpoint import CheckpointStore
from mastd3r.graph.factors import ReprojectionFactor
from mastd3r.types import WorkFrame

FRAMES = ("--no-map", "--end", "14")
OFTEN = (  # slowly, so that there is time to kill it in a stage
    "import sys, time; from mastd3r.offline import checkpoints; from mastd3r.cli.main import main; "
    "from mastd3r.export.run_folder import RunFolder; write = RunFolder.write_mask; "
    "RunFolder.write_mask = lambda *a: (time.sleep(0.2), write(*a)); "
    "from mastd3r.offline.job import RunJob; after = RunJob.after; "
    "RunJob.after = lambda *a: (time.sleep(0.05), after(*a)); "
    "checkpoints.EVERY_S, checkpoints.MOST_OF_TIME = 0.1, 1.0; sys.exit(main(sys.argv[1:]))"
)


# -- the store -------------------------------------------------------------------------------------------------------


def frame(seed: int) -> WorkFrame:
    rng = np.random.default_rng(seed)
    gray = rng.integers(0, 255, (60, 80), np.uint8)
    return WorkFrame(seed, seed / 10, gray, rng.random((48, 2)), (6, 8), rng.random(48), None, None)


def edges(count: int) -> list[ReprojectionFactor]:
    rng = np.random.default_rng(count)
    return [ReprojectionFactor(n, n + 1, rng.random((500, 2)), rng.random(500)) for n in range(count)]


def size_of(folder: Path) -> int:
    return sum(p.stat().st_size for p in folder.glob("arrays-*.bin"))


def test_what_is_written_comes_back_and_can_be_changed(tmp_path: Path) -> None:
    first, second = frame(1), frame(2)
    given = {"frames": [first, second, first], "edges": edges(3), "pose": np.eye(4), "name": "x", "none": None}
    CheckpointStore(tmp_path / "c", "1").save(given)
    back = CheckpointStore(tmp_path / "c", "1").load()
    assert back is not None and back["frames"][0] is back["frames"][2]
    assert np.array_equal(back["frames"][1].gray, second.gray) and back["frames"][1].timestamp_s == 0.2
    assert all(np.array_equal(a.target, b.target) for a, b in zip(back["edges"], given["edges"], strict=True))
    back["edges"][0].weight[:] = 0  # what is restored is as good as new
    assert back["name"] == "x" and back["none"] is None and np.array_equal(back["pose"], np.eye(4))


def test_what_has_not_changed_is_not_written_again(tmp_path: Path) -> None:
    store, known = CheckpointStore(tmp_path / "c", "1"), [frame(n) for n in range(5)]
    held = edges(20)
    store.save((known, held))
    before = size_of(tmp_path / "c")
    held[3].weight = np.zeros(500)
    known.append(frame(9))
    store.save((known, held))
    grown = size_of(tmp_path / "c") - before
    assert 0 < grown < before / 10
    assert sorted(p.name for p in (tmp_path / "c").iterdir()) == ["arrays-0.bin", "state-0.ckpt", "state-1.ckpt"]
    back = CheckpointStore(tmp_path / "c", "1").load()
    assert back is not None and not back[1][3].weight.any() and len(back[0]) == 6


def test_an_array_that_was_changed_in_place_is_written_again(tmp_path: Path) -> None:
    store, held = CheckpointStore(tmp_path / "c", "1"), edges(2)
    store.save(held)
    held[0].weight[:] = 7
    store.save(held)
    back = CheckpointStore(tmp_path / "c", "1").load()
    assert back is not None and (back[0].weight == 7).all()


def test_what_nobody_needs_any_more_goes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mastd3r.export.checkpoint.GARBAGE_BYTES", 0)
    store = CheckpointStore(tmp_path / "c", "1")
    for n in range(12):
        store.save([frame(n), np.full(10000, float(n))])
    assert size_of(tmp_path / "c") < 8 * 85000 < 12 * 80000
    back = CheckpointStore(tmp_path / "c", "1").load()
    assert back is not None and (back[1] == 11).all() and back[0].index == 11


def damage_body(folder: Path) -> None:
    path = folder / "state-1.ckpt"
    data = bytearray(path.read_bytes())
    data[-5] ^= 255
    path.write_bytes(data)


def damage_head(folder: Path) -> None:
    path = folder / "state-1.ckpt"
    data = bytearray(path.read_bytes())
    data[40] ^= 255
    path.write_bytes(data)


def cut_off(folder: Path) -> None:
    path = folder / "state-1.ckpt"
    path.write_bytes(path.read_bytes()[:50])


def damage_new_arrays(folder: Path) -> None:
    path = folder / "arrays-0.bin"
    data = bytearray(path.read_bytes())
    data[-100] ^= 255
    path.write_bytes(data)


def nothing_in_it(folder: Path) -> None:
    (folder / "state-1.ckpt").write_bytes(b"")


@pytest.mark.parametrize("damage", [damage_body, damage_head, cut_off, damage_new_arrays, nothing_in_it])
def test_the_last_good_one_is_taken_and_the_other_named(
    damage: Callable[[Path], None], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = CheckpointStore(tmp_path / "c", "1")
    store.save([np.arange(1000.0)])
    store.save([np.arange(1000.0), np.ones(1000)])
    damage(tmp_path / "c")
    with caplog.at_level("WARNING", logger="mastd3r.export.checkpoint"):
        back = CheckpointStore(tmp_path / "c", "1").load()
    assert back is not None and len(back) == 1 and np.array_equal(back[0], np.arange(1000.0))
    assert "state-1.ckpt: not used" in caplog.text


def test_one_of_another_version_is_named_and_left(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    CheckpointStore(tmp_path / "c", "1").save([1])
    with caplog.at_level("WARNING", logger="mastd3r.export.checkpoint"):
        assert CheckpointStore(tmp_path / "c", "2").load() is None
    assert "expected one of version 2, got version 1" in caplog.text


def test_one_of_another_format_is_named_and_left(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same version, as between two releases: what a part remembers may have changed."""
    CheckpointStore(tmp_path / "c", "1").save([1])
    monkeypatch.setattr("mastd3r.export.checkpoint.FORMAT", 99)
    with caplog.at_level("WARNING", logger="mastd3r.export.checkpoint"):
        assert CheckpointStore(tmp_path / "c", "1").load() is None
    assert "expected one in format 99, got format 2" in caplog.text


class _Runs:
    """Code, in place of data."""

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.system, ("touch hacked",)


def test_a_checkpoint_is_not_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    CheckpointStore(tmp_path / "c", "1").save(_Runs())
    assert CheckpointStore(tmp_path / "c", "1").load() is None
    assert not (tmp_path / "hacked").exists()
    assert pickle.loads(pickle.dumps(_Runs())) == 0 and (tmp_path / "hacked").exists()  # elsewhere it would be


def test_on_a_full_disk_the_last_one_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = CheckpointStore(tmp_path / "c", "1")
    store.save([np.arange(1000.0)])

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "replace", full)
    with pytest.raises(OutputError, match="No space left"):
        store.save([np.zeros(1000)])
    monkeypatch.undo()
    back = CheckpointStore(tmp_path / "c", "1").load()
    assert back is not None and np.array_equal(back[0], np.arange(1000.0))


# -- whole runs ------------------------------------------------------------------------------------------------------


def started(*words: str | Path) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", OFTEN, *map(str, words), "--quiet"], stderr=subprocess.PIPE)


def record_of(run: Path) -> dict[str, Any]:
    record: dict[str, Any] = json.loads((run / "run.json").read_text())
    return record


def killed(process: subprocess.Popen[bytes], moment: Callable[[], bool]) -> None:
    until = time.monotonic() + 120
    while not moment() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.01)
    assert process.poll() is None, process.communicate()
    process.kill()
    process.communicate()


def command(*words: str | Path) -> int:
    """In a process of its own, as those that are killed: one that has compiled a kernel rounds its last digits apart
    from one that has found it compiled."""
    return subprocess.run([sys.executable, "-m", "mastd3r", *map(str, words), "--quiet"], check=False).returncode


@pytest.fixture(scope="module")
def undisturbed(room_clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("undisturbed")
    for out in (folder / "compiles", folder / "run"):
        assert command("run", room_clip, "--out", out, *FRAMES) == 0
        assert not (out / "checkpoint").exists()
    return folder / "run"


def states(run: Path) -> int:
    found = [int(p.stem.split("-")[1]) for p in (run / "checkpoint").glob("state-*.ckpt")]
    return max(found, default=-1)


def masks(run: Path) -> int:
    return len(list((run / "masks").glob("*.png")))


MOMENTS: dict[str, tuple[Callable[[Path], bool], str]] = {
    "tracking": (lambda run: states(run) >= 4, "checkpoint at frame"),
    "masks": (lambda run: masks(run) >= 5, "checkpoint at the end of: solved"),
    "the first moment": (lambda run: (run / "config.yaml").exists(), "from the first frame"),
}


@pytest.mark.parametrize("moment", MOMENTS)
def test_a_killed_run_goes_on_and_ends_as_if_it_had_not_been(
    moment: str, room_clip: Path, undisturbed: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    reached, said = MOMENTS[moment]
    killed(started("run", room_clip, "--out", run, *FRAMES), lambda: reached(run))
    assert record_of(run)["status"] == "running"
    assert command("resume", run) == 0
    for name in ("trajectory.txt", "states.txt", "camera.json", "cloud.ply"):
        assert (run / name).read_bytes() == (undisturbed / name).read_bytes(), name
    record = record_of(run)
    assert record["status"] == "complete" and not (run / "checkpoint").exists()
    assert any(said in choice for choice in record["choices"]), record["choices"]
    assert sum(count for _, count in record["states"]) == 14


def test_the_same_command_goes_on_and_another_does_not(room_clip: Path, undisturbed: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    killed(started("run", room_clip, "--out", run, *FRAMES), lambda: states(run) >= 4)
    same = ("run", room_clip, "--out", run, *FRAMES)
    assert command(*same[:-1], "12") == 0
    assert not any("resumed" in choice for choice in record_of(run)["choices"])
    killed(started("run", room_clip, "--out", run, *FRAMES), lambda: states(run / "unfinished") >= 4)
    assert command(*same) == 0
    assert any("resumed" in choice for choice in record_of(run)["choices"])
    assert (run / "trajectory.txt").read_bytes() == (undisturbed / "trajectory.txt").read_bytes()
    assert not (run / "unfinished").exists()


def test_what_cannot_be_resumed_is_one_line(
    undisturbed: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for path, words in ((undisturbed, "a complete one"), (tmp_path / "no", "no such folder"), (tmp_path, "run.json")):
        assert main(["resume", str(path)]) == 2
        said = capfd.readouterr().err
        assert said.count("\n") == 1 and "expected a run that was stopped" in said and words in said


def test_a_source_that_has_gone_is_one_line(room_clip: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run"
    killed(started("run", room_clip, "--out", run, *FRAMES), lambda: states(run) >= 1)
    record = record_of(run)
    (run / "run.json").write_text(json.dumps({**record, "source": {"path": str(tmp_path / "gone.mp4"), "maps": None}}))
    assert main(["resume", str(run), "--quiet"]) == 2
    said = capfd.readouterr().err
    assert said.count("\n") == 1 and "gone.mp4" in said
    assert states(run) >= 1, "what was there is kept"


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_killed_at_twenty_random_moments(room_clip: Path, tmp_path: Path) -> None:
    """With the map, at the interval that users have."""
    words = ("run", room_clip, "--set", "mapping.iterations=200", "--out")
    assert command(*words, tmp_path / "compiles") == 0
    began = time.monotonic()
    assert command(*words, tmp_path / "whole") == 0
    whole_s, draw, killed_runs = time.monotonic() - began, random.Random(0), 0
    for n in range(20):
        run = tmp_path / str(n)
        process = subprocess.Popen([sys.executable, "-m", "mastd3r", *map(str, words), str(run), "--quiet"])
        while not (run / "config.yaml").exists():
            time.sleep(0.01)
        time.sleep(draw.random() * 0.8 * whole_s)
        process.kill()
        process.wait()
        if record_of(run)["status"] == "running":  # else it was faster than the one that was measured
            killed_runs += 1
            assert command("resume", run) == 0
        assert record_of(run)["status"] == "complete"
        assert (run / "trajectory.txt").read_bytes() == (tmp_path / "whole" / "trajectory.txt").read_bytes(), n
    assert killed_runs >= 15
