"""What is known of a dataset before any of it is here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

UNPACKED_RATIO = 4  # what an archive may hold, over its own size: its pictures are compressed already
UNPACKED_LEAST_BYTES = 64 * 2**20  # and this much in any case: lists and poses are text


@dataclass(frozen=True)
class Archive:
    """One file on the dataset's server."""

    path: str  # under the dataset's root URL
    name: str = ""  # of the file here, where the path does not end with one
    size_bytes: int | None = None  # exact: another size is refused
    about_bytes: int | None = None  # as the dataset's page says, for people
    md5: str | None = None  # where its server publishes one

    @property
    def file_name(self) -> str:
        """How the file is called here."""
        return self.name or self.path.rpartition("/")[2]


@dataclass(frozen=True)
class Part:
    """What a sequence takes out of an archive."""

    archive: str  # key of Dataset.archives
    only: tuple[str, ...] = ("",)  # beginnings of the paths that are wanted
    nested: bool = False  # these are zips, unpacked where they lie


@dataclass(frozen=True)
class Sequence:
    """One sequence, or one scene of several."""

    name: str
    folder: str  # under the dataset's folder, when it is unpacked: what a user opens
    parts: tuple[Part, ...]


@dataclass(frozen=True)
class Dataset:
    """One dataset."""

    name: str
    title: str
    root: str  # URL
    home: str  # page for people
    licence: str
    archives: Mapping[str, Archive]
    sequences: Mapping[str, Sequence]
    note: str = ""  # what its owners ask for
    prefix: str = ""  # of sequence names, which may be left out

    @cached_property
    def shared(self) -> frozenset[str]:
        """Archives that several sequences come out of."""
        uses = [part.archive for s in self.sequences.values() for part in s.parts]
        return frozenset(key for key in self.archives if uses.count(key) > 1)

    def size_of(self, sequence: Sequence) -> int | None:
        """Bytes to fetch for one sequence; None where any of it is not known."""
        sizes = [a.size_bytes or a.about_bytes for a in (self.archives[p.archive] for p in sequence.parts)]
        return sum(s for s in sizes if s) if all(sizes) else None
