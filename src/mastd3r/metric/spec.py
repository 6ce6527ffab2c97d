"""The words of ``--scale``: what the metres are taken from."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

from ..errors import ConfigError
from ..reading.files import resolved, short, user_path

FORMS = {
    "depth": "depth:FOLDER[=UNITS_PER_METRE]",
    "positions": "positions:FILE",
    "points": "points:FRAME:X,Y:X,Y=METRES",
    "camera-height": "camera-height=METRES",
    "factor": "factor=NUMBER",
}
MOST_METRES = 1e6  # beyond, a length is none that a camera sees
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_PX = rf"({_NUMBER}),({_NUMBER})"
_POINTS = re.compile(rf"(?P<frame>.+):{_PX}:{_PX}=({_NUMBER})")


@dataclass(frozen=True)
class Asked:
    """A parsed ``--scale``; what a kind does not have is None."""

    kind: str  # one of FORMS
    path: Path | None = None  # depth: folder, positions: file
    number: float | None = None  # metres, the factor, or units per metre of depth files
    frame: str = ""  # points
    px: tuple[tuple[float, float], tuple[float, float]] | None = None  # points, of the full-size photograph

    @property
    def text(self) -> str:
        """The words again."""
        number = "" if self.number is None else f"={self.number!r}"
        if self.px is not None:
            places = ":".join(f"{x!r},{y!r}" for x, y in self.px)
            return f"{self.kind}:{self.frame}:{places}{number}"
        return f"{self.kind}{'' if self.path is None else f':{self.path}'}{number}"


def parsed(text: str) -> Asked:
    """The words of ``--scale``. Raises ConfigError for others; files are not looked at."""
    kind = re.split("[:=]", text, maxsplit=1)[0]
    rest = text[len(kind) :]
    if kind not in FORMS or len(rest) < 2 or (kind in ("camera-height", "factor")) != (rest[0] == "="):
        raise ConfigError(f"--scale: expected {', '.join(FORMS.values())}, got {short(repr(text))}")
    if kind in ("camera-height", "factor"):
        return Asked(kind, number=_length(rest[1:], kind, text))
    if kind == "points":
        found = _POINTS.fullmatch(rest[1:])
        if found is None:
            raise _unlike(kind, text)
        x0, y0, x1, y1 = (float(n) for n in found.groups()[1:5])
        return Asked(kind, number=_length(found[6], kind, text), frame=found["frame"], px=((x0, y0), (x1, y1)))
    path, units = rest[1:], None
    if kind == "depth" and (said := re.fullmatch(rf"(.+)=({_NUMBER})", path)):
        path, units = said[1], _length(said[2], kind, text)
    return Asked(kind, user_path(path, "--scale", ConfigError), units)


def absolute(text: str) -> str:
    """The same words with an absolute path, so that they mean the same from everywhere; empty stays empty.

    Raises ConfigError, and InputError for links that lead in a circle.
    """
    if not text:
        return ""
    asked = parsed(text)
    return asked.text if asked.path is None else replace(asked, path=resolved(asked.path)).text


def _length(word: str, kind: str, text: str) -> float:
    try:
        number = float(word)
    except ValueError as e:
        raise _unlike(kind, text) from e
    if not (math.isfinite(number) and 1 / MOST_METRES <= number <= MOST_METRES):
        raise ConfigError(f"--scale {kind}: expected a number of {1 / MOST_METRES:g} to {MOST_METRES:g}, got {word}")
    return number


def _unlike(kind: str, text: str) -> ConfigError:
    return ConfigError(f"--scale: expected {FORMS[kind]}, got {short(repr(text))}")
