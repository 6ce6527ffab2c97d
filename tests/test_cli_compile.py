"""``mastd3r compile``: what it leaves is all that a run needs."""

from __future__ import annotations

import os
import subprocess
import sys
from argparse import Namespace
from pathlib import Path

import pytest

from mastd3r.cli import compile as ahead
from mastd3r.cli.screen import screen
from mastd3r.errors import MissingPackage

RUN = """
import sys
from numba.core import event
event.register("numba:compile", type("L", (event.Listener,), {
    "on_start": lambda self, e: print("COMPILED", e.data["dispatcher"].py_func.__qualname__),
    "on_end": lambda self, e: None,
})())
from mastd3r.cli.main import main
sys.exit(main(sys.argv[1:]))
"""


def quiet(part: str | None = None) -> Namespace:
    return Namespace(part=part)


def test_a_part_that_fails_is_named_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = [sys.executable, "-c", "import sys; sys.exit('first\\nno room for kernels')"]
    monkeypatch.setattr(ahead, "_started", lambda part: subprocess.Popen(broken, stderr=subprocess.PIPE))
    with pytest.raises(MissingPackage, match=r"^kernels of tracking: .* got: no room for kernels$"):
        ahead.compile_kernels(quiet(), screen(stderr=True))


def test_no_part_outlives_a_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    waiting = [sys.executable, "-c", "import time; time.sleep(60)"]
    made: list[subprocess.Popen[bytes]] = []

    def started(part: str) -> subprocess.Popen[bytes]:
        made.append(subprocess.Popen(waiting, stderr=subprocess.PIPE))
        return made[-1]

    def interrupted(seconds: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(ahead, "_started", started)
    monkeypatch.setattr(ahead.time, "sleep", interrupted)
    with pytest.raises(KeyboardInterrupt):
        ahead.compile_kernels(quiet(), screen(stderr=True))
    assert len(made) == len(ahead.PARTS) and all(p.returncode is not None for p in made)


@pytest.mark.slow
def test_after_it_a_run_with_a_map_compiles_nothing(tmp_path: Path) -> None:
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    subprocess.run([sys.executable, "-m", "mastd3r", "compile"], env=env, check=True)
    words = ["demo", "--out", str(tmp_path / "run"), "--frames", "45"]
    done = subprocess.run([sys.executable, "-c", RUN, *words], env=env, check=True, capture_output=True, text=True)
    assert [line for line in done.stdout.splitlines() if line.startswith("COMPILED")] == []
