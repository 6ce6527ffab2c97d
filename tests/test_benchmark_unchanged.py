"""benchmarks/unchanged.py: one bit of a mask is seen, a figure that moves too far or is lost breaks the bound."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import unchanged  # noqa: E402

MACHINE = {"processor": "any", "git_commit": "abc", "packages": {"numpy": "2"}}


def made_run(run: Path, ate: float = 0.02) -> Path:
    (run / "masks").mkdir(parents=True)
    (run / "trajectory.txt").write_text("0 0 0 0 0 0 0 1\n")
    (run / "cloud.ply").write_bytes(b"ply\n")
    for k in range(3):
        (run / "masks" / f"{k}.png").write_bytes(bytes([k, 0, 255]))
    (run / "metrics.json").write_text(json.dumps({"ate_rmse_all": ate, "psnr_holdout": 30.0, "frames": 3}))
    (run / "run.json").write_text(json.dumps({"status": "complete", "reason": None, "machine": MACHINE}))
    return run


@pytest.fixture
def sides(tmp_path: Path) -> tuple[Path, Path]:
    """The same two runs, before and after."""
    for side in ("before", "after"):
        for name in ("kitchen", "demo"):
            made_run(tmp_path / side / name)
    return tmp_path / "before", tmp_path / "after"


def said(sides: tuple[Path, Path], capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, str]]:
    """Exit code, and "run what" -> verdict of the table."""
    assert unchanged.main(["hash", *map(str, sides)]) == 0
    capsys.readouterr()
    code = unchanged.main(["compare", *(f"{side}.json" for side in sides), *words])
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    return code, {" ".join(row[:2]): row[2] for row in rows if row[0] in unchanged.RUNS}


def test_the_same_bytes(sides: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    code, verdicts = said(sides, capsys)
    assert code == 0 and set(verdicts.values()) == {"identical"}
    files = [*unchanged.FILES, "ate_rmse_all", "psnr_holdout"]
    assert set(verdicts) == {f"{run} {what}" for run in ("kitchen", "demo") for what in files}


def test_one_bit_of_one_mask(sides: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    mask = sides[1] / "demo" / "masks" / "1.png"
    data = bytearray(mask.read_bytes())
    data[1] ^= 1
    mask.write_bytes(data)
    code, verdicts = said(sides, capsys)
    assert code == 0  # it is said, and the figures hold
    assert {what for what, verdict in verdicts.items() if verdict == "different"} == {"demo masks/*.png"}


@pytest.mark.parametrize("move", [("1.png", "1b.png"), ("0.png", "3.png")])
def test_names_of_masks_count(sides: tuple[Path, Path], capsys: pytest.CaptureFixture[str], move: Any) -> None:
    (sides[1] / "demo" / "masks" / move[0]).rename(sides[1] / "demo" / "masks" / move[1])
    assert said(sides, capsys)[1]["demo masks/*.png"] == "different"


@pytest.mark.parametrize("file", ["trajectory.txt", "cloud.ply"])
def test_one_byte_of_a_file(sides: tuple[Path, Path], capsys: pytest.CaptureFixture[str], file: str) -> None:
    with (sides[1] / "kitchen" / file).open("ab") as end:
        end.write(b"\n")
    code, verdicts = said(sides, capsys)
    assert code == 0 and [what for what, verdict in verdicts.items() if verdict == "different"] == [f"kitchen {file}"]


@pytest.mark.parametrize(("ate", "code"), [(0.0201, 0), (0.0199, 0), (0.0203, 1), (0.0197, 1), (float("nan"), 1)])
def test_a_figure_may_move_by_one_percent(
    sides: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], ate: float, code: int
) -> None:
    changed = made_run(tmp_path / "changed" / "kitchen", ate).parent
    got, verdicts = said((sides[0], changed), capsys, "--only", "kitchen")
    assert got == code and verdicts["kitchen ate_rmse_all"] == "different"
    assert not any(what.startswith("demo") for what in verdicts)


@pytest.mark.parametrize("lost", ["masks", "figure", "run", "complete"])
def test_what_is_lost_breaks(sides: tuple[Path, Path], capsys: pytest.CaptureFixture[str], lost: str) -> None:
    run = sides[1] / "demo"
    if lost == "masks":
        for mask in (run / "masks").iterdir():
            mask.unlink()
    elif lost == "figure":
        (run / "metrics.json").write_text(json.dumps({"ate_rmse_all": 0.02}))
    elif lost == "run":
        run.rename(run.with_name("elsewhere"))
    else:
        (run / "run.json").write_text(json.dumps({"status": "incomplete", "reason": "a reason", "machine": MACHINE}))
    code, verdicts = said(sides, capsys)
    assert code == 1 and [verdict for verdict in verdicts.values() if verdict != "identical"] == ["missing"]


def test_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each run is a process of its own with its map; one that fails is said and does not stop the others."""
    ran = []

    def stands_in(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        ran.append(command)
        out = Path(command[command.index("--out") + 1])
        if out.name == "street":
            return subprocess.CompletedProcess(command, 2, "", "mastd3r: no such street\n")
        made_run(out)
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(unchanged.subprocess, "run", stands_in)
    out = tmp_path / "v1.2"
    assert unchanged.main(["record", "--data", "D", "--out", str(out)]) == 1
    made = json.loads((tmp_path / "v1.2.json").read_text())
    assert list(made) == list(unchanged.RUNS) and made["street"] == {"error": "mastd3r: no such street"}
    assert made["kitchen"]["commit"] == "abc" and made["kitchen"]["packages"] == {"numpy": "2"}
    assert made["kitchen"]["figures"] == {"ate_rmse_all": 0.02, "psnr_holdout": 30.0}
    assert ran[0][1:] == ["-m", "mastd3r", "run", "D/kitchen", "--end", "120", "--quiet", "--out", str(out / "kitchen")]
    assert ran[-1][3:] == ["demo", "--out", str(out / "demo")]
    assert not any("--no-map" in command for command in ran)
    ran.clear()
    assert unchanged.main(["record", "--data", "D", "--out", str(tmp_path / "more"), "--only", "demo"]) == 0
    assert len(ran) == 1 and list(json.loads((tmp_path / "more.json").read_text())) == ["demo"]
