"""docs/paper_map.md is true: every entry is there, and its file names the equation."""

from __future__ import annotations

import importlib
import re
import tokenize
from itertools import pairwise
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "mastd3r"
TEXT = (ROOT / "docs" / "paper_map.md").read_text(encoding="utf-8")
ENTRY = re.compile(r"`([\w/]+\.py):([\w.]+)`")
CODE_SPAN = re.compile(r"`([^`]*\.py[^`]*)`")


def table() -> dict[str, list[tuple[str, str]]]:
    """First cell of each row -> its entries (file, name)."""
    rows = [line for line in TEXT.partition("## The newcomer")[0].splitlines() if line.startswith("| ") and "`" in line]
    return {row.split("|")[1].strip(): ENTRY.findall(row) for row in rows}


def equations_named(path: Path) -> set[int]:
    """Numbers that a file's comments and strings name: (8), eq. (8), (9)(10), (5)-(8), (13) to (17)."""
    with path.open("rb") as file:
        words = [t.string for t in tokenize.tokenize(file.readline) if t.type in (tokenize.COMMENT, tokenize.STRING)]
    text = "\n".join(words)
    found = {int(n) for n in re.findall(r"\((\d{1,2})\)", text)}
    for first, last in re.findall(r"\((\d{1,2})\)\s*(?:-|–|to)\s*\((\d{1,2})\)", text):
        found |= set(range(int(first), int(last) + 1))
    return found


def numbers_of(cell: str) -> set[int]:
    return {int(n) for n in re.findall(r"\((\d+)\)", cell)}


def test_every_equation_has_a_row() -> None:
    named = [n for cell in table() for n in sorted(numbers_of(cell))]
    assert sorted(named) == list(range(1, 18))
    assert "Algorithm 1" in table()


@pytest.mark.parametrize(("file", "name"), sorted(set(ENTRY.findall(TEXT))))
def test_entry_resolves(file: str, name: str) -> None:
    target = importlib.import_module("mastd3r." + file.removesuffix(".py").replace("/", "."))
    for part in name.split("."):
        target = getattr(target, part)
    assert callable(target)


@pytest.mark.parametrize("cell", sorted(c for c in table() if c.startswith("(")))
def test_a_file_of_the_row_names_the_equation(cell: str) -> None:
    named = set().union(*(equations_named(PACKAGE / file) for file, _ in table()[cell]))
    assert numbers_of(cell) <= named


def test_the_algorithm_is_named_where_it_is() -> None:
    assert any("Algorithm 1" in (PACKAGE / f).read_text(encoding="utf-8") for f, _ in table()["Algorithm 1"])


def test_no_entry_is_misspelt() -> None:
    """Whatever looks like a file of the package is an entry that the tests above check."""
    spans = [s for s in CODE_SPAN.findall(TEXT.partition("## The newcomer")[0]) if not s.startswith("tests/")]
    assert [s for s in spans if not ENTRY.fullmatch(f"`{s}`")] == []


def newcomers_paths() -> dict[str, list[str]]:
    """First cell of each row of the newcomer's path -> the files opened after slam.py."""
    rows = [line.split("|") for line in TEXT.partition("## The newcomer")[2].splitlines() if line.startswith("| ")]
    return {
        cells[1].strip(): CODE_SPAN.findall(cells[2]) for cells in rows if ".py" in cells[2] and "slam" not in cells[2]
    }


def test_a_newcomer_opens_two_files_at_most() -> None:
    paths = newcomers_paths()
    assert sorted(n for cell in paths for n in numbers_of(cell)) == list(range(1, 18)) and "Algorithm 1" in paths
    assert all(1 <= len(files) <= 2 for files in paths.values())


@pytest.mark.parametrize("cell", sorted(newcomers_paths()))
def test_every_file_of_the_path_leads_on(cell: str) -> None:
    """A file names the next by its path or imports it; the last one names the equation itself."""
    files = newcomers_paths()[cell]
    for here, there in pairwise(["slam.py", *files]):
        text = (PACKAGE / here).read_text(encoding="utf-8")
        assert there in text or there.removesuffix(".py").rpartition("/")[2] in text, f"{here} does not lead to {there}"
    last = PACKAGE / files[-1]
    if cell == "Algorithm 1":
        assert "Algorithm 1" in last.read_text(encoding="utf-8")
    else:
        assert numbers_of(cell) <= equations_named(last)
