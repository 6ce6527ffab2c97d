"""Tasks on a real Ray cluster: two nodes in processes of this machine, one of which is killed in the middle."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mastd3r.cli.main import main
from mastd3r.config import Config
from mastd3r.errors import InputError
from mastd3r.offline import segmented
from mastd3r.offline.segmented import Segments
from mastd3r.pipeline import reconstruct
from mastd3r.sources import synthetic
from mastd3r.tasks.cluster import MARK, Asked
from mastd3r.tasks.cluster import Cluster as Place
from mastd3r.tasks.runner import Task, run_tasks

ray = pytest.importorskip("ray", reason="the extra [cluster] is not installed")
NAMES = ("a", "b", "c", "d", "e", "f")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]  # a minute where nothing else is at work


@pytest.fixture
def cluster() -> Iterator[Any]:
    """A head with one core; nodes are added by the test."""
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    yield made
    ray.shutdown()
    made.shutdown()


def started(clip: Path, folder: Path, *words: str) -> subprocess.Popen[str]:
    """A batch of six copies of a clip."""
    for name in NAMES:
        shutil.copytree(clip, folder / "in" / name)
    (folder / "list.txt").write_text("".join(f"in/{name}\n" for name in NAMES))
    argv = [sys.executable, "-m", "mastd3r", "batch", str(folder / "list.txt"), "--out", str(folder / "out")]
    return subprocess.Popen(
        [*argv, "--no-map", "--end=16", *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def wait_for_tasks(out: Path, node_id: str, process: subprocess.Popen[str]) -> None:
    """Until a run is under way on the node."""
    end = time.monotonic() + 300
    while time.monotonic() < end and process.poll() is None:
        for mark in (out / "logs").glob("*.node"):
            run = out / mark.name.removesuffix(".node") / "run.json"
            if node_id[:6] in mark.read_text() and run.is_file():
                return
        time.sleep(0.05)
    raise AssertionError(f"no run began on the node: {process.communicate()[0]}")


def test_a_killed_node_costs_attempts_and_no_run(room_clip: Path, tmp_path: Path, cluster: Any) -> None:
    node = cluster.add_node(num_cpus=1)
    batch = started(room_clip, tmp_path, "--ray", cluster.address, "--task-cores", "1")
    wait_for_tasks(tmp_path / "out", node.node_id, batch)
    cluster.remove_node(node, allow_graceful=False)
    said, _ = batch.communicate(timeout=600)
    assert batch.returncode == 0, said
    runs = json.loads((tmp_path / "out" / "batch.json").read_text())["runs"]
    assert [r["state"] for r in runs] == ["complete"] * len(NAMES)
    assert max(r["attempts"] for r in runs) == 2 and "to be tried again" in said and "is lost" in said
    lost = next(r for r in runs if r["attempts"] == 2)
    assert node.node_id[:6] in lost["nodes"][0] and node.node_id[:6] not in lost["nodes"][1]
    poses = {(tmp_path / "out" / n / "trajectory.txt").read_bytes() for n in NAMES}
    assert len(poses) == 1  # the same frames, whether a run was stopped on the way or not
    assert not list((tmp_path / "out" / "logs").glob("*.node"))


def test_ctrl_c_ends_the_tasks_on_their_nodes(room_clip: Path, tmp_path: Path, cluster: Any) -> None:
    batch = started(room_clip, tmp_path, "--ray", cluster.address, "--task-cores", "1")
    wait_for_tasks(tmp_path / "out", "", batch)
    batch.terminate()
    said, _ = batch.communicate(timeout=60)
    assert batch.returncode == 130 and said.splitlines()[-1].startswith("mastd3r: stopped; runs that are complete stay")
    runs = json.loads((tmp_path / "out" / "batch.json").read_text())["runs"]
    assert "waiting" in {r["state"] for r in runs} and "failed" not in {r["state"] for r in runs}
    left = [json.loads(p.read_text())["status"] for p in (tmp_path / "out").glob("*/run.json")]
    assert left and "running" not in left


def test_a_node_that_does_not_see_the_folder_is_one_line(tmp_path: Path, cluster: Any) -> None:
    place = Place(cluster.address, tmp_path, Asked(cores=1))
    (tmp_path / MARK).write_text("another folder under this name")
    task = Task("a", lambda _: [sys.executable, "-c", ""], tmp_path / "a.log", tmp_path / "a")
    with pytest.raises(InputError, match="must be a folder that all nodes share"):
        run_tasks([task], place, lambda _: {"a": 100.0}, lambda _: None)
    assert not (tmp_path / "a.log").exists()


def test_a_cluster_without_room_is_one_line(tmp_path: Path, cluster: Any, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a").mkdir()
    words = ["batch", str(tmp_path / "a"), "--out", str(tmp_path / "out"), "--ray", cluster.address]
    assert main([*words, "--task-cores", "64"]) == 2
    assert "expected a node with 64 cores, got 1 core with" in capsys.readouterr().err.splitlines()[-1]
    assert main([*words, "--task-gpus", "1"]) == 2
    assert "1 of an accelerator" in capsys.readouterr().err.splitlines()[-1]


def test_a_cluster_that_is_not_there_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a").mkdir()
    words = ["batch", str(tmp_path / "a"), "--out", str(tmp_path / "out"), "--ray"]
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        port = nobody.getsockname()[1]
        assert main([*words, f"127.0.0.1:{port}"]) == 2  # nothing listens
        nobody.listen()
        began = time.monotonic()
        assert main([*words, f"127.0.0.1:{port}"]) == 2  # something does, and says nothing
        assert time.monotonic() - began < 20
    assert main([*words, "nowhere"]) == 2
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("mastd3r: ")]
    assert len(said) == 3 and "no answer" in said[0] and "no answer within" in said[1] and "HOST:PORT" in said[2]


def test_segments_on_a_cluster(tmp_path: Path, cluster: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(synthetic, "CLIP_FPS", 10.0)
    monkeypatch.setattr(segmented, "LEAST_FRAMES", 10)
    monkeypatch.setattr(segmented, "OVERLAP_FRAMES", 10)
    clip = synthetic.make_room_clip(tmp_path / "room", frames=60, width=160, height=120)
    out = tmp_path / "run"
    pieces = Segments(25, elsewhere=lambda folder: Place(cluster.address, folder, Asked(cores=1)))
    config = replace(Config(), mapping=replace(Config().mapping, enabled=False))
    run = reconstruct(clip, out, config, segments=pieces)
    record = json.loads((out / "run.json").read_text())
    assert run.metrics["frames_tracked"] == 60 and len(record["segments"]["joints"]) == 1
    assert not (out / "segments").exists()
