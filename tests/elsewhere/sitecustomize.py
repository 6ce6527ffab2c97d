"""Another system than Linux, as far as it can be acted: what the words of MASTD3R_WITHOUT name is not there.

Python loads this file by itself where its folder is on PYTHONPATH, so tests and every process that they start see the
same: ``MASTD3R_WITHOUT=affinity,proc PYTHONPATH=tests/elsewhere pytest``. What other packages need of their own system
stays: modules are hidden from ours alone.
"""

from __future__ import annotations

import builtins
import io
import os
import signal
import sys
from collections.abc import Callable
from typing import Any

LSTAT = os.lstat


def _hidden(*modules: str) -> None:
    """Importing them fails, in files of this package."""
    imported = builtins.__import__

    def without(name: str, given: Any = None, *rest: Any, **more: Any) -> Any:
        if name in modules and str((given or {}).get("__name__", "")).startswith("mastd3r"):
            raise ImportError(f"no module {name} on this system")
        return imported(name, given, *rest, **more)

    builtins.__import__ = without


def _gone(owner: Any, *names: str) -> None:
    for name in names:
        if hasattr(owner, name):
            delattr(owner, name)


def _no_proc() -> None:
    """Files of /proc are not there, for files of this package."""

    def hook(event: str, words: tuple[Any, ...]) -> None:
        if event == "open" and isinstance(words[0], str) and words[0].startswith("/proc/") and _we_ask():
            raise FileNotFoundError(2, "No such file or directory", words[0])

    sys.addaudithook(hook)


def _we_ask() -> bool:
    """Whether it is this package that opens a file, by pathlib or itself."""
    frame = sys._getframe(1)
    while frame is not None and frame.f_globals.get("__name__") in (__name__, "pathlib", "pathlib._local", "io"):
        frame = frame.f_back
    return frame is not None and str(frame.f_globals.get("__name__")).startswith("mastd3r")


def _folded(path: Any) -> Any:
    """The path of what is there under a name that differs in nothing but its case, else the path itself."""
    if not isinstance(path, str | os.PathLike):
        return path
    text = os.fspath(path)
    if not isinstance(text, str):
        return path
    try:
        LSTAT(text)
        return path
    except (OSError, ValueError):
        pass
    folder, name = os.path.split(text)
    try:
        same = [n for n in os.listdir(folder or ".") if n.casefold() == name.casefold()]
    except OSError:
        return path
    return os.path.join(folder, same[0]) if same else path


def _caseless() -> None:
    """``A.png`` is ``a.png``: in opening, asking, renaming and removing."""
    for name in ("stat", "lstat", "open", "unlink", "remove", "rename", "replace", "mkdir", "rmdir"):
        setattr(os, name, _with_folded(getattr(os, name)))
    builtins.open = io.open = _with_folded(builtins.open)


def _with_folded(act: Callable[..., Any]) -> Callable[..., Any]:
    def folded(*paths: Any, **more: Any) -> Any:
        both = act.__name__ in ("rename", "replace")
        return act(*[_folded(p) if n == 0 or (both and n == 1) else p for n, p in enumerate(paths)], **more)

    folded.__name__ = act.__name__
    return folded


WITHOUT: dict[str, Callable[[], None]] = {
    "affinity": lambda: _gone(os, "sched_getaffinity", "sched_setaffinity"),
    "proc": _no_proc,
    "locks": lambda: _hidden("fcntl"),
    "usage": lambda: _gone(os, "wait4", "wait3", "sysconf", "nice"),
    "signals": lambda: _gone(signal, "SIGHUP", "SIGUSR1", "SIGUSR2", "SIGQUIT"),
    "fork": lambda: _gone(os, "fork", "forkpty", "killpg", "setsid"),
    "case": _caseless,
}
for _word in filter(None, os.environ.get("MASTD3R_WITHOUT", "").split(",")):
    WITHOUT[_word]()
