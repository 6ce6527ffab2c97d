"""Words in, one command run, its exit code out."""

from __future__ import annotations

import argparse
import logging

from rich.logging import RichHandler

from .parser import parser
from .screen import screen


def dispatch(words: list[str]) -> int:
    """Parse and run one command; returns the exit code."""
    args = parser().parse_args(words)
    console = screen(stderr=True)
    shown = _log_level(args)
    terminal = RichHandler(shown, console=console, show_path=False, show_time=False)
    logging.basicConfig(level=shown, format="%(message)s", handlers=[terminal], force=True)
    logging.captureWarnings(True)
    logging.getLogger("py.warnings").setLevel(logging.WARNING if args.verbose else logging.CRITICAL)  # for developers
    logging.getLogger("mastd3r").setLevel(logging.INFO)  # for run.log; the terminal's own level stays
    args.words = ["mastd3r", *words]
    code: int = args.act(args, console)
    return code


def _log_level(args: argparse.Namespace) -> int:
    """--quiet leaves stderr to the one line that says why a run failed; run.json has the warnings."""
    if args.verbose:
        return logging.INFO
    return logging.CRITICAL if getattr(args, "quiet", False) else logging.WARNING
