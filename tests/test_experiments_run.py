"""Running a suite: in processes, within limits, only what is missing, and after a kill as if nothing had happened."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mastd3r.errors import ConfigError, OutputError
from mastd3r.experiments.execute import by_command_line, run_entries
from mastd3r.experiments.store import Store, read_results, results_of, thinned
from mastd3r.experiments.suite import Entry, SequenceSpec, entries_of, suite_from_dict
from mastd3r.tasks import lock as lock_module
from mastd3r.tasks.processes import Limits, limits

SUITE = suite_from_dict(
    {
        "title": "Tiny",
        "sequences": {"a": {}, "b": {}},
        "variants": {"one": {}, "two": {"set": {"correction": "none"}, "memory_mib": 300}},
        "seeds": [0, 1],
        "memory_mib": 200,
        "tables": [{"title": "t", "form": "variants", "metrics": ["ate_rmse_all"]}],
    },
    "tiny",
)
# A run that takes no time: it says when it began and ended, and leaves what a run leaves.
FAKE = """
import json, os, pathlib, sys, time
out, ate, wait_s, fate = pathlib.Path(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3]), sys.argv[4]
began = time.time()
assert not out.exists(), "what an interrupted run has left should be gone"
out.mkdir(parents=True)
(out / "run.json").write_text(json.dumps({"status": "running", "machine": {"cores": 1}}))
time.sleep(wait_s)
if fate == "fails":
    print("mastd3r: a.png: expected a readable image, got nothing", file=sys.stderr)
    sys.exit(2)
if fate == "dies":
    os.kill(os.getpid(), 9)
