"""``mastd3r view``: a run in the browser, by the viewer where it is installed, else by its report."""

from __future__ import annotations

import argparse
import time
import webbrowser

from rich.console import Console

from ..errors import ConfigError, InputError
from ..reading.files import is_file
from ..viewer.server import HOW_TO_GET, LOOPBACK, is_installed
from .options import path
from .screen import screen

LONG_S = 3600.0


def view_parser(p: argparse.ArgumentParser) -> None:
    """The words of ``view``."""
    p.add_argument("run", type=path, help="run folder")
    p.add_argument("--file", type=path, action="append", default=[], help="an exported cloud or mesh to show with it")
    p.add_argument("--host", default=LOOPBACK, help=f"address to serve on (default {LOOPBACK}: this machine alone)")
    p.add_argument("--port", type=_port, help="port to serve on (default: a free one from 8080 on)")
    p.add_argument("--no-browser", action="store_true", help="say the address, open nothing")
    p.add_argument("--report", action="store_true", help="open report.html instead")
    p.set_defaults(act=view)


def view(args: argparse.Namespace, console: Console) -> int:
    """``mastd3r view``."""
    if args.report or not is_installed():
        _open_report(args)
        return 0
    from ..viewer.show_run import show_run

    with show_run(args.run, args.host, args.port, args.file) as viewer:
        for line in viewer.notices:
            console.print(line, soft_wrap=True, markup=False)
        told_at(viewer.address, args, console)
        while True:
            time.sleep(LONG_S)


def told_at(address: str, args: argparse.Namespace, console: Console) -> None:
    """Say where a viewer is served, and open it where a browser is and may be."""
    screen().print(f"{address}  (Ctrl-C ends it)", soft_wrap=True, markup=False, highlight=False)
    if not args.no_browser and not _browse(address):
        console.print("no browser found: open that address in one", markup=False)


def _open_report(args: argparse.Namespace) -> None:
    from ..export.read_run import read_run

    report = read_run(args.run).path / "report.html"
    if not is_file(report):
        raise InputError(f"{report}: expected the report of a complete run, got none")
    console = screen()
    if not args.report:
        console.print(f"the viewer is not installed ({HOW_TO_GET}): the report instead", markup=False, soft_wrap=True)
    console.print(f"report: {report}", soft_wrap=True, markup=False)
    if not args.no_browser and not _browse(report.resolve().as_uri()):
        console.print("no browser found: open that file in one", markup=False)


def _browse(address: str) -> bool:
    """Open an address in a browser with windows; False where there is none."""
    try:
        browser = webbrowser.get()
        if type(browser) is webbrowser.GenericBrowser:  # one for terminals, which would take this one
            return False
        return browser.open(address)
    except webbrowser.Error:
        return False


def _port(word: str) -> int:
    if not word.isdecimal() or not 0 < int(word) < 65536:
        raise ConfigError(f"--port: expected a number from 1 to 65535, got {word!r}")
    return int(word)
