"""Many sources, a run each: what LIST means, what is tried again, what is kept, and what an end leaves."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from mastd3r.cli.main import main
from mastd3r.errors import InputError, OutputError
from mastd3r.tasks import lock as lock_module
from mastd3r.tasks.batch import MEMORY_MIB, Batch, claim_batch, names_for, sources_of
from mastd3r.tasks.process import Ended
from mastd3r.tasks.processes import Limits, Processes
from mastd3r.tasks.runner import Change, Task, run_tasks

# A command that takes no time: it counts its attempts beside its log, and ends as it is told.
FAKE = """
import os, pathlib, sys, time
tries, fates = pathlib.Path(sys.argv[1]), sys.argv[2].split(",")
with tries.open("a") as file:
    file.write("x")
fate = fates[min(tries.stat().st_size, len(fates)) - 1]
if fate == "dies":
    os.kill(os.getpid(), 9)
if fate == "fails":
    sys.exit("mastd3r: a.mp4: expected a video, got nothing")
if fate == "bad":
    print("mastd3r: a.mp4: expected a video, got nothing", file=sys.stderr)
    sys.exit(2)
time.sleep(float(fate))
"""
# What ``mastd3r run SOURCE --out OUT …`` leaves.
RUN = """
import json, os, pathlib, sys
words = sys.argv[1:]
source, out = words[2], pathlib.Path(words[4])
with open(out.parent / "started.txt", "a") as file:
    file.write(out.name + "\\n")
if not os.path.exists(source):
    print(f"mastd3r: {source}: expected a video or a folder of images, got no such path", file=sys.stderr)
    sys.exit(2)