figures = {"ate_rmse_all": ate, "frames": 9, "frames_posed": 9, "peak_rss_mib": 50.0}
(out / "metrics.json").write_text(json.dumps({**figures, "began": began, "ended": time.time()}))
(out / "aligned.txt").write_text("# head\\n" + "".join(f"{t} {t}.12345 0 0 {t} 0 0\\n" for t in range(400)))
(out / "run.json").write_text(json.dumps({"status": "complete", "machine": {"cores": 1}, "source": {"size": [4, 3]}}))
"""


class Fake:
    """Starts such runs, and remembers which."""

    def __init__(self, wait_s: float = 0.0, fates: dict[str, str] | None = None) -> None:
        self.wait_s, self.fates, self.started = wait_s, fates or {}, list[str]()

    def __call__(self, entry: Entry, folder: Path, out: Path) -> list[str]:
        self.started.append(entry.label)
        ate = str(0.01 * (1 + entry.seed) * len(entry.label))
        return [sys.executable, "-c", FAKE, str(out), ate, str(self.wait_s), self.fates.get(entry.label, "works")]


def entries() -> list[Entry]:
    return entries_of(SUITE, SUITE.sequences or ())


def go(
    store: Store, chosen: list[Entry], fake: Fake, allowed: Limits | None = None
) -> list[tuple[str, dict[str, Any]]]:
    said: list[tuple[str, dict[str, Any]]] = []
    store.prepare()
    todo = [e for e in chosen if store.get(e) is None]
    folders = {"a": Path("a"), "b": Path("b")}
    run_entries(
        todo, folders, store, allowed or Limits(1, 1000), done=lambda e, r: said.append((e.label, r)), launch=fake
    )
    return said


def test_only_what_is_missing_runs(tmp_path: Path) -> None:
    store, fake = Store(tmp_path / "out"), Fake()
    assert [label for label, _ in go(store, entries()[:3], fake)] == [e.label for e in entries()[:3]]
    kept = {p: p.read_bytes() for p in store.entries.iterdir()}
    record = store.get(entries()[0])
    assert record is not None and record["status"] == "complete" and record["metrics"]["ate_rmse_all"] > 0
    assert {"config", "command", "machine", "seed", "wall_s", "date", "jobs", "source"} <= set(record)
    assert record["config"]["correction"] == "coarse-to-fine" and record["command"] == "mastd3r run a --out RUN"
    again = Fake()
    go(store, entries(), again)
    assert again.started == [e.label for e in entries()[3:]]
    assert {p: p.read_bytes() for p in kept} == kept


def test_half_a_record_and_a_half_written_run_are_redone(tmp_path: Path) -> None:
    store, entry = Store(tmp_path / "out"), entries()[0]
    store.prepare()
    (store.entries / f"{entry.id}.json").write_text('{"id": "')
    assert store.get(entry) is None
    (store.entries / f"{entry.id}.json").write_text('{"id": "another", "status": "complete"}')
    assert store.get(entry) is None
    store.run_folder(entry).mkdir()
    (store.run_folder(entry) / "trajectory.txt").write_text("half")
    fake = Fake()
    go(store, [entry], fake)
    assert fake.started == [entry.label] and (store.get(entry) or {})["status"] == "complete"
    assert not (store.run_folder(entry) / "trajectory.txt").exists()


def test_failures_are_recorded_and_stop_nothing(tmp_path: Path) -> None:
    store, chosen = Store(tmp_path / "out"), entries()[:3]
    go(store, chosen, Fake(fates={chosen[0].label: "fails", chosen[1].label: "dies"}))
    first, second, third = (store.get(e) or {} for e in chosen)
    assert (first["status"], first["error"]) == ("failed", "a.png: expected a readable image, got nothing")
    assert second["status"] == "failed" and "signal 9" in second["error"] and second["metrics"] == {}
    assert third["status"] == "complete"
    again = Fake()
    go(store, chosen, again)
    assert again.started == []  # a failure is a result; --retry is for those


def test_as_many_at_once_as_jobs_and_memory_allow(tmp_path: Path) -> None:
    store, chosen = Store(tmp_path / "out"), entries()[:4]  # 200, 200, 300, 300 MiB declared
    said = go(store, chosen, Fake(wait_s=0.3), Limits(jobs=3, memory_mib=450))
    spans = [(r["metrics"]["began"], r["metrics"]["ended"]) for _, r in said]
    assert max(r["jobs"] for _, r in said) == 2  # three jobs would be allowed, but not their memory
    assert _most_at_once(spans) <= 2
    alone = Store(tmp_path / "alone")
    spans = [(r["metrics"]["began"], r["metrics"]["ended"]) for _, r in go(alone, chosen[:2], Fake(wait_s=0.3))]
    assert _most_at_once(spans) == 1


def _most_at_once(spans: list[tuple[float, float]]) -> int:
    return max(sum(a <= began < b for a, b in spans) for began, _ in spans)


def test_memory_is_what_the_like_of_an_entry_took(tmp_path: Path) -> None:
    store, chosen = Store(tmp_path / "out"), entries()
    store.prepare()
    assert list(store.needs(chosen[:4]).values()) == [200, 200, 300, 300]
    go(store, chosen[:1], Fake())
    other_seed = next(e for e in chosen if e.label == "a/one/1")
    assert list(store.needs([other_seed, chosen[1]]).values()) == [50, 200]


def test_a_budget_that_one_entry_exceeds_is_refused_before_anything_runs(tmp_path: Path) -> None:
    fake = Fake()
    with pytest.raises(ConfigError, match="--memory-mib: expected 300 or more, which a/two/0 needs, got 250"):
        go(Store(tmp_path / "out"), entries(), fake, Limits(1, 250))
    assert fake.started == []


def test_limits() -> None:
    assert limits(None, None).jobs == 1 and limits(None, None).memory_mib > 100
    assert limits(3, 500) == Limits(3, 500)
    for jobs, memory in ((0, None), (None, 0), (None, -5.0), (None, float("nan"))):
        with pytest.raises(ConfigError, match="expected"):
            limits(jobs, memory)


def test_an_interrupted_bench_stops_its_runs_and_records_nothing_of_them(tmp_path: Path) -> None:
    store = Store(tmp_path / "out")
    store.prepare()

    def interrupted(entry: Entry, record: dict[str, Any]) -> None:
        raise KeyboardInterrupt

    began = time.monotonic()
    chosen = [e for e in entries() if e.sequence.name == "a"][:2]
    slow = Fake(wait_s=120)

    def launch(entry: Entry, folder: Path, out: Path) -> list[str]:
        return (Fake() if entry is chosen[0] else slow)(entry, folder, out)

    with pytest.raises(KeyboardInterrupt):
        run_entries(chosen, {"a": Path("a")}, store, Limits(2, 1000), done=interrupted, launch=launch)
    assert time.monotonic() - began < 60 and slow.started == [chosen[1].label]
    assert store.get(chosen[0]) is not None and store.get(chosen[1]) is None


KILLED = """
import sys
sys.path[:0] = [{tests!r}]
from pathlib import Path
from test_experiments_run import Fake, Store, entries, go
go(Store(Path({out!r})), entries(), Fake(wait_s=0.25))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_after_a_kill_nothing_is_redone_and_the_numbers_are_the_same(tmp_path: Path) -> None:
    whole, store = Store(tmp_path / "whole"), Store(tmp_path / "killed")
    go(whole, entries(), Fake())
    code = KILLED.format(tests=str(Path(__file__).parent), out=str(store.out))
    bench = subprocess.Popen([sys.executable, "-c", code])
    end = time.monotonic() + 60
    while not (store.entries.is_dir() and len(list(store.entries.glob("*.json"))) >= 2) and time.monotonic() < end:
        time.sleep(0.02)
    bench.send_signal(signal.SIGKILL)
    bench.wait()
    before = {p.name: p.stat().st_mtime_ns for p in store.entries.glob("*.json")}
    assert 2 <= len(before) < len(entries())
    rest = Fake()
    go(store, entries(), rest)
    assert len(rest.started) == len(entries()) - len(before)
    assert {name: (store.entries / name).stat().st_mtime_ns for name in before} == before
    for entry in entries():
        mine, theirs = store.get(entry), whole.get(entry)
        assert mine is not None and theirs is not None
        assert mine["metrics"]["ate_rmse_all"] == theirs["metrics"]["ate_rmse_all"]
        assert mine["config"] == theirs["config"] and mine["path"] == theirs["path"]


