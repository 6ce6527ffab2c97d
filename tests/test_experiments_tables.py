"""Tables and plots: every figure comes from the records or from published.yaml, and what is not there is said."""

from __future__ import annotations

import html
import json
import re
import runpy
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest
import yaml

from mastd3r.cli.main import main
from mastd3r.config import Config, config_to_yaml
from mastd3r.errors import InputError
from mastd3r.experiments.plots import plots_of
from mastd3r.experiments.published import published_table
from mastd3r.experiments.render import as_html, as_markdown
from mastd3r.experiments.store import read_results
from mastd3r.experiments.suite import SHIPPED
from mastd3r.experiments.tables import Table, head_of, number, tables_of

ROOT = Path(__file__).resolve().parents[1]
CONFIG = yaml.safe_load(config_to_yaml(Config()))
MACHINE = {"processor": "a processor", "cores": 2, "git_commit": "abc"}


def record(sequence: str, variant: str, seed: int, status: str = "complete", **metrics: Any) -> dict[str, Any]:
    path = [f"{t} {t * t / 9} 0 {t} {t * t / 9 + 0.1} 0" for t in range(9)]
    return {
        "id": f"{sequence}--{variant}--seed{seed}--0", "sequence": sequence, "variant": variant, "seed": seed,
        "status": status, "error": None if status == "complete" else "said why", "command": "mastd3r run x",
        "config": CONFIG, "wall_s": 1.0, "jobs": 1, "date": "2026-01-01", "machine": MACHINE,
        "source": {"size": [640, 480]}, "path": path if status == "complete" else None,
        "metrics": {"frames": 9, "frames_posed": 8, **metrics} if status == "complete" else {},
    }  # fmt: skip


def results(suite: str, sequences: list[str], records: list[dict[str, Any]], missing: tuple[str, ...] = ()) -> Any:
    definition = yaml.safe_load((SHIPPED / f"{suite}.yaml").read_text())
    head = {"suite": suite, "definition": definition, "sequences": sequences, "missing": list(missing)}
    command = f"mastd3r bench {suite} --data DATA"
    return {**head, "composed": sequences[:1], "command": command, "config": {}, "entries": records}


def rows_of(table: Table) -> list[list[str]]:
    return [[c.text for c in row] for row in table.rows]


BONN = ["balloon", "balloon2", "crowd", "crowd2", "person_tracking", "person_tracking2"]


def test_a_table_over_sequences_has_ours_and_theirs() -> None:
    ours = [record(s, "ours", seed, ate_rmse_keyframes=0.01 * (i + 1) + 0.002 * seed) for i, s in enumerate(BONN[:5])
            for seed in (0, 1)]  # fmt: skip
    ours += [record("balloon", "baseline", 0, "failed"), record("crowd", "baseline", 0, ate_rmse_keyframes=0.5)]
    table = tables_of(results("bonn", BONN, ours, ("person_tracking2",)))[0]
    assert table.head == ["Method", "Figure", *BONN, "Mean", "Source"]
    rows = rows_of(table)
    assert rows[0][:4] == ["ours", head_of("ate_rmse_keyframes"), "0.0110 (0.0100–0.0120)", "0.0210 (0.0200–0.0220)"]
    assert rows[0][7:] == ["missing", "–", "this run"]  # no mean of some
    assert rows[1][2:6] == ["failed", "not run", "0.5000", "not run"]
    assert table.rows[0][4].best and not table.rows[1][4].best  # crowd: 0.031 against 0.5
    theirs = [r for r in rows if r[0] == "MASTD3R-SLAM" and r[1] == head_of("ate_rmse_keyframes")]
    assert theirs == [["MASTD3R-SLAM", head_of("ate_rmse_keyframes"), "0.0284", "0.0269", "0.0185", "0.0257", "0.0318",
                       "0.0343", "0.0276", "[1]"]]  # fmt: skip
    droid_w = next(r for r in rows if r[0] == "DROID-W")
    assert droid_w[2:9] == ["0.0260", "0.0250", "0.0130", "0.0180", "0.0330", "0.0290", "0.0240"]
    assert any(note.startswith("[1] MASTD3R-SLAM") and "keyframes" in note for note in table.notes)
    assert any("prints a mean" in note and "0.0906 for DROID-Splat" in note for note in table.notes)
    assert len(rows) == 2 * 3 + len(published_table("bonn").rows)


def test_means_need_every_sequence_and_seeds_that_failed_are_counted() -> None:
    records = [record(s, "full", 0, psnr_holdout=20.0 + i) for i, s in enumerate(BONN)]
    records += [record("crowd", "full", 1, "failed"), record("crowd", "plain", 0, psnr_holdout=19.0)]
    table = tables_of(results("loss", BONN, records))[0]
    by = {(r[0], r[1]): r[2:] for r in rows_of(table)}
    assert by["crowd", "full loss"][0] == "22.00, 1 of 2 runs"
    assert by["mean of 6", "full loss"][0] == "22.50" and by["mean of 6", "plain loss"][0] == "–"
    assert by["as printed [1]", "full loss"][:4] == ["21.37", "0.840", number("peak_gpu_mib", 19.8 * 1024), "13.20"]
    assert any("taken as GiB" in note for note in table.notes)


