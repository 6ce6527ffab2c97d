"""Every end is an end: signals, faults of ours and want of memory leave a folder that says so, with all poses."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mastd3r import pipeline
from mastd3r.cli.main import main
from mastd3r.concurrency import stop_with, undivided
from mastd3r.export.files import write_json
from mastd3r.offline import job

ENDS = {"SIGINT": "Ctrl-C", "SIGTERM": "stopped by SIGTERM", "SIGHUP": "stopped by SIGHUP"}


SLOW_MASKS = (
    "import sys, time; from mastd3r.export.run_folder import RunFolder; from mastd3r.cli.main import main; "
    "write = RunFolder.write_mask; RunFolder.write_mask = lambda *a: (time.sleep(0.5), write(*a)); "
    "sys.exit(main(sys.argv[1:]))"
)  # so that there is time to come in between


def start_run(source: Path, out: Path, *words: str, slow_masks: bool = False) -> subprocess.Popen[bytes]:
    how = ["-c", SLOW_MASKS] if slow_masks else ["-m", "mastd3r"]
    argv = [sys.executable, *how, "run", str(source), "--out", str(out), "--quiet", *words]
    return subprocess.Popen(argv, stderr=subprocess.PIPE, preexec_fn=_heed_interrupts)  # noqa: PLW1509


def _heed_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def record_of(out: Path) -> dict[str, Any]:
    record: dict[str, Any] = json.loads((out / "run.json").read_text())
    return record


def wait_for(found: Callable[[], bool], process: subprocess.Popen[bytes], most_s: float = 120) -> None:
    until = time.monotonic() + most_s
    while not found() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.02)


def children_of(process_id: int) -> list[int]:
    found = subprocess.run(["ps", "-o", "pid=", "--ppid", str(process_id)], capture_output=True, text=True, check=False)
    return [int(word) for word in found.stdout.split()]


def ended_by(name: str, process: subprocess.Popen[bytes], out: Path) -> None:
    """Send it, and look at what is left."""
    children = children_of(process.pid)
    process.send_signal(getattr(signal, name))
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130 and said.startswith(b"mastd3r: stopped"), said
    assert said.count(b"\n") == 1
    record = record_of(out)
    assert record["status"] == "incomplete" and ENDS[name] in record["reason"]
    assert not (out / ".reserve").exists() and (out / "run.log").is_file()
    alive = subprocess.run(
        ["ps", "-o", "stat=", "-p", ",".join(map(str, children)) or "0"], capture_output=True, text=True, check=False
    )
    assert all(state.startswith("Z") for state in alive.stdout.split()), alive.stdout


@pytest.mark.parametrize("name", ENDS)
def test_a_signal_ends_a_run_as_ctrl_c_does(name: str, room_clip: Path, tmp_path: Path) -> None:
    """While the masks are made: every frame has its pose."""
    process = start_run(room_clip, tmp_path / "run", "--no-map", "--end", "16", slow_masks=True)
    wait_for(lambda: any((tmp_path / "run" / "masks").glob("*.png")), process)
    ended_by(name, process, tmp_path / "run")
    assert len(np.loadtxt(tmp_path / "run" / "trajectory.txt")) == 16


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("realtime", [False, True], ids=["offline", "realtime"])
@pytest.mark.parametrize("name", ENDS)
def test_signals_at_any_moment(name: str, realtime: bool, room_clip: Path, tmp_path: Path) -> None:
    """From the first moment of the folder to the last of an undisturbed run, ten of each."""
    words = ["--realtime"] if realtime else []
    began = time.monotonic()
    start_run(room_clip, tmp_path / "whole", *words, "--set", "mapping.iterations=300").communicate()
    whole_s = time.monotonic() - began
    for n in range(10):
        out = tmp_path / str(n)
        process = start_run(room_clip, out, *words, "--set", "mapping.iterations=300")
        wait_for((out / "run.json").exists, process)
        time.sleep(0.9 * whole_s * (n + 0.5) / 10 * 0.8)
        ended_by(name, process, out)


@pytest.mark.skipif(sys.platform == "win32", reason="no file locks of this kind")
def test_a_folder_that_a_run_is_writing_in_is_refused(
    room_clip: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    process = start_run(room_clip, out, "--no-map", "--end", "16", slow_masks=True)
    wait_for(lambda: any((out / "masks").glob("*.png")), process)
    before = (out / "trajectory.txt").read_bytes()
    again = ["run", str(room_clip), "--out", str(out), "--no-map", "--end", "16"]
    for words in (again, [*again, "--overwrite"], ["resume", str(out)]):
        assert main([*words, "--quiet"]) == 2
        assert "got one of a run that goes on" in capfd.readouterr().err
    assert (out / "trajectory.txt").read_bytes() == before
    process.kill()
    process.communicate()
    assert main(["resume", str(out), "--quiet"]) == 0


def test_an_ignored_signal_stays_ignored(room_clip: Path, tmp_path: Path) -> None:
    """``nohup``: the terminal may go."""
    argv = [sys.executable, "-m", "mastd3r", "run", str(room_clip), "--out", str(tmp_path / "run"), "--no-map"]
    process = subprocess.Popen(
        [*argv, "--end", "10", "--quiet"],
        stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN),  # noqa: PLW1509
    )
    wait_for((tmp_path / "run" / "run.json").exists, process)
    process.send_signal(signal.SIGHUP)
    assert process.wait(120) == 0 and record_of(tmp_path / "run")["status"] == "complete"


# -- what must not be divided ----------------------------------------------------------------------------------------


def test_a_request_to_stop_waits_for_the_end_of_the_block() -> None:
    done: list[int] = []
    with pytest.raises(KeyboardInterrupt, match="once"), undivided():
        with undivided():
            stop_with(KeyboardInterrupt("once"))
            done.append(1)
        done.append(2)
    assert done == [1, 2]
    with undivided():
        done.append(3)  # nothing is left over


def test_who_asks_twice_is_served_at_once() -> None:
    done: list[int] = []
    with pytest.raises(KeyboardInterrupt, match="twice"), undivided():
        stop_with(KeyboardInterrupt("once"))
        stop_with(KeyboardInterrupt("twice"))
        done.append(1)
    assert not done


def test_outside_it_stops_at_once() -> None:
    with pytest.raises(KeyboardInterrupt):
        stop_with(KeyboardInterrupt())


# -- faults ----------------------------------------------------------------------------------------------------------


def test_a_fault_of_ours_is_one_line_and_all_poses_are_kept(
    room_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise ValueError("shapes (3,) and (4,)\ndo not fit \x1b[31m")

    monkeypatch.setattr(job, "smooth_masks", broken)
    out = tmp_path / "run"
    assert main(["run", str(room_clip), "--out", str(out), "--no-map", "--quiet", "--end", "20"]) == 1
    said = capfd.readouterr().err
    assert said.count("\n") == 1 and said.startswith("mastd3r: unexpected ValueError: shapes (3,) and (4,) do not fit")
    assert "\x1b" not in said and str(out / "run.log") in said
    assert record_of(out)["reason"].startswith("unexpected ValueError")
    assert "Traceback" in (out / "run.log").read_text()
    assert len(np.loadtxt(out / "trajectory.txt")) == 20


def test_a_fault_while_tracking_is_an_end_too(
    room_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    after = job.RunJob.after

    def broken(self: job.RunJob, frame: Any) -> None:
        after(self, frame)
        if self.frames == 15:
            raise RuntimeError("half-way")

    monkeypatch.setattr(job.RunJob, "after", broken)
    out = tmp_path / "run"
    assert main(["run", str(room_clip), "--out", str(out), "--no-map", "--quiet"]) == 1
    assert len(np.loadtxt(out / "trajectory.txt")) == 15
    assert capfd.readouterr().err.count("\n") == 1


def test_a_fault_outside_a_run_names_a_file_with_its_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: Any) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.setattr(pipeline, "load", broken)
    assert main(["eval", str(tmp_path), str(tmp_path)]) == 1
    said = capfd.readouterr().err
    kept = next(tmp_path.glob("mastd3r-*.log"))
    assert said.count("\n") == 1 and str(kept) in said and "ZeroDivisionError" in kept.read_text()


def test_want_of_memory_is_said(
    room_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def greedy(*_: Any, **__: Any) -> None:
        raise MemoryError("Unable to allocate 90.0 TiB")

    monkeypatch.setattr(job, "smooth_masks", greedy)
    out = tmp_path / "run"
    assert main(["run", str(room_clip), "--out", str(out), "--no-map", "--quiet", "--end", "20"]) == 2
    said = capfd.readouterr().err
    assert said.count("\n") == 1 and "out of memory" in said and "90.0 TiB" in said
    assert record_of(out)["status"] == "incomplete"


def test_a_path_is_never_read_as_markup(room_clip: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "[/x] run [bold]"
    assert main(["run", str(room_clip), "--out", str(out), "--no-map", "--quiet", "--end", "12"]) == 0
    assert str(out / "report.html") in capfd.readouterr().out
    assert main(["export", str(out), "--to", "tum", "--out", str(tmp_path / "[/b].txt")]) == 0
    assert "[/b].txt" in capfd.readouterr().out


def test_complete_is_the_very_last_write(room_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is written after the line that says so."""
    written: list[str] = []

    def watched(path: Path, data: Any) -> None:
        written.append(f"{path.name} {data.get('status', '')}")
        write_json(path, data)

    monkeypatch.setattr("mastd3r.export.run_folder.write_json", watched)
    out = tmp_path / "run"
    assert main(["run", str(room_clip), "--out", str(out), "--no-map", "--quiet", "--end", "10"]) == 0
    assert [w for w in written if "complete" in w] == ["run.json complete"] == written[-1:]
    last = (out / "run.json").stat().st_mtime_ns
    assert all(p.stat().st_mtime_ns <= last for p in out.rglob("*") if p.is_file())
