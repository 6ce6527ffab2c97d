"""Finding out, by looking at the files, what kind of source a path is."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..config import SourceConfig
from ..errors import InputError
from ..reading.files import entries_of, is_dir, is_file, user_path
from ..types import Source
from . import bonn, euroc, kitti_odometry, kitti_raw, replica, seven_scenes, tum_rgbd
from .bonn import BonnSource
from .image_folder import ImageFolderSource, image_files
from .sequence import Sequenced, SequenceSource, Wants
from .tum import TumSource

DEEP, LOOKED_AT = 4, 500  # levels and folders below the one that was named, in which sequences are looked for
SHOWN = 6  # sequences that a message names
IMAGES = "images (jpg, jpeg, png, webp)"


@dataclass(frozen=True)
class Layout:
    """One kind of folder: how it is recognised, and how it is opened."""

    kind: str
    expected: str
    looks_like: Callable[[Path], str | None]  # what was seen that makes it of this kind
    open: Callable[[Path, SourceConfig, Wants, str], Source]
    refines: str | None = None  # the kind that also fits, and less well


def _sequence(find: Callable[[Path], Sequenced]) -> Callable[[Path, SourceConfig, Wants, str], Source]:
    return lambda folder, config, wants, found: SequenceSource(find(folder), config, wants)


def _tum(folder: Path, config: SourceConfig, wants: Wants, found: str) -> Source:
    recording = tum_rgbd.recording_of(folder) if is_file(folder / "rgb.txt") else None
    return TumSource(
        folder,
        config,
        want_depth=wants.depth,
        want_semantic=wants.semantic,
        semantic_dir=wants.semantic_dir,
        published=tum_rgbd.CAMERAS[recording[1]] if recording else (),
        lens_size=tum_rgbd.SIZE,
        found=f"{found}; its head names {recording[0]}: camera {recording[1]}" if recording else found,
    )


def _images(folder: Path, config: SourceConfig, wants: Wants, found: str) -> Source:
    return ImageFolderSource(folder, config, want_semantic=wants.semantic, semantic_dir=wants.semantic_dir)


LAYOUTS = (
    Layout(tum_rgbd.KIND, tum_rgbd.EXPECTED, tum_rgbd.looks_like, _tum),
    Layout(bonn.KIND, bonn.EXPECTED, bonn.looks_like, BonnSource, refines=tum_rgbd.KIND),
    *(
        Layout(m.KIND, m.EXPECTED, m.looks_like, _sequence(m.find))
        for m in (kitti_raw, kitti_odometry, seven_scenes, euroc, replica)
    ),
)


def open_source(
    path: str | Path,
    config: SourceConfig,
    *,
    want_depth: bool = False,
    want_semantic: bool = True,
    semantic_dir: Path | None = None,
) -> Source:
    """Open a video file, a folder of images, or a folder of one of ``LAYOUTS``, told apart by the files that are there.

    ``want_depth`` and ``want_semantic`` decide whether frames carry depth and semantic maps; what is not
    wanted is not read. ``semantic_dir`` holds the user's own maps and goes before those of the folder.
    Raises InputError (missing, empty, unreadable, unknown or ambiguous kind) and ConfigError (window out of range).
    """
    path = user_path(path)
    wants = Wants(want_depth, want_semantic, semantic_dir)
    if not os.path.exists(path):
        raise InputError(f"{path}: expected a video or a folder of images, got no such path")
    if is_file(path):
        if config.kind not in ("auto", "video"):
            raise InputError(f"{path}: expected a folder, as --kind {config.kind} says, got a file")
        from .video import VideoSource  # brings PyAV, which folders do not need

        return VideoSource(path, config, want_semantic=want_semantic, semantic_dir=semantic_dir)
    if not is_dir(path):
        raise InputError(f"{path}: expected a file or a folder, got a named pipe, a socket or a device")
    if config.kind == "video":
        raise InputError(f"{path}: expected a video file, as --kind video says, got a folder")
    if config.kind == "images":
        return _images(path, config, wants, "")
    if config.kind != "auto":
        chosen = next(layout for layout in LAYOUTS if layout.kind == config.kind)
        return chosen.open(path, config, wants, f"as --kind says, {chosen.looks_like(path) or 'unlike as it looks'}")
    fitting = _fitting(path)
    if len(fitting) > 1:
        seen = " or ".join(f"{layout.kind} ({why})" for layout, why in fitting)
        raise InputError(f"{path}: expected files of one kind, got what could be {seen}; say which with --kind")
    for layout, why in fitting:
        return layout.open(path, config, wants, why)
    _refuse_without_images(path)
    return _images(path, config, wants, "")


def _fitting(folder: Path) -> list[tuple[Layout, str]]:
    """The layouts that a folder may be, and what was seen; a kind that another one refines is left out."""
    seen = [(layout, why) for layout in LAYOUTS if (why := layout.looks_like(folder)) is not None]
    refined = {layout.refines for layout, _ in seen}
    return [(layout, why) for layout, why in seen if layout.kind not in refined]


def _refuse_without_images(folder: Path) -> None:
    """Raise InputError where a folder has no images, and say where images or sequences may be instead."""
    if image_files(folder):
        return
    entries = [p for p in entries_of(folder) if not p.name.startswith(".")]
    if not entries:
        raise InputError(f"{folder}: expected images or a TUM layout, got an empty folder")
    inside = [p.relative_to(folder).as_posix() for p in _sequences_in(folder)]
    if inside:
        more = f" and {len(inside) - SHOWN} more" if len(inside) > SHOWN else ""
        raise InputError(
            f"{folder}: expected one sequence, got a folder that holds {len(inside)}; name one of them: "
            f"{', '.join(inside[:SHOWN])}{more}"
        )
    inner = next((p for p in entries if _can_be_listed(p) and image_files(p)), None)
    hint = f"; its folder {inner.name} has images" if inner else ""
    raise InputError(
        f"{folder}: expected {IMAGES}, or {'; '.join(layout.expected for layout in LAYOUTS)}; "
        f"got {len(entries)} other entries, the first {entries[0].name}{hint}"
    )


def _can_be_listed(path: Path) -> bool:
    return os.path.isdir(path) and os.access(path, os.R_OK | os.X_OK)


def _sequences_in(folder: Path) -> list[Path]:
    """Folders inside that one of the layouts fits, nearest first; no more than ``LOOKED_AT`` folders are looked at."""
    found: list[Path] = []
    level, looked_at = [folder], 0
    for _ in range(DEEP):
        inside = [p for f in level for p in entries_of(f)]
        inside = [p for p in inside if not p.name.startswith(".") and _can_be_listed(p)]
        inside = inside[: max(0, LOOKED_AT - looked_at)]
        looked_at += len(inside)
        fits = {p: bool(_fitting(p)) for p in inside}
        found += [p for p in inside if fits[p]]
        level = [p for p in inside if not fits[p]]
    return sorted(found)
