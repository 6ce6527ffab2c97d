"""An export is whole or not there, and costs nobody a file."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from mastd3r.errors import InputError, OutputError
from mastd3r.export.export_folder import export_folder


def export(out: Path, *names: str, inputs: tuple[Path, ...] = ()) -> None:
    with export_folder(out, {"kind": "colmap"}, inputs) as staged:
        for name in names:
            (staged / name).parent.mkdir(parents=True, exist_ok=True)
            (staged / name).write_text(name)


def everything_in(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_it_takes_the_place_of_nothing_an_empty_folder_and_an_earlier_export(tmp_path: Path) -> None:
    export(tmp_path / "deep" / "out", "images/a.png")
    (tmp_path / "empty").mkdir()
    export(tmp_path / "empty", "a")
    export(tmp_path / "deep" / "out", "b")
    assert set(everything_in(tmp_path)) == {"deep/out/b", "deep/out/export.json", "empty/a", "empty/export.json"}
    record = json.loads((tmp_path / "empty" / "export.json").read_text())
    assert record == {"made_by": "mastd3r export", "kind": "colmap", "files": ["a"]}


@pytest.mark.parametrize("error", [InputError("x"), KeyboardInterrupt(), RuntimeError("x")])
def test_what_stops_it_leaves_what_was_there(tmp_path: Path, error: BaseException) -> None:
    export(tmp_path / "out", "a")
    before = everything_in(tmp_path)

    def stopped() -> None:
        with export_folder(tmp_path / "out", {}, ()) as staged:
            (staged / "half").write_text("half")
            raise error

    with pytest.raises(type(error)):
        stopped()
    assert everything_in(tmp_path) == before
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def added_to_an_export(root: Path) -> Path:
    export(root / "out", "a")
    (root / "out" / "trained.ply").write_text("hours of training")
    return root / "out"


def somebody_elses(root: Path) -> Path:
    (root / "out").mkdir()
    (root / "out" / "thesis.txt").write_text("years of work")
    return root / "out"


def another_tools_record(root: Path) -> Path:
    (root / "out").mkdir()
    (root / "out" / "export.json").write_text(json.dumps({"made_by": "theirs", "files": []}))
    return root / "out"


def a_linked_folder_in_it(root: Path) -> Path:
    export(root / "out", "a")
    (root / "real").mkdir()
    (root / "out" / "b").symlink_to(root / "real")
    return root / "out"


def a_file(root: Path) -> Path:
    (root / "out").write_text("a file")
    return root / "out"


def a_link(root: Path) -> Path:
    (root / "real").mkdir()
    (root / "out").symlink_to(root / "real")
    return root / "out"


def in_the_source(root: Path) -> Path:
    (root / "photos").mkdir()
    (root / "photos" / "1.png").write_bytes(b"photo")
    return root / "photos" / "out"


def holds_the_source(root: Path) -> Path:
    return in_the_source(root).parent.parent


@pytest.mark.parametrize(
    "case",
    [
        added_to_an_export,
        somebody_elses,
        another_tools_record,
        a_linked_folder_in_it,
        a_file,
        a_link,
        in_the_source,
        holds_the_source,
    ],
    ids=lambda case: case.__name__,
)
def test_other_places_are_refused_untouched(case: object, tmp_path: Path) -> None:
    out = case(tmp_path)  # type: ignore[operator]
    before = everything_in(tmp_path)
    with pytest.raises(OutputError, match=r"expected .* got .*--out") as caught:
        export(out, "b", inputs=(tmp_path / "photos",))
    assert "\n" not in str(caught.value)
    assert everything_in(tmp_path) == before


def test_a_home_with_much_in_it_is_refused_by_its_first_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    somebody_elses(tmp_path)
    for n in range(20):
        (tmp_path / "out" / f"cache-{n}").mkdir()
    listed: list[object] = []
    scandir = os.scandir
    monkeypatch.setattr(os, "scandir", lambda where: listed.append(where) or scandir(where))
    with pytest.raises(OutputError, match="thesis"):
        export(tmp_path / "out", "b")
    assert 1 <= len(listed) < 5


def test_what_cannot_be_listed_is_not_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export(tmp_path / "out", "a", "shut/b")
    scandir = os.scandir

    def refusing(where: object) -> object:
        if Path(str(where)).name == "shut":
            raise PermissionError(13, "Permission denied", str(where))
        return scandir(where)  # type: ignore[call-overload]

    monkeypatch.setattr(os, "scandir", refusing)
    with pytest.raises(OutputError, match="Permission denied"):
        export(tmp_path / "out", "c")
    monkeypatch.undo()
    assert set(everything_in(tmp_path)) == {"out/a", "out/shut/b", "out/export.json"}
