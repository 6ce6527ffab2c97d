"""The examples are short, and do what they say, on a clip that the package makes."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

import mastd3r
from helpers import write_video
from mastd3r.config import SourceConfig
from mastd3r.registry import POINTMAPS
from mastd3r.sources import open_source

EXAMPLES = sorted((Path(__file__).resolve().parents[1] / "examples").glob("*.py"))


def example(number: int) -> Path:
    return next(p for p in EXAMPLES if p.name.startswith(f"{number:02d}_"))


def run(number: int, *words: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", [str(example(number)), *map(str, words)])
    runpy.run_path(str(example(number)), run_name="__main__")


def test_there_are_six_under_forty_lines() -> None:
    assert [p.name[:3] for p in EXAMPLES] == ["01_", "02_", "03_", "04_", "05_", "06_"]
    assert all(len(p.read_text(encoding="utf-8").splitlines()) < 40 for p in EXAMPLES)


def test_a_video_and_its_score(
    room_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    run(1, room_clip, out, "mapping.iterations=20", "mapping.width_px=80", monkeypatch=monkeypatch)
    said = capsys.readouterr().out
    assert "24 poses" in said and "Gaussians" in said and (out / "colmap" / "sparse" / "0" / "images.bin").is_file()
    run(6, out, room_clip, monkeypatch=monkeypatch)
    ate = float(capsys.readouterr().out.split("ATE ")[1].split()[0])
    assert ate == pytest.approx(mastd3r.load(out).metrics["ate_rmse_all"], abs=1e-4)


def test_a_live_loop(room_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = list(open_source(room_clip, SourceConfig()).frames())
    video = write_video(tmp_path / "room.mp4", [f.image for f in frames], [200 * n for n in range(24)])
    run(2, video, tmp_path / "run", monkeypatch=monkeypatch)
    rec = mastd3r.load(tmp_path / "run")
    assert len(rec.poses) == 24 and rec.is_complete and len(rec.masks) == 24


@pytest.mark.parametrize("number", [3, 4, 5])
def test_parts_of_your_own(number: int, room_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = POINTMAPS.choices
    try:
        run(number, room_clip, tmp_path / "run", monkeypatch=monkeypatch)
    finally:
        for name in set(POINTMAPS.choices) - set(known):
            POINTMAPS.remove(name)
    rec = mastd3r.load(tmp_path / "run")
    assert rec.is_complete and len(rec.poses) == 24
    said = {3: "semantics: maps", 4: "semantics: people", 5: "semantics: people"}[number]
    assert any(note.startswith(said) for note in rec.notes)