def test_a_tie_is_bold_in_both_rows_and_all_equal_in_none() -> None:
    records = [
        record("crowd", v, 0, psnr_holdout=20.001 + 0.001 * i, ssim_holdout=0.5) for i, v in enumerate(["full", "mask"])
    ]
    records.append(record("crowd", "plain", 0, psnr_holdout=19.0, ssim_holdout=0.5))
    table = tables_of(results("loss", ["crowd"], records))[0]
    bold = {row[1].text: [c.best for c in row[2:4]] for row in table.rows if row[0].text == "crowd"}
    assert bold["full loss"] == bold["mask-weighted loss"] == [True, False] and bold["plain loss"] == [False, False]


def test_numbers_as_tables_write_them() -> None:
    assert number("ate_rmse_all", 0.01234) == "0.0123" and number("frames", 240.0) == "240"
    assert number("mask_false_positive_ratio", 0.0123) == "1.23%"
    assert "↓" in head_of("ate_rmse_all") and "↑" in head_of("psnr_holdout") and "[MiB]" in head_of("cloud_mib")


def test_the_page_says_how_everything_was_measured() -> None:
    records = [
        record("jam", v, seed, ate_rmse_all=0.03, psnr_holdout=20.0) for v in ("none", "coarse") for seed in (0, 2)
    ]
    records += [record("jam", "fine", 0, "failed")]
    made = results("local", ["jam", "gone"], records, ("gone",))
    text, page = as_markdown(made), html.unescape(re.sub("<[^>]+>", "", as_html(made)))
    for said in (
        "By `mastd3r bench local --data DATA`", "jam: 9 of 640x480 px read, 1 without a pose", "Stride 1",
        "Semi-synthetic", "composited in: jam.",
        "Sim(3)", "within 20 ms", "every 8th frame", "Whole image unless", "Seeds: 0, 2.", "starts n frames later",
        "coarse: `correction=coarse`, `mapping.enabled=false`", "one run at a time", "Commit abc",
        "LPIPS is not offered",
        "gone: not in the data folder", "jam--fine--seed0--0: said why", "trained for its own steps",
    ):  # fmt: skip
        assert said in text, said
        assert said.replace("`", "") in page, said
    lost = as_markdown(results("bonn", BONN, [], tuple(BONN)))
    assert "balloon: not in the data folder; `mastd3r download bonn balloon --to DATA` brings it" in lost
    assert "nothing has run yet" in lost and "0.0284" in lost  # what others printed is there all the same


def test_plots_show_every_run_and_hold_no_picture() -> None:
    records = [record(s, v, seed, ate_rmse_all=0.01 * (seed + 1)) for s in ("jam", "walk <1>") for v in ("none", "fine")
               for seed in (0, 1, 2)]  # fmt: skip
    plots = plots_of(results("local", ["jam", "walk <1>"], records))
    assert set(plots) == {"local_ate_spread.svg", "local_paths.svg"}
    for svg in plots.values():
        root = ET.fromstring(svg)
        assert not [e for e in root.iter() if e.tag.endswith("image")] and len(svg) < 60_000
        numbers = re.findall(r"[xy\d]=\"(-?[\d.]+)\"", svg)
        assert numbers and all(-1 <= float(n) <= 2000 for n in numbers)
    assert plots["local_ate_spread.svg"].count("<circle") == 12
    assert plots["local_paths.svg"].count("<polyline") == 2 * 3  # a true path and two variants in each panel
    assert plots_of(results("local", ["jam"], [record("jam", "none", 0, "failed")])) == {}


def test_results_of_something_else_are_refused(tmp_path: Path) -> None:
    (tmp_path / "r.json").write_text(json.dumps({"kitchen": {}}))
    with pytest.raises(InputError, match=r"expected the results\.json of a bench, got kitchen"):
        read_results(tmp_path / "r.json")


def test_the_results_page_is_what_its_command_writes(tmp_path: Path) -> None:
    """Nothing in docs/results.md is typed by hand, and nothing in it is older than the JSON."""
    page = tmp_path / "results.md"
    words = [sys.executable, "benchmarks/tables.py", "benchmarks/results/sequences.json", str(page)]
    subprocess.run(words, cwd=ROOT, check=True, timeout=120)
    assert page.read_text() == (ROOT / "docs" / "results.md").read_text()
    for plot in (tmp_path / "plots").glob("*.svg"):
        assert plot.read_text() == (ROOT / "docs" / "plots" / plot.name).read_text()


