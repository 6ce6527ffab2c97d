"""benchmarks/bench_networks.py runs whole with the tiny network, so that it is ready when an accelerator is."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.mark.slow
def test_every_part_that_a_cpu_can_do(room_clip: Path, tmp_path: Path) -> None:
    pytest.importorskip("transformers", reason="DINOv2 needs pip install 'mastd3r-slam[networks]'")
    out = tmp_path / "networks.json"
    words = ["--out", str(out), "--sequence", str(room_clip), "--small", "--frames", "6", "--device", "cpu"]
    parts = ["precision", "graphed", "reference", "matching", "dinov2", "loop"]  # all but torch.compile: a minute
    done = subprocess.run(
        [sys.executable, str(BENCHMARKS / "bench_networks.py"), *words, "--parts", *parts],
        check=False, env={**os.environ, "OMP_NUM_THREADS": "1"}, capture_output=True, text=True, timeout=200,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    result = json.loads(out.read_text())
    assert result["failed"] == {}
    assert result["left_out"] == {"graphed": "no CUDA device", "reference": "no --reference"}
    assert result["parameters"] < 1e7 and result["small"]
    exact, half = (result["parts"]["precision"][name] for name in ("float32", "bfloat16"))
    assert exact["relative_error"]["points"] == [0, 0, 0] and 0 < half["relative_error"]["descriptors"][1] < 0.2
    loop = result["parts"]["loop"]
    assert loop["loop"]["states"] == {"started": 1, "tracked": 5} and loop["loop"]["encoded"] == 6
    assert loop["loop"]["ate_rmse_m"] < 0.01 and loop["loop_over_network"] > 0
    assert {"pair: coarse", "pair: fine", "beside: mask, update", "network: pairs"} < set(
        loop["loop"]["stage_ms_a_frame"]
    )
    assert "loop_over_network" in done.stdout and "pixels of the loop" in done.stdout
