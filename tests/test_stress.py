"""benchmarks/stress.py: what is in it, resumption, entries that go wrong; and the table, from made-up figures."""

from __future__ import annotations

import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))

import stress  # noqa: E402
import stress_entry  # noqa: E402
import stress_table  # noqa: E402

VARY = """
import shutil, sys
from pathlib import Path
source, out, variant = sys.argv[1:4]
assert sys.argv[4:8] == ["--seed", "0", "--first", "0"]
if variant == "noise": sys.exit("vary: no noise today")
shutil.copytree(source, Path(out) / f"{Path(source).name}--{variant}")
"""
DRIVER = """
import json, os, sys, time
sequence, run, result = sys.argv[1:4]
with open(os.environ["CALLS"], "a") as calls: calls.write(" ".join([os.path.basename(sequence), *sys.argv[4:]]) + "\\n")
if "reverse" in sequence: os.abort()
if "mirror" in sequence: time.sleep(60)
if "turned" in sequence: raise RuntimeError("a depth of no sign")
json.dump({"ate_rmse_all": 0.01, "path_length": 2.0, "choices": ["many words"]}, open(result, "w"))
"""


@pytest.fixture
def suite(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Words of a suite of one sequence, with a driver that goes wrong for some variants."""
    (tmp_path / "data" / "hall").mkdir(parents=True)
    (tmp_path / "vary.py").write_text(VARY)
    (tmp_path / "driver.py").write_text(DRIVER)
    monkeypatch.setattr(stress, "SEQUENCES", {"hall": ("hall", 0, None), "cellar": ("cellar", 5, 9)})
    monkeypatch.setattr(stress, "DRIVER", tmp_path / "driver.py")
    monkeypatch.setenv("CALLS", str(tmp_path / "calls"))
    words = ["--data", str(tmp_path / "data"), "--vary", str(tmp_path / "vary.py"), "--out", str(tmp_path / "out")]
    return [*words, "--work", str(tmp_path / "work")]


def calls(suite: list[str]) -> list[str]:
    file = Path(suite[5]).parent / "calls"
    return file.read_text().splitlines() if file.is_file() else []


def test_ten_sequences_by_twelve_variants_a_third_of_them_sums_of_three() -> None:
    found = stress.entries()
    by_sequence = Counter(e.sequence for e in found)
    assert len(by_sequence) >= 10 and len({e.name for e in found}) == len(found)
    assert set(by_sequence.values()) == {13}  # the base beside the twelve
    changes = Counter(e.variant.count("+") + 1 for e in found if e.variant != stress.BASE)
    assert set(changes) == {1, 3} and 3 * changes[3] == changes[1] + changes[3]
    windows = {(e.folder, e.first, e.last) for e in found}
    assert {("kitchen", 0, 160), ("kitchen", 240, 400), ("street", 0, None)} < windows
    assert {(e.first, e.last) for e in stress.entries(frames=12)} == {(0, 12), (240, 252)}


def test_only_names_entries_and_refuses_others(suite: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    sums = [e.name for e in stress.chosen(stress.entries(), "cellar,hall:reverse+blur+flicker")]
    assert len(sums) == 14 and sums[0] == "hall--reverse+blur+flicker"
    for words in (["--only", "attic"], ["--only", "hall:upside"], ["--set", "graph.nothing=1"], ["--vary", "none.py"]):
        assert stress.main([*suite, *words]) == 2
        said = capsys.readouterr().err
        assert words[1].partition(":")[0].partition("=")[0] in said and said.count("\n") == 1
    assert not calls(suite) and not Path(suite[5]).exists()


def test_what_goes_wrong_is_an_entry_and_stops_nothing(suite: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    only = ",".join(f"hall:{v}" for v in ("base", "reverse", "mirror", "turned", "noise", "drop"))
    assert stress.main([*suite, "--only", f"{only},cellar", "--timeout", "2", "--jobs", "2"]) == 0
    assert "cellar is not there" in capsys.readouterr().err
    out = Path(suite[5])
    made = json.loads((out / "stress.json").read_text())
    assert list(made) == [f"hall:{v}" for v in ("base", "reverse", "mirror", "turned", "noise", "drop")]
    errors = {name.partition(":")[2]: e.get("error", "") for name, e in made.items()}
    assert errors["base"] == errors["drop"] == "" and made["hall:drop"]["ate_rmse_all"] == 0.01
    assert errors["reverse"].startswith("exit code -6") and errors["mirror"] == "timeout: not done after 2 s"
    assert errors["turned"] == "exit code 1: RuntimeError: a depth of no sign"
    assert errors["noise"] == "making the variant: exit code 1: vary: no noise today"
    assert "choices" not in made["hall:base"]
    assert json.loads((out / "entries" / "hall--base.json").read_text())["choices"] == ["many words"]
    assert not list(Path(suite[7]).iterdir())  # variants are removed


def test_an_entry_of_the_same_configuration_is_not_run_again(suite: list[str]) -> None:
    words = [*suite, "--only", "hall:base,hall:turned"]
    assert stress.main(words) == 0 and len(calls(suite)) == 2
    assert calls(suite)[0] == "hall--stride1 --semantics auto"
    assert stress.main(words) == 0 and len(calls(suite)) == 2  # one that failed neither
    assert stress.main([*suite, "--only", "hall:base,hall:drop", "--keep"]) == 0
    assert calls(suite)[2:] == ["hall--drop --semantics auto"]
    assert (Path(suite[7]) / "hall--drop" / "variant" / "hall--drop").is_dir()
    assert len(json.loads((Path(suite[5]) / "stress.json").read_text())) == 3
    assert stress.main([*words, "--semantics", "none", "--set", "graph.kernel_px=2"]) == 0
    assert calls(suite)[3] == "hall--stride1 --semantics none --set graph.kernel_px=2"
    assert len(json.loads((Path(suite[5]) / "stress.json").read_text())) == 2  # those of one configuration


def test_the_driver_measures_a_path_and_says_what_is_refused(
    room_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = stress_entry.config_of("none", ["source.end=12"])
    assert not config.mapping.enabled and config.semantics == "none"
    found = stress_entry.run_entry(room_clip, tmp_path / "run", config)
    assert found["frames"] == found["frames_posed"] == found["frames_tracked"] == 12
    assert found["never_joined"] == found["frames_lost"] == found["frames_interpolated"] == 0
    assert 0 < found["ate_rmse_all"] < 0.02 * found["path_length"]
    assert found["ate_rmse_tracked"] == pytest.approx(found["ate_rmse_all"])
    assert found["keyframes"] >= 2 and found["focal_sigma_ratio"] > 0 and found["choices"]
    blank = tmp_path / "blank"
    (blank / "rgb").mkdir(parents=True)
    for k in range(3):
        cv2.imwrite(str(blank / "rgb" / f"{k}.png"), np.zeros((48, 64, 3), np.uint8))
    (blank / "rgb.txt").write_text("".join(f"{k} rgb/{k}.png\n" for k in range(3)))
    result = tmp_path / "result.json"
    monkeypatch.setattr(sys, "argv", ["stress_entry.py", str(blank), str(tmp_path / "other"), str(result)])
    assert stress_entry.main() == 0
    said = json.loads(result.read_text())
    assert "expected pictures with something in them" in said["refused"] and said["wall_s"] >= 0


def test_a_path_is_measured_at_the_frames_alone() -> None:
    times = np.arange(10.0)
    positions = np.stack([times, times % 2, 0 * times], 1)
    assert stress_entry.path_length(times, positions, times) == pytest.approx(9 * 2**0.5)
    assert stress_entry.path_length(times, positions, times[2:9:2] + 0.01) == pytest.approx(6)


# -- the table -------------------------------------------------------------------------------------------------------


def made_up(sequence: str, variant: str, ate: float | None, **more: Any) -> dict[str, Any]:
    entry = stress.Entry(sequence, variant, sequence, 0, 40 if sequence == "hall" else None)
    figures: dict[str, Any] = {"configuration": entry.identity(), "processor_s": 1800.0, "date": "2026-11-28"}
    figures |= {"git_commit": "abc", "processor": "any", "cores": 2}
    if ate is not None:
        figures |= {"ate_rmse_all": ate, "path_length": 10.0, "never_joined": 0, "focal_px": 500.0}
        figures |= {"focal_true_px": 500.0, "focal_sigma_ratio": 0.02}
    return figures | more


ENTRIES = {
    f"{e['configuration']['sequence']}:{e['configuration']['variant']}": e
    for e in (
        made_up("hall", "base", 0.1),  # 1 %: up to 2 % holds
        made_up("hall", "blur", 0.2, focal_px=505.0),
        made_up("hall", "noise", 0.21, never_joined=2, focal_px=520.0),
        made_up("hall", "mirror+drop+noise", None, error="exit code -6: no message"),
        made_up("street", "base", 0.001),  # 0.01 %: the floor of 0.5 % is what holds
        made_up("street", "blur", 0.049, focal_sigma_ratio=None),
        made_up("street", "noise", 0.051),
        made_up("street", "mirror+drop+noise", None, refused="the camera never moves enough"),
    )
}


def cells(lines: list[str], name: str, nth: int = 0) -> list[str]:
    found = [line for line in lines if line.startswith(f"| {name}")]
    return [c.strip() for c in found[nth].strip("|").split("|")][1:]


def test_the_table_says_what_the_entries_hold(tmp_path: Path) -> None:
    (tmp_path / "stress.json").write_text(json.dumps(ENTRIES))
    lines = stress_table.stress(tmp_path / "stress.json", tmp_path / "stress.png")
    (missing,) = [line for line in lines if line.startswith("Not run")]
    ran = {e["configuration"]["sequence"] for e in ENTRIES.values()}
    assert all((name in missing) != (name in ran) for name in stress.SEQUENCES)
    # runs, base, median, worst, holds, never joined, refused, failed, focal off, in 1 sigma
    assert cells(lines, "hall (hall 0–39)") == [
        "4",
        "1.00",
        "2.10",
        "none",
        "1 of 3",
        "1 of 3",
        "0",
        "1",
        "1.0",
        "2 of 3",
    ]
    assert cells(lines, "street ")[:7] == ["4", "0.01", "0.51", "none", "1 of 3", "0 of 3", "1"]
    assert cells(lines, "street ")[9] == "2 of 2"
    assert cells(lines, "blur")[:6] == ["2", "–", "2.00", "2.00", "2 of 2", "0 of 2"]
    assert cells(lines, "base |")[4] == "–"  # nothing is held against itself
    assert cells(lines, "noise")[4:6] == ["0 of 2", "1 of 2"]
    assert cells(lines, "all |") == cells(lines, "all |", 1) and cells(lines, "all |")[4] == "2 of 6"
    at = dict(zip(stress_table.SHARES, cells(lines, "all, 8 runs"), strict=True))
    assert at[0.001] == "12%" and at[0.005] == "25%" and at[0.1] == "75%"
    assert cells(lines, "three changes, 2 runs")[-1] == "0%" and cells(lines, "base, 2 runs")[3] == "100%"
    assert "- hall, mirror+drop+noise failed: exit code -6: no message" in lines
    assert "- street, mirror+drop+noise refused: the camera never moves enough" in lines
    assert "4.0 hours of processor time" in lines[-1] and "8 runs" in "\n".join(lines)
    assert "(stress.png)" in "\n".join(lines) and "but `" not in "\n".join(lines)
    assert stress_table.stress(tmp_path / "none.json", tmp_path / "none.png") == []
    assert not (tmp_path / "none.png").exists()


def test_options_that_are_not_the_defaults_are_said(tmp_path: Path) -> None:
    entry = stress.Entry("hall", "base", "hall", 0, None, 0, "none", ("graph.kernel_px=2",))
    record = made_up("hall", "base", 0.1) | {"configuration": entry.identity()}
    (tmp_path / "stress.json").write_text(json.dumps({"hall:base": record}))
    text = "\n".join(stress_table.stress(tmp_path / "stress.json", tmp_path / "stress.png"))
    assert "but `--semantics none --set graph.kernel_px=2`" in text and "semantic maps" not in text


def test_other_options_have_a_table_of_their_own(tmp_path: Path) -> None:
    made = {}
    for variant, ate in (("base", 0.1), ("blur", 0.3), ("noise", None)):
        entry = stress.Entry("hall", variant, "hall", 0, None, 0, "people", ())
        record = made_up("hall", variant, 0.1) | {"configuration": entry.identity(), "ate_rmse_all": ate}
        made[f"hall:{variant}"] = record | {"frames_tracked": 9, "keyframes": 4}
    (tmp_path / "people.json").write_text(json.dumps(made))
    lines = stress_table.other_options(tmp_path / "people.json")
    assert "`--semantics people --only hall`" in lines[1] and "| hall | blur | 0.3000 | 9 | 4 |" in "\n".join(lines)
    assert "| hall | noise | none | 9 | 4 |" in "\n".join(lines) and "Median 0.3000, worst inf" in lines[-1]
    assert stress_table.other_options(tmp_path / "none.json") == []


def test_the_curve_rises_where_the_errors_are(tmp_path: Path) -> None:
    """From the left of the picture to the right, the curve of all runs climbs to the share that has a path."""
    stress_table.draw(list(ENTRIES.values()), tmp_path / "curve.png")
    image = cv2.imread(str(tmp_path / "curve.png"))
    ink = (np.abs(image.astype(int) - stress_table.INK).max(-1) < 12)[stress_table.TOP : -stress_table.BOTTOM + 3]
    columns = np.flatnonzero(ink.any(0))
    heights = ink.shape[0] - np.array([np.flatnonzero(ink[:, c]).mean() for c in columns])
    assert len(columns) > 300 and (np.diff(heights) > -4).all()
    plot = stress_table.SIZE[1] - stress_table.TOP - stress_table.BOTTOM
    assert heights[-1] / plot == pytest.approx(0.75, abs=0.02)


def test_the_picture_of_the_results_page_is_that_of_its_figures(tmp_path: Path) -> None:
    source, shown = ROOT / "benchmarks" / "results" / "stress.json", ROOT / "docs" / stress_table.PICTURE
    assert source.is_file() == shown.is_file()
    if source.is_file():
        stress_table.draw(list(json.loads(source.read_text()).values()), tmp_path / "drawn.png")
        drawn, kept = (cv2.imread(str(p)).astype(int) for p in (tmp_path / "drawn.png", shown))
        assert drawn.shape == kept.shape and np.abs(drawn - kept).mean() < 0.1  # fonts differ by version, curves do not
