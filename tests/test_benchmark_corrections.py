"""The benchmark of the corrections: what it does to depths, and that it runs and ranks."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import corrections  # noqa: E402
from network_errors import NetworkErrors, disturbed  # noqa: E402

Array = NDArray[Any]
SHAPE = (60, 80)


def plane() -> Array:
    depth = np.full(SHAPE, 0.5, np.float32)
    depth[:, 40:] = 0.25
    depth[:5] = 0.0
    return depth


def test_nothing_is_disturbed_by_no_errors() -> None:
    np.testing.assert_array_equal(disturbed(plane(), NetworkErrors(0.0, 0.0, 0.0), 1, 7), plane())


def test_each_error_is_what_it_says() -> None:
    """A scale is one factor a frame, bending is smooth and without one, bleeding stays at edges; unknown stays."""
    known = plane() > 0
    scaled = [disturbed(plane(), NetworkErrors(0.1, 0.0, 0.0), 3, n) for n in range(200)]
    factors = np.array([np.median(s[known] / plane()[known]) for s in scaled])
    assert all(np.ptp(s[known] / plane()[known]) < 1e-5 for s in scaled)
    assert 0.07 < np.log(factors).std() < 0.13
    distorted = disturbed(plane(), NetworkErrors(0.0, 0.05, 0.0), 3, 0)
    ratio = np.log(distorted[5:] / plane()[5:])
    assert ratio.std() > 0.005 and np.abs(np.diff(ratio, axis=1)).max() < 0.02
    bled = disturbed(plane(), NetworkErrors(0.0, 0.0, 2.0), 3, 0)
    off = np.abs(bled / np.maximum(plane(), 1e-6) - 1)
    assert off[20:, 38:42].min() > 0.05 and off[20:, :25].max() < 1e-3
    assert all((d[:5] == 0).all() for d in (scaled[0], distorted, bled))


def test_seed_and_frame_decide() -> None:
    errors = NetworkErrors()
    first = disturbed(plane(), errors, 1, 2)
    np.testing.assert_array_equal(first, disturbed(plane(), errors, 1, 2))
    assert not np.array_equal(first, disturbed(plane(), errors, 2, 2))
    assert not np.array_equal(first, disturbed(plane(), errors, 1, 3))


def test_a_run_on_the_made_room(room_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every variant and correction has an entry; what stands in the file is not measured again."""
    out = tmp_path / "corrections.json"
    words = ["corrections.py", "--data", str(room_clip), "--out", str(out), "--frames", "8", "--seeds", "1"]
    monkeypatch.setattr(sys, "argv", words)
    corrections.main()
    entries = json.loads(out.read_text())["entries"]
    assert len(entries) == 8 and all(e["ate_rmse_m"] > 0 for e in entries.values())
    assert entries["ours none 0"]["ate_rmse_m"] == entries["printed none 0"]["ate_rmse_m"]
    assert entries["ours coarse-to-fine 0"]["ate_rmse_m"] < 0.5 * entries["ours none 0"]["ate_rmse_m"]
    monkeypatch.setattr(corrections, "tracked", lambda *_: pytest.fail("measured again"))
    corrections.main()
