"""What ``mastd3r download`` does: list the public datasets, bring sequences of them."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from ..errors import ConfigError
from .options import path
from .screen import screen

if TYPE_CHECKING:
    from ..download.dataset_types import Dataset
    from ..download.datasets import Accept

LIST = "list"


def download_parser(p: argparse.ArgumentParser) -> None:
    """Fill in the parser of ``download``."""
    p.add_argument("dataset", nargs="?", default=LIST, help="a name of the list; without one, the list is shown")
    p.add_argument("sequences", nargs="*", metavar="SEQUENCE", help="which; 'all'; without one, they are listed")
    p.add_argument("--to", type=path, default=Path("datasets"), metavar="DIR", help="where to (default datasets)")
    p.add_argument("--yes", action="store_true", help="accept the licence without being asked")
    p.add_argument("--quiet", action="store_true", help="no progress bars")
    p.set_defaults(act=_download)


def _download(args: argparse.Namespace, console: Console) -> int:
    from ..download.datasets import dataset_of, download, kept_archives
    from ..download.fetch import human_bytes
    from ..progress import FileBars, Silent
    from .terminal import Terminal

    out = screen()
    if args.dataset == LIST:
        return _list(args.sequences, out)
    dataset = dataset_of(args.dataset)
    if not args.sequences:
        return _list([args.dataset], out)
    with FileBars(Silent() if args.quiet else Terminal(console)) as bars:
        accept = _accept(args.yes, console)
        brought = download(dataset, args.sequences, args.to, accept, watch=bars.watch)
    for one in brought:
        word = "ready" if one.fetched else "was there"
        out.print(f"{word}: {one.path}", highlight=False, soft_wrap=True, markup=False)
    for file in kept_archives(dataset, args.to):
        size = human_bytes(file.stat().st_size)
        console.print(
            f"kept, other sequences come out of it: {file} ({size})", highlight=False, soft_wrap=True, markup=False
        )
    return 0


def _list(names: list[str], out: Console) -> int:
    from ..download.datasets import dataset_of
    from ..download.datasets_known import KNOWN

    chosen = [dataset_of(name) for name in names] or list(KNOWN.values())
    for dataset in chosen:
        out.print(f"\n[bold]{dataset.name}[/bold]  {dataset.title}", highlight=False)
        for line in _about(dataset):
            out.print(f"  {line}", highlight=False, soft_wrap=True)
        if names:
            out.print(_sequences(dataset))
        else:
            out.print(f"  {_shortly(dataset)}", highlight=False)
    return 0


def _about(dataset: Dataset) -> list[str]:
    return [f"home: {dataset.home}", f"licence: {dataset.licence}", *([dataset.note] if dataset.note else [])]


def _sequences(dataset: Dataset) -> Table:
    """Every sequence with what has to be fetched for it."""
    from ..download.fetch import human_bytes

    table = Table("sequence", "to fetch", "shared with others")
    for sequence in dataset.sequences.values():
        size = dataset.size_of(sequence)
        shared = sorted(dataset.archives[p.archive].file_name for p in sequence.parts if p.archive in dataset.shared)
        table.add_row(sequence.name, human_bytes(size) if size else "–", ", ".join(shared))
    return table


def _shortly(dataset: Dataset) -> str:
    from ..download.fetch import human_bytes

    def shown(name: str) -> str:
        size = dataset.size_of(dataset.sequences[name])
        return f"{name} ({human_bytes(size)})" if size and not dataset.shared else name

    sizes = [a.size_bytes or a.about_bytes for a in dataset.archives.values()]
    known = sum(s for s in sizes if s)
    more = "" if all(sizes) else "more than "
    total = f"; {more}{human_bytes(known)} in all" if known else ""
    return f"{len(dataset.sequences)} sequences{total}: {', '.join(map(shown, dataset.sequences))}"


def _accept(yes: bool, console: Console) -> Accept:
    """Shows where a dataset comes from and its licence, and gets the answer."""

    def ask(dataset: Dataset) -> bool:
        console.print(dataset.title, markup=False, highlight=False)
        for line in _about(dataset):
            console.print(line, markup=False, highlight=False, soft_wrap=True)
        if yes:
            return True
        if not sys.stdin.isatty():
            raise ConfigError(
                f"{dataset.name}: expected an answer about its licence, got no terminal; --yes accepts it"
            )
        return console.input("Accept the licence? \\[y/N] ").strip().lower() in ("y", "yes")

    return ask
