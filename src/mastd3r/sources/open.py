"""Finding out, by looking at the files, what kind of source a path is."""

from __future__ import annotations

from pathlib import Path

from ..config import SourceConfig
from ..errors import InputError
from ..types import Source
from .image_folder import ImageFolderSource, image_files
from .tum import TumSource


def open_source(
    path: str | Path,
    config: SourceConfig,
    *,
    want_depth: bool = False,
    want_semantic: bool = True,
    semantic_dir: Path | None = None,
) -> Source:
    """Open a video file, a folder of images, or a TUM-layout folder (one with an rgb.txt).

    ``want_depth`` and ``want_semantic`` decide whether frames carry depth and semantic maps; what is not
    wanted is not read. ``semantic_dir`` holds the user's own maps and goes before those of the folder.
    Raises InputError (missing, empty, unreadable, unknown kind) and ConfigError (window out of range).
    """
    path = Path(path).expanduser()
    if not path.exists():
        raise InputError(f"{path}: expected a video or a folder of images, got no such path")
    if path.is_file():
        from .video import VideoSource  # brings PyAV, which folders do not need

        return VideoSource(path, config, want_semantic=want_semantic, semantic_dir=semantic_dir)
    if not path.is_dir():
        raise InputError(f"{path}: expected a file or a folder, got something else")
    if (path / "rgb.txt").is_file():
        return TumSource(path, config, want_depth=want_depth, want_semantic=want_semantic, semantic_dir=semantic_dir)
    _refuse_without_images(path)
    return ImageFolderSource(path, config, want_semantic=want_semantic, semantic_dir=semantic_dir)


def _refuse_without_images(folder: Path) -> None:
    """Raise InputError where a folder has no images, and say where images may be instead."""
    if image_files(folder):
        return
    entries = sorted(p for p in folder.iterdir() if not p.name.startswith("."))
    if not entries:
        raise InputError(f"{folder}: expected images or a TUM layout, got an empty folder")
    inner = next((p for p in entries if p.is_dir() and image_files(p)), None)
    hint = f"; its folder {inner.name} has images" if inner else ""
    raise InputError(
        f"{folder}: expected images (jpg, jpeg, png, webp) or a TUM layout (rgb.txt), "
        f"got {len(entries)} other entries, the first {entries[0].name}{hint}"
    )
