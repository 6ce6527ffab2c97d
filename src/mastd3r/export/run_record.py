"""What run.json, camera.json and metrics.json may say: every field that is read back has its type, checked here."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

from ..camera.pinhole import Camera
from ..errors import InputError
from ..reading.files import short, whole_json
from ..reading.pictures import MOST_PIXELS
from ..types import State

NOT_OF_THE_LENS = ("found", "focal_sigma_ratio")  # of camera.json
MOST_FOCAL_RATIO = 1e4  # of the image's longer side
MOST_SCALE = 1e9  # metres a map unit, and map units a metre
MOST_TERMS = 8  # of OpenCV's lens
Fits = Callable[[Any], bool]


def number(value: Any) -> bool:
    """A finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -1e300 < value < 1e300


def above_0(value: Any) -> bool:
    """A finite number above 0."""
    return number(value) and value > 0


def not_negative(value: Any) -> bool:
    """A finite number, 0 or more."""
    return number(value) and value >= 0


def text(value: Any) -> bool:
    """Text, or nothing."""
    return value is None or isinstance(value, str)


def texts(value: Any) -> bool:
    """A list of text."""
    return isinstance(value, list) and all(isinstance(v, str) for v in value)


def mapping(of: Fits = lambda value: True) -> Fits:
    """An object whose values are all of one kind, or nothing."""
    return lambda value: value is None or (isinstance(value, dict) and all(of(v) for v in value.values()))


def _states(value: Any) -> bool:
    return isinstance(value, list) and all(
        isinstance(v, list) and len(v) == 2 and v[0] in get_args(State) and type(v[1]) is int and v[1] >= 0
        for v in value
    )


RECORD: dict[str, tuple[Fits, str]] = {
    "status": (lambda v: v in ("running", "complete", "incomplete"), "running, complete or incomplete"),
    "reason": (text, "text"),
    "started": (text, "text"),
    "finished": (text, "text"),
    "command": (texts, "a list of words"),
    "choices": (texts, "a list of lines"),
    "machine": (mapping(), "an object"),
    "timings_s": (mapping(number), "numbers by name"),
    "source": (mapping(), "an object"),
    "source.path": (text, "text"),
    "source.maps": (text, "text"),
    "source.kind": (text, "text"),
    "source.map": (text, "text"),
    "continues": (mapping(), "an object"),
    "continues.map": (text, "text"),
    "continues.digest": (text, "text"),
    "continues.found": (lambda v: isinstance(v, bool), "true or false"),
    "continues.said": (text, "text"),
    "states": (_states, "pairs of a state and how often it follows"),
    "files": (mapping(text), "names by time"),
    "map": (mapping(), "an object"),
    "map.median_depth": (above_0, "a number above 0"),
    "observability": (mapping(), "an object"),
    "observability.said": (text, "text"),
    "camera": (mapping(), "an object"),
    "camera.focal_sigma_ratio": (lambda v: v is None or not_negative(v), "a number, 0 or more"),
    "camera.found": (text, "text"),
    "world": (mapping(), "an object"),
    "world.down_sigma_deg": (not_negative, "degrees"),
    "scale": (mapping(), "an object"),
    "scale.asked": (text, "text"),
    "scale.metres_per_unit": (lambda v: number(v) and 1 / MOST_SCALE < v < MOST_SCALE, "metres of a map unit"),
    "scale.sigma_ratio": (lambda v: v is None or not_negative(v), "a number, 0 or more"),
    "scale.applied": (lambda v: isinstance(v, bool), "true or false"),
    "scale.said": (text, "text"),
    "scale.refused": (text, "text"),
    "graph": (mapping(), "an object"),
    "segments": (mapping(), "an object"),
    "segments.frames": (lambda v: type(v) is int and v > 0, "a number of frames"),
    "live": (mapping(), "an object"),
    "live.recorded": (lambda v: isinstance(v, bool), "true or false"),
    "live.figures": (mapping(number), "numbers by name"),
}


def checked_record(record: dict[str, Any], path: Path) -> dict[str, Any]:
    """The same. Raises InputError, naming the field, for a value that no run writes; fields may be absent."""
    for key, (fits, expected) in RECORD.items():
        outer, _, inner = key.partition(".")
        place = record.get(outer) or {} if inner else record
        name = inner or outer
        if name in place and not fits(place[name]):
            raise InputError(f"{path} {key}: expected {expected}, got {short(repr(place[name]))}")
    return record


def read_record(folder: Path) -> dict[str, Any]:
    """run.json of a run folder, checked. Raises InputError."""
    return checked_record(whole_json(folder / "run.json"), folder / "run.json")


def checked_metrics(path: Path) -> dict[str, Any]:
    """metrics.json, nothing where there is none: figures, None and notes by name. Raises InputError."""
    if not os.path.lexists(path):
        return {}
    metrics = whole_json(path)
    for key, value in metrics.items():
        if not (text(value) or isinstance(value, bool) or number(value)):
            raise InputError(f"{path} {short(key)}: expected a number or a note, got {short(repr(value))}")
        if isinstance(value, str) and not key.endswith("_note"):
            raise InputError(f"{path} {short(key)}: expected a number, got {short(repr(value))}")
    return metrics


def checked_camera(path: Path) -> tuple[Camera, tuple[float, ...]]:
    """The camera and its whole distortion, empty where camera.json has no such list. Raises InputError."""
    data = {k: v for k, v in whole_json(path).items() if k not in NOT_OF_THE_LENS}
    distortion = data.pop("distortion", [])
    if not (isinstance(distortion, list) and all(map(number, distortion)) and len(distortion) <= MOST_TERMS):
        raise InputError(f"{path} distortion: expected at most {MOST_TERMS} numbers, got {short(repr(distortion))}")
    for key in ("width", "height"):
        side = data.get(key)
        if type(side) is not int or side < 1:
            raise InputError(f"{path} {key}: expected pixels, 1 or more, got {short(repr(side))}")
    if data["width"] * data["height"] > MOST_PIXELS:
        raise InputError(f"{path}: expected at most {MOST_PIXELS} pixels, got {data['width']}x{data['height']}")
    most = MOST_FOCAL_RATIO * max(data["width"], data["height"])
    for key, value in data.items():
        if not number(value) or abs(value) > most or (key in ("fx_px", "fy_px") and not value > 1 / MOST_FOCAL_RATIO):
            raise InputError(f"{path} {short(key)}: expected a number of a lens, got {short(repr(value))}")
    try:
        return Camera(**data), tuple(float(v) for v in distortion)
    except TypeError as e:
        raise InputError(f"{path}: expected the fields of a camera, got {e}") from e
