"""Whole runs on two-view networks: one that knows the truth, and tiny random ones that know nothing."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from known_pair import RoomView, decoded, room, view_of
from mastd3r.cli.main import main
from mastd3r.networks import load
from mastd3r.networks.mast3r import Mast3rConfig, random_mast3r
from mastd3r.networks.preprocess import PixelMapping, prepare_image
from mastd3r.sources.room import RayGrid, camera_pose
from mastd3r.sources.synthetic import room_camera

Array = NDArray[Any]
FPS, SIDE = 5.0, 160


@dataclass(frozen=True)
class Seen:
    """A photograph that the network has recognised."""

    mapping: PixelMapping
    index: int
    pooled: Array


@dataclass(frozen=True)
class Both:
    first: Any
    second: Any


class KnowsTheClip:
    """Answers of a perfect network: exact points of each frame, the ball where it is, every frame in its own scale."""

    def __init__(self, clip: Path) -> None:
        files = sorted((clip / "rgb").iterdir())
        self.index = {np.asarray(Image.open(f)).tobytes(): n for n, f in enumerate(files)}
        self.scale = np.exp(np.random.default_rng(0).normal(0, 0.2, len(files))).astype(np.float32)
        self.views: dict[int, RoomView] = {}
        self.decoded = 0

    def prepare(self, image: Array) -> Seen:
        _, mapping = prepare_image(image, SIDE)
        return Seen(mapping, self.index.get(image.tobytes(), -1), np.ones(2))

    def encode(self, prepared: Seen) -> Seen:
        return prepared

    def view(self, seen: Seen) -> RoomView:
        if seen.index not in self.views:
            m, time_s = seen.mapping, seen.index / FPS
            full = room_camera(*m.full_size).resized(*m.resized_size)
            w, h = m.net_size
            camera = replace(
                full, cx_px=full.cx_px - m.crop_left_px, cy_px=full.cy_px - m.crop_top_px, width=w, height=h
            )
            depth = room().cast(RayGrid(camera), camera_pose(time_s), time_s).depth.reshape(h, w)
            self.views[seen.index] = view_of(camera, camera_pose(time_s), depth)
        return self.views[seen.index]

    def pairs(self, pairs: Any) -> list[Any]:
        return [self.pair(a, b) for a, b in pairs]

    def pair(self, a: Seen, b: Seen) -> Both:
        self.decoded += 1
        first, second = decoded(self.view(a), self.view(b), 0.1)
        s = self.scale[a.index]
        return Both(replace(first, points=s * first.points), replace(second, points=s * second.points))


def run_of(clip: Path, out: Path, weights: Path, *words: str) -> int:
    chosen = ["--pointmaps", "mast3r", "--set", f"networks.mast3r={weights}", "--set", f"networks.long_side_px={SIDE}"]
    return main(["run", str(clip), "--out", str(out), "--quiet", *chosen, *words])


def test_a_network_that_knows_the_truth(room_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing given: frames each of another scale come together to one path."""
    network = KnowsTheClip(room_clip)
    monkeypatch.setattr(load, "load_pair_network", lambda *_: network)
    weights = tmp_path / "any"
    weights.touch()
    out = tmp_path / "out"
    assert run_of(room_clip, out, weights, "--no-map") == 0
    metrics = json.loads((out / "metrics.json").read_text())
    truth = np.loadtxt(room_clip / "groundtruth.txt")[:, 1:4]
    path = float(np.linalg.norm(np.diff(truth, axis=0), axis=1).sum())
    assert metrics["frames_posed"] == 24
    assert metrics["ate_rmse_all"] < 0.008 * path
    assert metrics["focal_px"] == pytest.approx(150, rel=0.02)
    assert metrics["mask_iou"] > 0.42 and metrics["mask_false_positive_ratio"] < 0.04
    record = json.loads((out / "run.json").read_text())
    assert any("MASt3R" in note and "working image 160x120" in note for note in record["choices"])
    spread = next(note for note in record["choices"] if "own depths differ" in note)
    assert float(spread.split("by ")[1].split("%")[0]) < 1.0 and "assumed 8.0%" in spread  # it knows the truth
    # tracking: one decode a frame, two more where keyframes are matched; smoothing pass: one a frame
    assert network.decoded < 2.5 * 24


@pytest.mark.usefixtures("short_flight")
@pytest.mark.parametrize("seed", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2))])
def test_a_tiny_random_network(room_clip: Path, tmp_path: Path, seed: int) -> None:
    """Nonsense points: the run completes, every frame has a finite pose and a state, and it is said what was lost."""
    weights, out = tmp_path / "tiny.pth", tmp_path / "out"
    torch.save(random_mast3r(Mast3rConfig.tiny(), seed=seed).state_dict(), weights)
    assert run_of(room_clip, out, weights, "--set", "mapping.iterations=10") == 0
    rows = np.loadtxt(out / "trajectory.txt")
    assert rows.shape == (24, 8) and np.isfinite(rows).all()
    record = json.loads((out / "run.json").read_text())
    assert record["status"] == "complete"
    assert any("lost" in note for note in record["choices"])
