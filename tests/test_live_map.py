"""The map in its own process: what it does with its messages, that it never holds tracking back, and a whole run."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mastd3r.camera.pinhole import Camera
from mastd3r.cli.main import main
from mastd3r.config import MappingConfig
from mastd3r.mapping.process import KeyframeNews, MapProcess, PoseNews, Trainer
from mastd3r.types import StaticCloud, View

CAMERA = Camera.centred(60.0, 64, 48)
CONFIG = MappingConfig(iterations=100, max_gaussians=2000, loss="plain", device="cpu")


def shifted(x: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


def news(kf: int, steps: int = 4, points: int = 80) -> KeyframeNews:
    """Keyframe ``kf`` stands ``0.1 kf`` to the right and sees a grey wall 2 units away, as its own points."""
    rng = np.random.default_rng(kf)
    xy = rng.uniform(-0.8, 0.8, (points, 2)) + np.array([0.1 * kf, 0])
    cloud = StaticCloud(
        np.concatenate([xy, np.full((points, 1), 2.0)], 1).astype(np.float32),
        np.full((points, 3), 128, np.uint8),
        np.ones(points, np.float32),
        np.full(points, 0.1, np.float32),
        np.full(points, kf, np.int32),
    )
    image, static = np.full((48, 64, 3), 128, np.uint8), np.ones((48, 64), np.float32)
    return KeyframeNews(View(float(kf), image, static, shifted(0.1 * kf), CAMERA, kf), cloud, shifted(0.1 * kf), steps)


def test_keyframes_grow_the_map_and_pay_for_its_steps() -> None:
    trainer = Trainer(CONFIG, 0, "cpu")
    trainer.take(news(0))
    trainer.take(news(1))
    assert trainer.idle and trainer.outcome().gaussians is None  # three keyframes start a map
    trainer.take(news(2))
    while not trainer.idle:
        trainer.step()
    trainer.take(news(3))
    outcome = trainer.outcome()
    assert outcome.steps == 12 and outcome.views == 4 and not trainer.idle
    assert outcome.gaussians is not None and set(outcome.gaussians.kf_id) == {0, 1, 2, 3}


@pytest.mark.parametrize("bends", [False, True])
def test_a_correction_moves_the_map_once(bends: bool) -> None:
    """Poses that come twice, or for keyframes that never arrived, change nothing more.

    Where all keyframes move, so does all of the map; where one of three does, what all of them see goes a third.
    """
    trainer = Trainer(replace(CONFIG, refine_poses=False), 0, "cpu")
    for kf in range(3):
        trainer.take(news(kf, steps=0))
    before = trainer.outcome().gaussians
    for _ in range(2):
        still = 0.0 if bends else 0.05
        trainer.take(PoseNews({0: shifted(still), 1: shifted(0.1 + still), 2: shifted(0.25), 9: shifted(5.0)}))
    after = trainer.outcome().gaussians
    assert before is not None and after is not None
    moved = after.means[:, 0] - before.means[:, 0]
    if bends:
        assert moved.min() >= 0 and moved.max() < 0.05
        assert np.median(moved) == pytest.approx(0.05 / 3, rel=0.15)
    else:
        np.testing.assert_allclose(moved, 0.05, atol=1e-5)


def test_views_that_see_no_point_wait_for_more() -> None:
    trainer = Trainer(CONFIG, 0, "cpu")
    for kf in range(3):
        good = news(kf)
        away = good.view.world_from_cam @ np.diag([-1.0, 1, -1, 1])
        trainer.take(replace(good, view=replace(good.view, world_from_cam=away)))
    assert trainer.idle and trainer.outcome().gaussians is None
    for kf in range(3, 6):
        trainer.take(news(kf))
    assert trainer.outcome().gaussians is not None


def test_offers_never_wait_and_what_does_not_fit_is_counted() -> None:
    """The process needs seconds to start; a queue of two takes two messages and drops the rest at once."""
    process = MapProcess(CONFIG, 0, "cpu", queue_length=2)
    try:
        began = time.perf_counter()
        taken = [process.offer(news(kf)) for kf in range(6)]
        assert time.perf_counter() - began < 1.0
        assert taken[:2] == [True, True] and process.sent == sum(taken) and process.dropped == 6 - sum(taken) >= 3
        outcome = process.finish(PoseNews({}))
        assert outcome is not None and outcome.gaussians is None  # two keyframes do not start a map
        assert not process._process.is_alive()
    finally:
        process.close()


def test_a_process_that_died_gives_no_map_and_no_hang() -> None:
    process = MapProcess(CONFIG, 0, "cpu")
    process._process.kill()
    process._process.join()
    began = time.perf_counter()
    assert process.finish(PoseNews({})) is None
    assert time.perf_counter() - began < 10


@pytest.mark.usefixtures("short_flight")
def test_a_run_that_maps_while_it_tracks(room_clip: Path, tmp_path: Path) -> None:
    """Everything that a run leaves is there, the process was fed, and the splat is as good as after two passes."""
    out = tmp_path / "out"
    changed = ("iterations=60", "width_px=160", "max_gaussians=8000", "realtime_steps=2")
    sets = [word for c in changed for word in ("--set", f"mapping.{c}")]
    sets += ["--set", "tracking.cell_px=5", "--set", "tracking.keyframe_motion_ratio=0.03"]
    assert main(["run", str(room_clip), "--out", str(out), "--quiet", "--realtime", *sets]) == 0
    record = json.loads((out / "run.json").read_text())
    facts = record["realtime"]
    assert record["status"] == "complete"
    assert facts["keyframes_sent"] == facts["keyframes_mapped"] >= 3
    assert facts["messages_dropped"] >= 0 and facts["steps_while_tracking"] <= 2 * 24
    assert any(choice.startswith("realtime: ") for choice in record["choices"])
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["frames_posed"] == 24 and metrics["psnr_holdout"] > 12
    assert cv2.imread(str(next((out / "renders").iterdir()))).std() > 5


def test_realtime_without_a_map_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(tmp_path), "--out", str(tmp_path / "out"), "--realtime", "--no-map"]) == 2
    assert "--no-map" in capsys.readouterr().err
