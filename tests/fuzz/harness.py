"""Running one command in a process forked from a warm interpreter, under limits; and judging what it did."""

from __future__ import annotations

import hashlib
import json
import os
import random
import resource
import shutil
import signal
import stat
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fuzz.case import KINDS, Case, Room
from fuzz.material import Shared

LONGEST_S = 10.0  # a command may work so long
BLOCKED_S, KILLED_S = 40.0, 600.0  # one that does nothing for so long hangs, whatever else the machine does
MOST_BYTES = 3 * 2**29  # 1.5 GiB
ROOM_BYTES = 5 * 2**29  # of address space beside what the interpreter has mapped already
HASHED_BYTES = 2**22  # of a file; larger ones are sparse
LICENCES, MORE_SAID = ("download", "weights"), ("batch", "view")  # commands that say more on the way
FAULTS = ("traceback", "hang", "running", "lines", "control", "memory", "changed", "code")


@dataclass
class Outcome:
    """What a command did, and what of it is a fault."""

    kind: str
    seed: int
    words: list[str]
    code: int | None = None  # None: killed
    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_mib: float = 0.0
    out: str = ""
    err: str = ""
    log: str = ""  # the traceback that the one line names
    faults: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        head = f"{self.kind} seed {self.seed}: {', '.join(self.faults)} (exit {self.code}, {self.wall_s:.1f} s)"
        return f"{head}\n  {' '.join(map(repr, self.words))[:600]}\n  stderr: {self.err[-900:]!r}\n{self.log[-1500:]}"


def run_case(name: str, seed: int, root: Path, shared: Shared, keep: bool = False) -> Outcome:
    """Make the case of a seed, run it in a child, judge it; its folder is removed unless ``keep``."""
    room = Room(root / f"{name}-{seed}")
    room.make()
    case = KINDS[name][0](random.Random(f"{name} {seed}"), room, shared)
    outcome = Outcome(name, seed, [os.fspath(w) for w in case.words])
    before, running = dict(_fingerprints(room.given)), _running(room)
    _run(case, room, outcome)
    _judge(outcome, before, dict(_fingerprints(room.given)), _running(room) - running)
    if not keep:
        shutil.rmtree(room.path, ignore_errors=True)
    return outcome


def _run(case: Case, room: Room, outcome: Outcome) -> None:
    began = time.monotonic()
    pid = os.fork()
    if not pid:
        _child(case, room)
    try:
        status, usage = _waited_for(pid, began)
    finally:
        with suppress(ProcessLookupError):  # whatever it started, and itself where this is interrupted
            os.killpg(pid, signal.SIGKILL)
    outcome.wall_s = time.monotonic() - began
    outcome.cpu_s = usage.ru_utime + usage.ru_stime
    outcome.peak_mib = usage.ru_maxrss / 1024
    outcome.code = None if status is None else os.waitstatus_to_exitcode(status)
    outcome.out, outcome.err = _text(room.path / "stdout"), _text(room.path / "stderr")
    outcome.log = "".join(_text(p) for p in sorted((room.path / "tmp").glob("mastd3r-*.log")))


def _waited_for(pid: int, began: float) -> tuple[int | None, Any]:
    """(status, usage) of a child that has ended; status None where it had to be killed."""
    worked_s, last = 0.0, began
    while True:
        done, ended, usage = os.wait4(pid, os.WNOHANG)
        now = time.monotonic()
        if done:
            return ended, usage
        if (worked := _worked_s(pid)) > worked_s:
            worked_s, last = worked, now
        elif now - last > BLOCKED_S or now - began > KILLED_S:
            os.killpg(pid, signal.SIGKILL)
            return None, os.wait4(pid, 0)[2]
        time.sleep(0.004)


def _worked_s(pid: int) -> float:
    """CPU seconds of a process so far."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _text(path: Path) -> str:
    data = path.read_bytes()[:200_000] if path.is_file() else b""
    return data.decode("utf-8", "replace")


def _child(case: Case, room: Room) -> None:
    """Never returns."""
    code = 99
    try:
        os.setsid()
        mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (mapped + ROOM_BYTES,) * 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (int(3 * LONGEST_S),) * 2)
        os.chdir(room.path / "cwd")
        home = str(room.path / "home")
        os.environ |= {"TMPDIR": str(room.path / "tmp"), "MASTD3R_HOME": home, "COLUMNS": "4000", "no_proxy": "*"}
        os.environ |= case.env
        tempfile.tempdir = None  # it is remembered
        for number, name in enumerate(("/dev/null", room.path / "stdout", room.path / "stderr")):
            flags = os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_CREAT
            os.dup2(os.open(name, flags, 0o644), number)
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115  as the interpreter does
        sys.stderr = open(2, "w", encoding="utf-8", errors="backslashreplace", buffering=1, closefd=False)  # noqa: SIM115
        if case.prepare is not None:
            case.prepare()
        from mastd3r.cli.main import main

        try:
            code = main([os.fspath(w) for w in case.words])
        except SystemExit as e:
            code = e.code if isinstance(e.code, int) else 98
        sys.stdout.flush()
    except BaseException:
        traceback.print_exc()
        raise
    finally:
        os._exit(code)


def _fingerprints(folder: Path) -> Iterator[tuple[str, Any]]:
    """(path, what it is and holds) of all below ``folder``; nothing is opened that could block."""
    for at, folders, files in os.walk(os.fsencode(folder)):
        for name in sorted(folders + files):
            path = os.path.join(at, name)
            info = os.lstat(path)
            digest: Any = None
            if stat.S_ISREG(info.st_mode) and info.st_size < HASHED_BYTES:
                with open(path, "rb") as file:
                    digest = hashlib.sha256(file.read()).hexdigest()
            elif stat.S_ISLNK(info.st_mode):
                digest = os.readlink(path)
            yield os.fsdecode(path), (stat.S_IFMT(info.st_mode), info.st_size * (digest is not None), digest)


def _judge(outcome: Outcome, before: dict[str, Any], after: dict[str, Any], running: set[Path]) -> None:
    lines = outcome.err.splitlines()
    ours = [line for line in lines if line.startswith("mastd3r: ")]
    rest = [line for line in lines if not line.startswith(("mastd3r: ", "WARNING", "ERROR"))]
    command = (outcome.words or [""])[0]
    if command in LICENCES or (command in MORE_SAID and "--quiet" not in outcome.words):
        rest = []
    refused = outcome.code in (2, 130)
    shown = [c for c in outcome.out + outcome.err if not (c.isprintable() or c == "\n")]
    found = {
        "traceback": outcome.code in (1, 99) or "Traceback (most recent call last)" in outcome.err + outcome.out,
        "hang": outcome.code is None or outcome.code == -signal.SIGXCPU or outcome.cpu_s > LONGEST_S,
        "running": bool(running),
        "lines": bool(refused and (len(ours) != 1 or lines[-1:] != ours or rest)),
        "control": bool(shown),
        "memory": outcome.peak_mib * 2**20 > MOST_BYTES or "out of memory" in outcome.err,
        "changed": after != before,
        "code": outcome.code not in (None, 0, 1, 2, 99, 130, -signal.SIGXCPU),
    }
    outcome.faults = [name for name in FAULTS if found[name]]


def _running(room: Room) -> set[Path]:
    return {p for p in room.path.rglob("run.json") if p.is_file() and _is_running(p)}


def _is_running(path: Path) -> bool:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(record, dict) and record.get("status") == "running"
