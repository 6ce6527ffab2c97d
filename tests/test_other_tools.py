"""docs/other_tools.md does what it says: its commands and its code are run, in order, on a small run with a splat."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from mastd3r.cli.main import main

PAGE = Path(__file__).resolve().parents[1] / "docs" / "other_tools.md"
BLOCKS = re.findall(r"```(\w*)\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
COMMANDS = [line for kind, text in BLOCKS if kind == "" for line in text.splitlines()]
CODE = [text for kind, text in BLOCKS if kind == "python"]
SMALL = ("mapping.iterations=20", "mapping.width_px=80")

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(room_clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which every command of the page was run."""
    folder = tmp_path_factory.mktemp("tools")
    options = [word for change in SMALL for word in ("--set", change)]
    assert main(["run", str(room_clip), "--out", str(folder / "runs" / "my"), "--quiet", *options]) == 0
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for line in COMMANDS:
            program, *words = shlex.split(line)
            assert program == "mastd3r" and main(words) == 0, line
    return folder


@pytest.mark.parametrize("code", CODE, ids=lambda code: re.findall(r"(?:import|from) (\w+)", code)[-1])
def test_the_code_runs(
    code: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for package in sorted(set(re.findall(r"^(?:import|from) (\w+)", code, re.MULTILINE))):
        pytest.importorskip(package)
    monkeypatch.chdir(folder)
    exec(compile(code, str(PAGE), "exec"), {})
    said = capsys.readouterr().out
    assert said.strip() and "False" not in said
