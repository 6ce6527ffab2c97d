"""Files that lie beside the frames in one folder and are none: masks, label maps, depth."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from ..errors import InputError
from ..reading.pictures import BROKEN, opened
from .grey_levels import spread

WORDS = {
    *("mask", "masks", "m", "seg", "segm", "segmentation", "label", "labels", "labelids", "semantic", "instance"),
    *("alpha", "matte", "fg", "foreground", "silhouette", "depth", "depths", "disp", "disparity"),
}
CHECKED, AGREEING = 8, 0.75  # files of a kind that are looked at; share of them that must be no photograph
PIXELS = 50_000  # of a file that are looked at
FEW_VALUES, FEW_SHARE = 32, 0.99  # a label map: so many values or fewer make so much of it
ENDS, ENDS_SHARE = (24, 231), 0.97  # a mask that JPEG has blurred: so much of it lies outside of these grey levels
GREY = ("1", "L", "LA", "I", "I;16", "I;16B", "F")  # Pillow's modes of one channel
_BETWEEN = re.compile(r"[_\-. ]+")


def without_word(stem: str) -> str | None:
    """What a file's name has beside words for masks, "f000" of "f000_mask" or "mask_F000"; None without such a word."""
    parts = plain_name(stem).split("_")
    rest = [p for p in parts if p not in WORDS]
    return "_".join(rest) if rest and len(rest) < len(parts) else None


def plain_name(stem: str) -> str:
    """A name in small letters with "_" between its parts, as ``without_word`` gives it."""
    return "_".join(p for p in _BETWEEN.split(stem.casefold()) if p)


def beside_frames(files: Sequence[Path]) -> list[Path]:
    """Those of a folder's image files that belong to others and are no photographs, in their order.

    They are named as a frame with a word for masks or depth before or after it, or as a frame in files of another
    kind (0001.jpg, 0001.png, 0001.jpg.png); and most of those that are looked at have few values, or one channel
    beside colour.
    """
    kinds: dict[str, list[tuple[Path, Path]]] = {}
    plain = [p for p in files if without_word(p.stem) is None]
    names = {plain_name(p.stem): p for p in plain}
    numbers = {n: p for p in plain if (n := _numbers(p.stem))}
    for path in files:
        key = without_word(path.stem)
        if key is not None and (frame := names.get(key) or numbers.get(_numbers(key))) is not None:
            kinds.setdefault(_word(path.stem), []).append((path, frame))
    for suffix in {p.suffix.lower() for p in plain}:
        others = {p.stem.casefold(): p for p in plain if p.suffix.lower() != suffix}
        others |= {p.name.casefold(): p for p in plain}  # COLMAP's masks: 0001.jpg.png
        of_kind = [p for p in plain if p.suffix.lower() == suffix]
        kinds[suffix] = [(p, frame) for p in of_kind if (frame := others.get(p.stem.casefold())) is not None]
    found = {path for kind, pairs in kinds.items() if pairs and _no_photographs(kind, pairs) for path, _ in pairs}
    return [p for p in files if p in found]


def _numbers(stem: str) -> tuple[int, ...]:
    return tuple(int(n) for n in re.findall(r"\d+", stem))


def _word(stem: str) -> str:
    return next(p for p in plain_name(stem).split("_") if p in WORDS)


def _no_photographs(kind: str, pairs: list[tuple[Path, Path]]) -> bool:
    """Whether most files of one kind are no photographs, unlike the frames that they belong to."""
    looked_at = [pairs[k] for k in spread(range(len(pairs)), CHECKED)]
    seen = [_is_no_photograph(path, frame, named=kind in WORDS) for path, frame in looked_at]
    return sum(seen) >= AGREEING * len(seen)


def _is_no_photograph(path: Path, frame: Path, named: bool) -> bool:
    try:
        with opened(path) as image, opened(frame) as photograph:
            deep, colour = image.mode.startswith(("I", "F")), photograph.mode not in GREY
            if colour and (deep or (named and image.mode in (*GREY, "P"))):
                return True
            return _has_few_values(image) and not _has_few_values(photograph)
    except (InputError, *BROKEN):
        return False  # who reads it as an image says what is wrong with it


def _has_few_values(image: Image.Image) -> bool:
    """Whether an image is a mask or a label map: almost all of it has a few colours, or is nearly black or white."""
    colours = np.asarray(image if image.mode.startswith(("I", "F")) else image.convert("RGB"))
    step = max(1, int(np.sqrt(colours.shape[0] * colours.shape[1] / PIXELS)))
    taken = colours[::step, ::step].reshape(-1, *colours.shape[2:])
    counts = np.sort(np.unique(taken, axis=0, return_counts=True)[1])[::-1]
    if counts[:FEW_VALUES].sum() >= FEW_SHARE * counts.sum():
        return True
    grey = taken if taken.ndim == 1 else taken.mean(-1)
    return bool(((grey <= ENDS[0]) | (grey >= ENDS[1])).mean() >= ENDS_SHARE)