def test_a_folder_is_for_one_bench_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").touch()
    with pytest.raises(OutputError, match="expected an empty folder or an earlier bench"):
        Store(tmp_path / "thesis").prepare()
    pytest.importorskip("fcntl")
    monkeypatch.setattr(lock_module, "LOCK_WAIT_S", 0.3)
    store = Store(tmp_path / "out")
    store.prepare()
    with store.locked(), pytest.raises(OutputError, match="expected no other bench at work"), store.locked():
        pass
    with store.locked():
        pass


def test_the_command_is_that_of_a_run(tmp_path: Path) -> None:
    entry = entries()[2]
    words = by_command_line(entry, Path("data/a"), tmp_path / "run")
    assert words[1:5] == ["-m", "mastd3r", "run", "data/a"] and words[-1] == "--end-with-stdin"
    assert words[words.index("--set") + 1] == "correction=none"


def test_results_come_back_with_every_configuration_whole(tmp_path: Path) -> None:
    store, chosen = Store(tmp_path / "out"), entries()
    go(store, [chosen[0], chosen[2], chosen[4]], Fake())
    records = [r for e in chosen if (r := store.get(e)) is not None]
    (tmp_path / "info.json").write_text('{"composed": true}')
    results = results_of(SUITE, SUITE.sequences or (), {"a": tmp_path}, "mastd3r bench tiny", records)
    assert (results["missing"], results["composed"]) == (["b"], ["a"])
    assert results["config"]["tracking"] == records[0]["config"]["tracking"]
    own = {"correction": "none", "seed": 0, "source": {"start": 0}}  # what is not the same in all, and no more
    assert results["entries"][1]["config"] == own
    (tmp_path / "results.json").write_text(json.dumps(results))
    back = read_results(tmp_path / "results.json")
    assert [e["config"] for e in back["entries"]] == [r["config"] for r in records]
    assert ["path" in e for e in back["entries"]] == [True, True, False]  # of the first seed


def test_a_path_is_thinned(tmp_path: Path) -> None:
    (tmp_path / "aligned.txt").write_text("# h\n" + "".join(f"{t} {t}.123456 0 0 1 2 3\n" for t in range(400)))
    rows = thinned(tmp_path / "aligned.txt")
    assert 100 <= len(rows) <= 150 and rows[1].split() == ["3.1235", "0.0000", "0.0000", "1.0000", "2.0000", "3.0000"]


def test_a_run_ends_when_the_bench_is_gone(room_clip: Path, tmp_path: Path) -> None:
    """The child of a killed bench: its standard input closes, and it ends as on Ctrl-C."""
    entry = replace(entries()[0], sequence=SequenceSpec("room"))
    words = by_command_line(entry, room_clip, tmp_path / "run")
    child = subprocess.Popen(words, stdin=subprocess.PIPE, stderr=subprocess.PIPE)
    _, said = child.communicate(timeout=120)  # closes its input at once
    assert child.returncode == 130 and b"mastd3r: stopped" in said
