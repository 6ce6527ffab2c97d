"""Nothing assumes Linux: whole commands where one thing after the other that it has is not there (tests/elsewhere/).

The suite runs so too: ``MASTD3R_WITHOUT=affinity,proc,locks PYTHONPATH=tests/elsewhere pytest``.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ELSEWHERE = Path(__file__).parent / "elsewhere"
COMMANDS = """
import json, sys
from mastd3r.cli.main import main
codes = [main(words) for words in json.loads(sys.argv[1])]
print(json.dumps(codes))
"""


def commands(without: str, words: list[list[str]], cwd: Path) -> tuple[list[int], str]:
    """Exit codes of commands in one process where some things are absent, and what was said to stderr."""
    paths = os.pathsep.join([str(ELSEWHERE), *sys.path])
    env = {**os.environ, "PYTHONPATH": paths, "MASTD3R_WITHOUT": without}
    call = [sys.executable, "-c", COMMANDS, json.dumps(words)]
    done = subprocess.run(call, env=env, cwd=cwd, capture_output=True, text=True, check=False, timeout=280)
    return json.loads(done.stdout.splitlines()[-1]) if done.stdout else [], done.stderr


def test_it_is_acted() -> None:
    """What these tests take away is gone in a process of its own, and only there."""
    code = (
        "import os, signal; print(hasattr(os, 'fork'), hasattr(signal, 'SIGHUP'), os.path.exists('TEST_Elsewhere.py'))"
    )
    said = []
    for without in ("fork,signals,case", ""):
        env = {**os.environ, "PYTHONPATH": str(ELSEWHERE), "MASTD3R_WITHOUT": without}
        words = [sys.executable, "-c", code]
        done = subprocess.run(words, env=env, cwd=ELSEWHERE.parent, capture_output=True, text=True, check=True)
        said.append(done.stdout.split())
    assert said[0] == ["False", "False", "True"]
    assert said[1] != said[0] or os.name == "nt"


@pytest.mark.parametrize("without", ["affinity,proc,locks,usage,signals,fork", "case"])
def test_commands_where_something_of_linux_is_not_there(without: str, room_clip: Path, tmp_path: Path) -> None:
    run = ["run", str(room_clip), "--end", "20", "--no-map", "--quiet", "--jobs", "2", "--out", "out/Run"]
    listed = tmp_path / "list.txt"
    listed.write_text(f"{room_clip}\n")
    words = [
        run,
        run,  # into the folder of an earlier run
        ["eval", "out/Run", str(room_clip)],
        ["export", "out/Run", "--to", "tum", "--out", "poses.txt"],
        ["export", "out/Run", "--to", "colmap", "--out", "Colmap", "--quiet"],
        ["batch", "list.txt", "--out", "many", "--no-map", "--quiet", "--end=20", "--jobs=2"],
        ["scale", "out/Run", "factor=2"],
        ["run", "nothing", "--out", "x"],
    ]
    codes, err = commands(without, words, tmp_path)
    assert codes == [0] * 7 + [2], err
    assert len(err.splitlines()) == 1 and err.startswith("mastd3r: nothing: expected a video")
    assert json.loads((tmp_path / "many" / "batch.json").read_text())["runs"][0]["state"] == "complete"
    assert len((tmp_path / "poses.txt").read_text().splitlines()) >= 20
