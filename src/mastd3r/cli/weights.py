"""What ``mastd3r weights`` does: list, download, check, path."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from ..errors import ConfigError, InputError
from ..reading.files import is_dir
from .screen import plain, screen

if TYPE_CHECKING:
    from ..download.weights_download import Accept
    from ..download.weights_known import Licence

STATE_SHOWN = {"installed": "[green]installed[/green]", "incomplete": "[yellow]incomplete[/yellow]", "absent": "–"}


def weights_parser(p: argparse.ArgumentParser) -> None:
    """Fill in the parser of ``weights`` with its four actions."""
    actions = p.add_subparsers(dest="action", required=True, metavar="ACTION")
    show = actions.add_parser("list", help="the weights that are known, and which of them are on this machine")
    show.set_defaults(act=_list)
    get = actions.add_parser("download", help="fetch weights once; an interrupted download goes on where it was")
    get.add_argument("what", help="a name of the list, a hub id OWNER/NAME, a URL, or a file or folder of this machine")
    get.add_argument("--as", dest="as_name", metavar="NAME", help="keep them under this name")
    get.add_argument("--yes", action="store_true", help="accept the licence without being asked")
    get.add_argument("--quiet", action="store_true", help="no progress bars")
    get.set_defaults(act=_download)
    check = actions.add_parser("check", help="compare checksums with the released ones, or those of the first download")
    check.add_argument("what", nargs="?", help="a name, hub id, file or folder; default: all that are installed")
    check.set_defaults(act=_check)
    where = actions.add_parser("path", help="print where weights lie, for scripts")
    where.add_argument("what", help="a name or hub id")
    where.set_defaults(act=_path)


def _list(args: argparse.Namespace, console: Console) -> int:
    from ..download.fetch import human_bytes
    from ..download.weights import entries, home

    table = Table("name", "here", "size", "licence", "what it is")
    table.columns[0].no_wrap = True  # it is what the other actions are given
    for entry in entries():
        size = human_bytes(entry.size_bytes) if entry.size_bytes else "–"
        table.add_row(entry.name, STATE_SHOWN[entry.state], size, entry.licence, entry.what)
    out = screen()
    out.print(table)
    out.print(
        f"They lie in {home() / 'weights'}; MASTD3R_HOME moves them.", highlight=False, soft_wrap=True, markup=False
    )
    return 0


def _download(args: argparse.Namespace, console: Console) -> int:
    from ..download.weights_download import download
    from ..download.weights_known import KNOWN
    from ..progress import FileBars, Silent
    from .terminal import Terminal

    with FileBars(Silent() if args.quiet else Terminal(console)) as bars:
        got = download(args.what, _accept(args.yes, console), as_name=args.as_name, watch=bars.watch)
    if (got if is_dir(got) else got.parent).name not in KNOWN:
        console.print("The licence of these weights is not known here: see the page that they come from.")
    screen().print(f"ready: {got}", highlight=False, soft_wrap=True, markup=False)
    return 0


def _accept(yes: bool, console: Console) -> Accept:
    """Shows a licence and gets the answer."""

    def ask(licence: Licence) -> bool:
        console.print(licence.text, markup=False, highlight=False)
        if yes:
            return True
        if not sys.stdin.isatty():
            raise ConfigError(f"licence {licence.title}: expected an answer, got no terminal; --yes accepts it")
        return console.input("Accept? \\[y/N] ").strip().lower() in ("y", "yes")

    return ask


def _check(args: argparse.Namespace, console: Console) -> int:
    from ..download.fetch import human_bytes
    from ..download.weights import check, entries

    names = [args.what] if args.what else [e.name for e in entries() if e.state == "installed"]
    if not names:
        screen().print("no weights are installed; mastd3r weights list shows what there is")
        return 0
    table = Table("file", "size", "sha256", "")
    wrong = []
    for name in names:
        for file in check(name):
            verdict = (
                "right" if file.expected else "recorded, nothing to compare with" if file.recorded else "not known"
            )
            if not file.right:
                verdict = f"[red]wrong[/red], expected {file.expected}"
                wrong.append(file.path)
            table.add_row(str(file.path), human_bytes(file.size_bytes), file.sha256[:12], verdict)
    screen().print(table)
    if wrong:
        text = f"{wrong[0]}: expected the checksum of its release or first download, got another"
        raise InputError(f"{text}; remove it and download it again")
    return 0


def _path(args: argparse.Namespace, console: Console) -> int:
    from ..download.weights import path

    found = str(path(args.what))
    if not found.isprintable():  # a script needs it as it is, a terminal must not get it so
        raise InputError(f"weights path: expected a path of printable characters, got {plain(found)}")
    print(found)
    return 0