def test_a_bench_becomes_a_section_of_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bench").mkdir()
    made = results("local", ["jam"], [record("jam", "none", 0, ate_rmse_all=0.0321)])
    (tmp_path / "bench" / "local.json").write_text(json.dumps(made))
    (tmp_path / "sequences.json").write_text("{}")
    tables = runpy.run_path(str(ROOT / "benchmarks" / "tables.py"))
    monkeypatch.setattr(sys, "argv", ["tables.py", str(tmp_path / "sequences.json"), str(tmp_path / "page.md")])
    assert tables["main"]() == 0
    text = (tmp_path / "page.md").read_text()
    assert "## Pose correction and rendering loss" in text and "0.0321" in text and "(plots/local_paths.svg)" in text
    assert (tmp_path / "plots" / "local_paths.svg").read_text().startswith("<svg")


# -- the command -----------------------------------------------------------------------------------------------------

TINY = """
title: Tiny
sequences: any
settings: {mapping.enabled: false, source.end: 16}
variants: {ours: {}}
tables: [{title: Corrections, form: variants, metrics: [ate_rmse_all, cloud_mib]}]
"""


def test_one_command_makes_the_table(room_clip: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "tiny.yaml").write_text(TINY)
    words = ["bench", str(tmp_path / "tiny.yaml"), "--data", str(room_clip.parent), "--out", str(tmp_path / "out")]
    words += ["--sequences", "room", "elsewhere"]
    assert main([*words, "--list"]) == 0
    assert "to run" in (listed := capfd.readouterr().out) and "sequence missing" in listed
    assert not (tmp_path / "out").exists()
    assert main(words) == 0
    said = capfd.readouterr()
    assert "1/1 room/ours/0" in said.err and "16 of 16 frames tracked" in said.err and "missing: elsewhere" in said.err
    kept = {p: p.read_bytes() for p in (tmp_path / "out" / "entries").iterdir()}
    entry = json.loads(next(iter(kept.values())))
    assert entry["status"] == "complete" and entry["metrics"]["cloud_mib"] > 0 and len(entry["path"]) == 16
    assert entry["metrics"]["rpe_translation_frame"] > 0 and entry["machine"]["packages"]["numpy"]
    table = (tmp_path / "out" / "table.md").read_text()
    assert (
        f"| room | ours | {entry['metrics']['ate_rmse_all']:.4f} |" in table and "| elsewhere | ours | missing" in table
    )
    assert (tmp_path / "out" / "table.html").read_text().startswith("<!doctype html>")
    assert main(words) == 0  # nothing is left to run: the same entries, the same table
    assert "0 of 2 entries to run" in capfd.readouterr().err
    assert {p: p.read_bytes() for p in kept} == kept and (tmp_path / "out" / "table.md").read_text() == table


def test_a_data_folder_without_any_sequence(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "data").mkdir()
    assert main(["bench", "bonn", "--data", str(tmp_path / "data"), "--out", str(tmp_path / "out")]) == 2
    err = capfd.readouterr().err
    assert "expected sequences of bonn, got none" in err.splitlines()[-1]
    assert "mastd3r download bonn crowd" in err and "missing" in (tmp_path / "out" / "table.md").read_text()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["bonnn"], "expected one of bonn, correction, kitti, local, loss, tum-dynamic, or a YAML file, got 'bonnn'"),
        (["FILE"], "expected readable YAML"),
        (["UNKNOWN"], "variants.ours.set: config: unknown key corection; perhaps you meant correction"),
        (["local", "--data", "NOWHERE"], "expected the folder that holds the sequences, got no such folder"),
        (["local", "--data", "EMPTY"], "expected folders with rgb.txt and groundtruth.txt, got none"),
        (["bonn", "--data", "EMPTY", "--sequences", "walk"], "--sequences: expected some of balloon"),
        (["bonn", "--data", "EMPTY", "--only", "walk/*"], "--only: expected a pattern of sequence/variant/seed"),
        (["bonn", "--data", "EMPTY", "--jobs", "0"], "--jobs: expected 1 or more, got 0"),
        (["bonn", "--data", "EMPTY", "--memory-mib", "-1"], "--memory-mib: expected more than 0"),
        (["bonn", "--data", "EMPTY", "--seeds", "-1"], "--seeds: expected different whole numbers"),
        (["bonn", "--data", "EMPTY", "--seeds", "x"], "--seeds"),
    ],
)
def test_words_that_do_not_fit(
    words: list[str], says: str, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken.yaml").write_text("title: [1, 2\n")
    (tmp_path / "unknown.yaml").write_text(TINY.replace("ours: {}", "ours: {set: {corection: none}}"))
    (tmp_path / "empty").mkdir()
    names = {"FILE": "broken.yaml", "UNKNOWN": "unknown.yaml", "NOWHERE": "nowhere", "EMPTY": "empty"}
    assert main(["bench", *(names.get(w, w) for w in words)]) == 2
    err = capfd.readouterr().err.splitlines()
    assert len(err) == 1 and says in err[0], err
    assert not (tmp_path / "runs").exists()
