"""The cases of ../shared/cases that are whole commands: what stopped them before, and what is right."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from mastd3r.cli.main import main
from mastd3r.config import SourceConfig
from mastd3r.sources import open_source

CASES = Path(os.environ.get("MASTD3R_CASES", Path(__file__).parents[2] / "shared" / "cases"))
pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason="the folder of cases is not there")


def test_one_bad_row_of_truth_stops_no_run(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = CASES / "truth_with_one_nan_stops_run"
    told = [n for n in open_source(folder, SourceConfig()).notes if n.startswith("truth: 1 rows are no poses")]
    assert told  # before a frame is read
    code = main(["run", str(folder), "--no-map", "--quiet", "--out", str(tmp_path / "out")])
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert (code, record["status"]) == (0, "complete"), capfd.readouterr().err
    assert told[0] in record["choices"] and (tmp_path / "out" / "report.html").is_file()


def test_names_of_exported_photographs_are_theirs(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    photos, out = CASES / "colmap_export_names" / "my photos", tmp_path / "out"
    code = main(["run", str(photos), "--no-map", "--quiet", "--out", str(out)])
    assert code == 0, capfd.readouterr().err
    assert main(["export", str(out), "--to", "colmap", "--out", str(tmp_path / "c"), "--quiet", "--all-poses"]) == 0
    lines = (tmp_path / "c" / "sparse" / "0" / "images.txt").read_text().splitlines()
    names = [line.split(" ", 9)[9] for line in lines if not line.startswith("#")][::2]
    assert names == ["shot 1.jpg", "shot 2.jpg", "shot 3.jpg"]
    assert all((tmp_path / "c" / "images" / name).is_file() for name in names)
