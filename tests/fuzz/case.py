"""One bad input: how it is made, by which command it is read."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from fuzz.material import Shared


@dataclass(frozen=True)
class Room:
    """The folders of one case: what is in ``given`` is the user's and must not change."""

    path: Path

    @property
    def given(self) -> Path:
        return self.path / "given"

    @property
    def out(self) -> Path:
        return self.path / "out"

    def make(self) -> None:
        """All folders, empty."""
        for name in ("given", "tmp", "home", "cwd"):
            (self.path / name).mkdir(parents=True)


@dataclass(frozen=True)
class Case:
    """A command line; ``prepare`` is called in its process before it."""

    words: list[str | Path]
    prepare: Callable[[], None] | None = None
    env: dict[str, str] = field(default_factory=dict)


Make = Callable[[random.Random, Room, Shared], Case]
KINDS: dict[str, tuple[Make, int]] = {}  # name -> how a case of it is made, its share of a thousand


def kind(name: str, share: int) -> Callable[[Make], Make]:
    """Register a generator; ``share`` of a thousand cases are of it."""

    def add(make: Make) -> Make:
        KINDS[name] = (make, share)
        return make

    return add


def planned(count: int, seed: int, only: str | None = None) -> list[tuple[str, int]]:
    """(kind, seed) of every case of a round of ``count``; each kind has one case at least."""
    total = sum(share for _, share in KINDS.values())
    chosen = {n: max(1, round(count * share / total)) for n, (_, share) in KINDS.items() if only in (None, n)}
    return [(name, seed * 100_000 + n) for name, number in chosen.items() for n in range(number)]
