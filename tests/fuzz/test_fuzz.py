"""A slice of ``make fuzz``: some bad inputs of every kind; none may bring a traceback, hang, or change what it read."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
CASES = 40


@pytest.mark.skipif(not hasattr(os, "fork"), reason="cases run in forked processes")
def test_a_slice_of_bad_inputs_of_every_kind(tmp_path: Path) -> None:
    out = tmp_path / "fuzz.json"
    paths = os.pathsep.join([str(TESTS), str(TESTS.parent / "src")])
    words = [sys.executable, "-m", "fuzz", "--quick", "--cases", str(CASES), "--seed", "1", "--out", str(out)]
    done = subprocess.run(
        words, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True, timeout=290, check=False
    )
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    summary = json.loads(out.read_text())
    assert summary["cases"] >= CASES and len(summary["kinds"]) >= 18
    assert set(summary["exit codes"]) <= {"0", "2", "130"} and summary["exit codes"]["2"] > CASES / 2
