"""What a run ran on: so that a figure can be told apart from another machine's."""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

from .. import __version__

PACKAGES = ("numpy", "scipy", "numba", "opencv-python-headless", "torch", "av", "pillow", "gsplat")


def machine_info() -> dict[str, Any]:
    """Platform, cores, memory, versions and git commit; what cannot be known is None."""
    return {
        "platform": platform.platform(),
        "processor": _processor(),
        "cores": usable_cores(),
        "memory_mib": total_memory_mib(),
        "python": platform.python_version(),
        "mastd3r": __version__,
        "packages": {name: _version(name) for name in PACKAGES},
        "git_commit": git_commit(Path(__file__).parent),
    }


def program() -> str:
    """Version and commit: what another one has written down may mean something else."""
    return f"{__version__} {git_commit(Path(__file__).parent) or ''}".strip()


def usable_cores() -> int:
    """Cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def total_memory_mib() -> int | None:
    """Memory of the machine."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**20
    except (AttributeError, ValueError, OSError):
        return None


def git_commit(folder: Path) -> str | None:
    """The commit checked out in ``folder``, with ``-dirty`` where files differ.

    None where git does not track this very file: an installed copy may lie inside someone else's checkout.
    """
    try:
        _git(folder, "ls-files", "--error-unmatch", Path(__file__).name)
        return _git(folder, "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*") or None
    except (OSError, subprocess.SubprocessError):
        return None


def _git(folder: Path, *words: str) -> str:
    done = subprocess.run(
        ["git", *words], cwd=folder, capture_output=True, text=True, errors="replace", timeout=10, check=True
    )
    return done.stdout.strip()


def peak_rss_mib() -> float:
    """The most memory that this process has held so far, in MiB."""
    if sys.platform == "win32":
        return _peak_rss_windows_mib()
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def _peak_rss_windows_mib() -> float:
    class Counters(ctypes.Structure):
        _fields_ = (
            ("cb", ctypes.c_ulong),
            ("page_faults", ctypes.c_ulong),
            *((name, ctypes.c_size_t) for name in ("peak_working_set", "working_set", "a", "b", "c", "d", "e", "f")),
        )

    counters = Counters()
    counters.cb = ctypes.sizeof(Counters)
    windows: Any = ctypes.__dict__["windll"]
    current = windows.kernel32.GetCurrentProcess
    current.restype = ctypes.c_void_p
    query = windows.psapi.GetProcessMemoryInfo
    query.argtypes = [ctypes.c_void_p, ctypes.POINTER(Counters), ctypes.c_ulong]
    if not query(current(), ctypes.byref(counters), counters.cb):
        return 0.0
    return float(counters.peak_working_set) / 2**20


def _processor() -> str | None:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or None


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