out.mkdir(exist_ok=True)
(out / "run.json").write_text(json.dumps({"status": "complete", "command": words}))
"""


def task(folder: Path, name: str, fates: str) -> Task:
    argv = [sys.executable, "-c", FAKE, str(folder / f"{name}.tries"), fates]
    return Task(name, lambda attempt: argv, folder / f"{name}.log", folder / name)


def attempts(folder: Path, name: str) -> int:
    return (folder / f"{name}.tries").stat().st_size


def run_all(tasks: list[Task], allowed: Limits, need_mib: float = 100, retries: int = 0) -> dict[str, Change]:
    last: dict[str, Change] = {}

    def changed(change: Change) -> None:
        last[change.task.name] = change

    run_tasks(tasks, Processes(allowed), lambda them: {t.name: need_mib for t in them}, changed, retries=retries)
    return last


def test_what_is_killed_is_tried_again_and_what_fails_is_not(tmp_path: Path) -> None:
    fates = {"once": "dies,0", "always": "dies", "bad": "bad", "fault": "fails", "good": "0"}
    ends = run_all([task(tmp_path, n, f) for n, f in fates.items()], Limits(2, 1000), retries=2)
    tried = {name: attempts(tmp_path, name) for name in fates}
    assert tried == {"once": 2, "always": 3, "bad": 1, "fault": 1, "good": 1}
    codes = {name: c.ended.exit_code for name, c in ends.items() if c.ended is not None}
    assert codes == {"once": 0, "always": -9, "bad": 2, "fault": 1, "good": 0}
    assert all(c.state == "ended" and c.attempt == tried[n] for n, c in ends.items())
    bad, always = ends["bad"].ended, ends["always"].ended
    assert bad is not None and bad.reason == "a.mp4: expected a video, got nothing"
    assert always is not None and "signal 9" in always.reason


def test_more_memory_for_what_was_killed(tmp_path: Path) -> None:
    """Two at a time have room, but not beside one that was killed once: it is taken to need twice as much."""
    began, most = dict[str, float](), dict[str, int]()
    tasks = [task(tmp_path, "killed", "dies,0.3"), *(task(tmp_path, f"other{n}", "0.3") for n in range(2))]

    def changed(change: Change) -> None:
        began[change.task.name] = time.monotonic()
        most[change.task.name] = change.at_once

    run_tasks(tasks, Processes(Limits(3, 250)), lambda them: {t.name: 100 for t in them}, changed, retries=1)
    assert most["other0"] == 2 and most["killed"] == 1


def test_what_a_command_took_is_known(tmp_path: Path) -> None:
    argv = [sys.executable, "-c", "x = b'x' * 2**27\nn = 0\nwhile n < 3e6: n += 1"]
    ends = run_all([Task("a", lambda _: argv, tmp_path / "a.log", tmp_path / "a")], Limits(1, 1000))
    ended = ends["a"].ended
    assert ended is not None and ended.exit_code == 0
    assert ended.processor_s is not None and 0.02 < ended.processor_s < 1.5 * ended.wall_s + 0.5
    assert ended.peak_mib is not None and ended.peak_mib > 128


def test_ended_says_why() -> None:
    assert Ended(None, "node x is lost", 1.0).killed and Ended(None, "node x is lost", 1.0).reason == "node x is lost"
    assert Ended(-15, "", 1.0).killed and Ended(130, "mastd3r: stopped; what was", 1.0).killed
    assert not Ended(3, "", 1.0).killed and Ended(3, "", 1.0).reason == "exit code 3 and no message"


# -- which sources -----------------------------------------------------------------------------------------------


def test_a_list_a_folder_of_videos_and_sources(tmp_path: Path) -> None:
    folder = tmp_path / "videos"
    folder.mkdir()
    for name in ("b.mp4", "a.MOV", "notes.txt", ".hidden.mp4"):
        (folder / name).touch()
    listed = tmp_path / "list.txt"
    listed.write_text("\ufeff# first\n\n  videos/b.mp4  \nnowhere.mp4\nvideos/../videos/b.mp4\n", encoding="utf-8")
    images = tmp_path / "images"
    images.mkdir()
    sources, twice = sources_of([listed, folder, images])
    assert [p.relative_to(tmp_path).as_posix() for p in sources] == [
        "videos/b.mp4", "nowhere.mp4", "videos/a.MOV", "images",
    ]  # fmt: skip
    assert len(twice) == 2 and twice[0].startswith(f"{listed}:5: ") and "named before" in twice[0]


@pytest.mark.parametrize(
    ("text", "said"),
    [("", "got none"), ("# nothing\n\n", "got none"), ("a\0b\n", ":1: expected a path"), ("x" * 300, "255 bytes")],
)
def test_a_list_without_sources_is_refused(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "list.txt").write_text(text)
    with pytest.raises(InputError, match=said):
        sources_of([tmp_path / "list.txt"])
    with pytest.raises(InputError, match="no such path"):
        sources_of([tmp_path / "list.csv"])
    (tmp_path / "list.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="no UTF-8"):
        sources_of([tmp_path / "list.txt"])


def test_names_are_safe_each_once_and_kept() -> None:
    sources = [
        Path(p) for p in ("/a/walk.mp4", "/b/walk.mov", "/b/Walk", "/c/..", "/c/logs", "/c/ü b:c.mp4", "/d/é" * 1)
    ]
    sources.append(Path("/e") / ("ä" * 120))
    names = list(names_for(sources, {}).values())
    assert names[:6] == ["walk", "walk-2", "Walk-3", "run", "logs-2", "ü_b_c"]
    assert len({n.casefold() for n in names}) == len(names) and all(len(n.encode()) <= 110 for n in names)
    known = {"/b/walk.mov": "walk-2"}
    assert names_for([Path("/z/walk.mp4"), Path("/b/walk.mov")], known) == {
        Path("/b/walk.mov"): "walk-2", Path("/z/walk.mp4"): "walk",
    }  # fmt: skip


# -- a batch and its folder --------------------------------------------------------------------------------------


def batch_of(tmp_path: Path, *options: str, names: tuple[str, ...] = ("a", "b"), overwrite: bool = False) -> Batch:
    sources = [tmp_path / "in" / name for name in names]
    program = [sys.executable, "-c", RUN]
    claim_batch(tmp_path / "out", sources)
    return Batch(tmp_path / "out", sources, options, overwrite=overwrite, program=program)


def go(batch: Batch) -> list[str]:
    """Names of the runs that were started."""
    said = batch.out / "started.txt"
    said.unlink(missing_ok=True)
    run_tasks(batch.missing(), Processes(Limits(2, 1e5)), batch.needs, lambda c: batch.note(c) and None)
    return sorted(said.read_text().split()) if said.exists() else []


def record_of(out: Path) -> dict[str, Any]:
    record: dict[str, Any] = json.loads((out / "batch.json").read_text())
    return record


def test_what_is_complete_is_kept_unless_it_was_another_command(tmp_path: Path) -> None:
    (tmp_path / "in" / "a").mkdir(parents=True)
    assert go(batch_of(tmp_path)) == ["a", "b"]
    a, b = record_of(tmp_path / "out")["runs"]
    assert (a["state"], a["exit_code"], a["attempts"]) == ("complete", 0, 1) and a["wall_s"] > 0
    assert (b["state"], b["exit_code"]) == ("failed", 2) and "no such path" in b["reason"]
    assert go(batch_of(tmp_path)) == ["b"]  # it may be there now
    (tmp_path / "in" / "b").mkdir()
    assert go(batch_of(tmp_path)) == ["b"]
    assert go(batch_of(tmp_path)) == []
    assert [r["state"] for r in record_of(tmp_path / "out")["runs"]] == ["complete", "complete"]
    assert record_of(tmp_path / "out")["runs"][0]["wall_s"] == a["wall_s"]
    assert go(batch_of(tmp_path, "--no-map")) == ["a", "b"]
    assert go(batch_of(tmp_path, "--no-map", overwrite=True)) == ["a", "b"]
    assert go(batch_of(tmp_path, "--no-map")) == []
    assert go(batch_of(tmp_path, "--no-map", names=("b",))) == []
    assert [r["name"] for r in record_of(tmp_path / "out")["runs"]] == ["b", "a"]  # what is not asked for now stays


def test_memory_is_what_runs_of_the_batch_took(tmp_path: Path) -> None:
    (tmp_path / "in" / "a").mkdir(parents=True)
    batch = batch_of(tmp_path)
    assert set(batch.needs(batch.missing()).values()) == {MEMORY_MIB}
    a, b = batch.missing()
    batch.note(Change(a, "started", 1))
    batch.note(Change(a, "ended", 1, Ended(0, "", 1.0, 1.0, peak_mib=400.0)))
    assert batch.needs([b]) == {"b": pytest.approx(440.0)}


def test_a_folder_is_for_one_batch_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "in" / "a").mkdir(parents=True)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").touch()
    with pytest.raises(OutputError, match="expected an empty folder or an earlier batch"):
        batch_of(tmp_path)
    (tmp_path / "out" / "batch.json").write_text("{")
    with pytest.raises(OutputError, match=r"batch\.json: expected readable JSON"):
        batch_of(tmp_path)
    (tmp_path / "out" / "batch.json").write_text('{"made_by": "somebody", "runs": []}')
    with pytest.raises(OutputError, match="expected that of an earlier batch"):
        batch_of(tmp_path)
    with pytest.raises(OutputError, match="expected a folder outside what is read"):
        claim_batch(tmp_path / "in" / "a" / "out", [tmp_path / "in" / "a"])
    mine = {"made_by": "mastd3r batch", "runs": [{"name": "../../etc", "source": "x", "state": "complete"}, 7]}
    (tmp_path / "out" / "batch.json").write_text(json.dumps(mine))
    assert list(batch_of(tmp_path).runs) == ["a", "b"]


# -- the command -------------------------------------------------------------------------------------------------


def test_bad_input_is_one_line_and_starts_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    listed = tmp_path / "list.txt"
    listed.write_text("a.mp4\n")
    for words, said in (
        ([str(tmp_path / "none.txt")], "got no such path"),
        ([str(listed), "--jobs", "0"], "--jobs: expected 1 or more"),
        ([str(listed), "--memory-mib", "10"], "--memory-mib: expected 1500 or more, which a may need, got 10"),
        ([str(listed), "--retries", "-1"], "--retries: expected 0 or more"),
        ([str(listed), "--set", "graph.nothing=1"], "graph"),
        ([str(listed), "--no-map", "--quality", "high"], "expected a map to be made"),
        ([str(listed), "--maps", "x"], "unrecognized"),
    ):
        assert main(["batch", *words, "--out", str(tmp_path / "out")]) == 2
        err = capsys.readouterr().err.splitlines()
        assert said in err[-1] and len([line for line in err if line.startswith("mastd3r: ")]) == 1
    assert not (tmp_path / "out" / "a").exists()


def test_a_fault_of_ours_is_one_line_that_names_its_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    failing = [sys.executable, "-c", "import sys; sys.exit('mastd3r: unexpected ValueError: 3; run.log holds it')"]
    monkeypatch.setitem(Batch.__init__.__kwdefaults__, "program", failing)
    listed = tmp_path / "list.txt"
    listed.write_text("a.mp4\n" * 30)
    assert main(["batch", str(listed), "--out", str(tmp_path / "out")]) == 1
    lines = capsys.readouterr().err.splitlines()
    log = tmp_path / "out" / "logs" / "a.log"
    assert lines[-1] == (
        f"mastd3r: batch: a ended by a fault of ours: unexpected ValueError: 3; run.log holds it; its log is {log}"
    )
    assert log.is_file() and sum("is named before" in line for line in lines) == 10 and "and 19 more" in lines[10]


def test_a_second_batch_in_the_folder_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("fcntl")
    monkeypatch.setattr(lock_module, "LOCK_WAIT_S", 0.3)
    (tmp_path / "a.mp4").touch()
    words = ["batch", str(tmp_path / "a.mp4"), "--out", str(tmp_path / "out"), "--no-map"]
    (tmp_path / "out").mkdir()
    with lock_module.alone_in(tmp_path / "out", "batch"):
        assert main(words) == 2
    assert "expected no other batch at work in it" in capsys.readouterr().err
    assert not (tmp_path / "out" / "batch.json").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_ctrl_c_ends_the_runs_and_the_same_command_goes_on(room_clip: Path, tmp_path: Path) -> None:
    listed = tmp_path / "list.txt"
    listed.write_text(f"{room_clip}\nmissing.mp4\n")
    out = tmp_path / "out"
    words = [sys.executable, "-m", "mastd3r", "batch", str(listed), "--out", str(out), "--no-map", "--end=16"]
    batch = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    end = time.monotonic() + 60
    while not any((out / "room" / "checkpoint").glob("state-*.ckpt")) and time.monotonic() < end:
        time.sleep(0.02)
    batch.send_signal(signal.SIGTERM)
    _, said = batch.communicate(timeout=60)
    assert batch.returncode == 130 and said.splitlines()[-1].startswith("mastd3r: stopped; runs that are complete stay")
    left = json.loads((out / "room" / "run.json").read_text())["status"]
    assert left in ("incomplete", "running")  # it is killed where it takes too long, as a first run that compiles may
    assert record_of(out)["runs"][0]["state"] == "waiting"
    again = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    assert again.returncode == 2 and "missing failed" in again.stderr.splitlines()[-1]
    run = json.loads((out / "room" / "run.json").read_text())
    assert run["status"] == "complete" and any("resumed from the checkpoint" in c for c in run["choices"])
    assert [r["state"] for r in record_of(out)["runs"]] == ["complete", "failed"]
