"""A run folder never costs anybody's files: sources, other tools' folders and links are refused untouched."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mastd3r.errors import OutputError
from mastd3r.export.claim import FOLDERS, claim
from mastd3r.export.run_folder import RunFolder


def everything_in(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def finished_run(path: Path) -> Path:
    run = RunFolder(path)
    (path / "masks" / "1.500000.png").write_bytes(b"mask")
    run.finish()
    return path


def holds_the_video(root: Path) -> tuple[Path, list[Path]]:
    folder = finished_run(root / "self")
    (folder / "flight.mp4").write_bytes(b"a flight that is the source now")
    return folder, [folder / "flight.mp4"]


def is_the_source(root: Path) -> tuple[Path, list[Path]]:
    folder = finished_run(root / "run")
    return folder, [folder]


def masks_of_a_run(root: Path) -> tuple[Path, list[Path]]:
    folder = finished_run(root / "x")
    return folder, [folder / "masks"]


def lies_in_the_source(root: Path) -> tuple[Path, list[Path]]:
    (root / "photos").mkdir()
    (root / "photos" / "1.png").write_bytes(b"photo")
    return root / "photos" / "run", [root / "photos"]


def through_a_link(root: Path) -> tuple[Path, list[Path]]:
    (root / "real").mkdir()
    (root / "real" / "clip.mp4").write_bytes(b"video")
    (root / "link").symlink_to(root / "real")
    return root / "link", [root / "real" / "clip.mp4"]


def another_tools_record(root: Path) -> tuple[Path, list[Path]]:
    folder = root / "other"
    (folder / "depth").mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps({"status": "complete", "args": []}))
    (folder / "config.yaml").write_text("theirs: 1")
    (folder / "depth" / "0.000000.png").write_bytes(b"their depth")
    return folder, []


def linked_masks(root: Path) -> tuple[Path, list[Path]]:
    folder = finished_run(root / "run")
    (root / "elsewhere").mkdir()
    (root / "elsewhere" / "1.000000.png").write_bytes(b"somebody's")
    for old in (folder / "masks").iterdir():
        old.unlink()
    (folder / "masks").rmdir()
    (folder / "masks").symlink_to(root / "elsewhere")
    return folder, []


def unreadable_record(root: Path) -> tuple[Path, list[Path]]:
    folder = root / "odd"
    folder.mkdir()
    (folder / "run.json").write_text("not json")
    (folder / "trajectory.txt").write_text("0 0 0 0 0 0 0 1\n")
    return folder, []


def somebodys_unfinished_folder(root: Path) -> tuple[Path, list[Path]]:
    folder = finished_run(root / "run")
    (folder / "unfinished").mkdir()
    (folder / "unfinished" / "trajectory.txt").write_text("a novel")
    return folder, []


CASES = (
    holds_the_video, is_the_source, masks_of_a_run, lies_in_the_source, through_a_link, another_tools_record,
    linked_masks, unreadable_record, somebodys_unfinished_folder,
)  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_a_folder_that_is_not_ours_alone_is_refused_untouched(case: object, tmp_path: Path) -> None:
    folder, inputs = case(tmp_path)  # type: ignore[operator]
    before = everything_in(tmp_path)
    with pytest.raises(OutputError, match=r"expected .* got .*--out") as caught:
        RunFolder(folder, [], inputs)
    assert "\n" not in str(caught.value)
    assert everything_in(tmp_path) == before


def test_only_pictures_that_a_run_names_are_removed(tmp_path: Path) -> None:
    folder = finished_run(tmp_path / "run")
    (folder / "masks" / "mine.png").write_bytes(b"keep")
    (folder / "masks" / "1.5.png").write_bytes(b"keep")
    RunFolder(folder)
    assert sorted(p.name for p in (folder / "masks").iterdir()) == ["1.5.png", "mine.png"]


def test_what_a_run_leaves_that_was_stopped_at_once_is_no_obstacle(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    for name in FOLDERS:
        (folder / name).mkdir(parents=True)
    for name in (".reserve", ".reserve.part", "run.json.part"):
        (folder / name).write_bytes(b"0")
    assert claim(folder) == folder
    assert not (folder / "run.json.part").exists()
    (folder / "masks" / "0.1.png").write_bytes(b"of somebody")
    with pytest.raises(OutputError, match="other files"):
        claim(folder)
