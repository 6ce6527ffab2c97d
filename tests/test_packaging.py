"""What is published: one version everywhere, and nothing named that is not there."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from mastd3r import __version__

ROOT = Path(__file__).parents[1]


def test_the_version_stands_in_one_place() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert project["project"]["dynamic"] == ["version"]
    assert project["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "mastd3r.__version__"}
    assert re.search(rf"^version: {re.escape(__version__)}$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.M)
    assert f"version = {{{__version__}}}" in (ROOT / "README.md").read_text(encoding="utf-8")


def test_workflows_call_the_readmes_two_commands() -> None:
    workflow = (ROOT / ".github" / "workflows" / "tests.yml").read_text(encoding="utf-8")
    for word in ("make demo", "make test", "windows-latest", "macos-latest", '"3.11", "3.12", "3.13"', "make fuzz"):
        assert word in workflow
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert all(f"\n{target}: setup\n" in makefile for target in ("demo", "fuzz", "docs"))


def test_images_run_as_somebody_without_rights() -> None:
    for name in ("Dockerfile", "Dockerfile.cuda"):
        lines = (ROOT / "docker" / name).read_text(encoding="utf-8").splitlines()
        assert "USER mastd3r" in lines and 'ENTRYPOINT ["mastd3r"]' in lines
        copied = [
            word for line in lines if line.startswith("COPY ") and "--from" not in line for word in line.split()[1:-1]
        ]
        assert copied and all((ROOT / word).exists() for word in copied)
