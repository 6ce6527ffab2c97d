"""Tasks on a Ray cluster: each a command on a node that has the cores, the memory and the accelerator it asks for.

Nodes share the folder that runs are written in, and find sources under the same paths; what comes back through Ray is
how a command ended, no more. Attempts are counted by ``runner.py``, so Ray is asked not to try again by itself.
"""

from __future__ import annotations

import logging
import os
import re
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from .. import __version__
from ..errors import ConfigError, InputError, MissingPackage, SlamError
from ..export.files import write_text
from ..export.machine import usable_cores
from ..export.run_log import is_held
from ..reading.files import short
from .process import END_S, POLL_S, Child, Ended
from .runner import Task

log = logging.getLogger(__name__)
HOW_TO_GET = "pip install 'mastd3r-slam[cluster]'"
CORES, GPUS = 2, 1.0  # of a task, where nothing is said, as far as a node has them
CONNECT_S, ANSWER_S = 5.0, 10.0  # for a port to open, for a cluster to answer: one that does has done so in three
LOOK_EVERY_S = 2.0  # at what nodes there are
QUEUED = 4  # tasks that wait at Ray for a node, at most: the next may be known to need less memory
HELD_S = 30.0  # for the run of a lost node to let go of its folder
MARK = ".shared"  # a file that tells the shared folder from another of that name
PROBE = "import sys, ray; ray.init(address=sys.argv[1], log_to_driver=False, logging_level='CRITICAL')"


def ray_module() -> Any:
    """The package. Raises MissingPackage."""
    try:
        import ray
    except ImportError as e:
        raise MissingPackage(f"--ray: expected the package ray, got none: {HOW_TO_GET}") from e
    return ray


@dataclass(frozen=True)
class Asked:
    """What a task asks of a node."""

    cores: int | None = None  # None: ``CORES``, or what the largest node has
    gpus: float | None = None  # None: ``GPUS`` where a node has one, else 0

    def __post_init__(self) -> None:
        if self.cores is not None and self.cores < 1:
            raise ConfigError(f"--task-cores: expected 1 or more, got {self.cores}")
        if self.gpus is not None and not 0 <= self.gpus <= 64:
            raise ConfigError(f"--task-gpus: expected 0 or more, got {self.gpus:g}")


@dataclass
class _Given:
    task: Task
    attempt: int
    began_s: float
    node: str = ""


class Cluster:
    """A place for tasks (``runner.Place``)."""

    def __init__(self, address: str, shared: Path, asked: Asked, jobs: int | None = None) -> None:
        """``address``: auto, HOST:PORT, or local for a cluster of this machine alone; ``shared``: all nodes see it.

        Raises MissingPackage, ConfigError for other addresses, InputError for a cluster that does not answer or has no
        node that is large enough, OutputError.
        """
        self._ray = ray_module()
        self._mark = secrets.token_hex(8)
        self._shared = Path(os.path.abspath(shared))
        write_text(self._shared / MARK, self._mark)
        _connect(self._ray, address)
        self.jobs = jobs or sys.maxsize
        self._given: dict[Any, _Given] = {}
        self._looked_s = time.monotonic()
        try:
            nodes = self._nodes()
            self.cores = asked.cores or min(CORES, max(int(n.get("CPU", 0)) for n in nodes) or 1)
            has_gpu = any(n.get("GPU", 0) > 0 for n in nodes)
            self.gpus = (GPUS if has_gpu else 0.0) if asked.gpus is None else asked.gpus
            if self._largest_mib(nodes) is None:
                raise InputError(f"--ray {address}: expected a node with {self._wanted()}, got {_said(nodes)}")
        except BaseException:
            self._ray.shutdown()
            raise
        count = f"{len(nodes)} node{'' if len(nodes) == 1 else 's'} of Ray"
        self.said = f"{count}: {_said(nodes)}; each task asks for {self._wanted()}"
        self._remote = self._ray.remote(_run_here)

    def has_room(self, need_mib: float) -> bool:
        """Ray keeps what has no node yet; ``QUEUED`` of those are enough."""
        queued = sum(not given.node for given in self._given.values())
        return queued < QUEUED and len(self._given) < self.jobs

    def give(self, task: Task, attempt: int, need_mib: float) -> None:
        """Hand it to Ray; a need that no node has is taken to be the largest node's memory."""
        largest = self._largest_mib(self._nodes())
        self._mark_of(task).unlink(missing_ok=True)
        argv = task.argv(attempt)
        words = argv[1:] if argv[0] == sys.executable else argv  # the node has a Python of its own
        asked = {
            "num_cpus": self.cores,
            "num_gpus": self.gpus,
            "memory": int(min(need_mib, largest or need_mib) * 2**20),
            "max_retries": 0,
            "scheduling_strategy": "SPREAD",
            "name": task.name,
        }
        where = {"log": str(task.log), "run": str(task.run), "begun": str(self._mark_of(task)), "attempt": attempt}
        shared = {"mark": self._mark, "shared": str(self._shared), "version": __version__}
        ref = self._remote.options(**asked).remote(words, where, shared)
        self._given[ref] = _Given(task, attempt, time.monotonic())

    def begun(self) -> Iterable[tuple[Task, str]]:
        """Those whose node has said so, in a file of the shared folder."""
        for given in list(self._given.values()):
            if not given.node and (node := _read(self._mark_of(given.task), given.attempt)):
                given.node, given.began_s = node, time.monotonic()
                yield given.task, node

    def ended(self) -> Iterable[tuple[Task, Ended]]:
        """Those that came back, or never will. Raises InputError where no node can serve what is left."""
        ready, _ = (
            self._ray.wait(list(self._given), num_returns=len(self._given), timeout=0) if self._given else ([], 0)
        )
        for ref in ready:
            given = self._given.pop(ref)
            yield given.task, self._came_back(ref, given)
        if time.monotonic() - self._looked_s > LOOK_EVERY_S and self._given:
            self._looked_s = time.monotonic()
            nodes = self._nodes()
            if self._largest_mib(nodes) is None:
                raise InputError(f"--ray: expected a node with {self._wanted()}, got {_said(nodes) or 'none'} left")

    def __enter__(self) -> Cluster:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """What still runs is stopped as by Ctrl-C, and waited for; then the cluster is left as it was."""
        left = list(self._given)
        for ref in left:
            self._ray.cancel(ref)
        if left:
            self._ray.wait(left, num_returns=len(left), timeout=END_S)
        for given in self._given.values():
            self._mark_of(given.task).unlink(missing_ok=True)
        self._ray.shutdown()
        (self._shared / MARK).unlink(missing_ok=True)

    def _came_back(self, ref: Any, given: _Given) -> Ended:
        """How it ended; where Ray has lost it, that."""
        mark = self._mark_of(given.task)
        wall_s = time.monotonic() - given.began_s
        errors = self._ray.exceptions
        try:
            told = self._ray.get(ref)
        except errors.RayTaskError as e:  # raised on the node, not by the command
            mark.unlink(missing_ok=True)
            if isinstance(e.cause, SlamError):
                raise InputError(str(e.cause)) from e
            return Ended(1, f"its node raised {_last_line(e)}", wall_s, node=given.node)
        except errors.RayError as e:
            mark.unlink(missing_ok=True)
            return Ended(None, f"its worker or node is lost ({type(e).__name__})", wall_s, node=given.node)
        mark.unlink(missing_ok=True)
        return Ended(**told)

    def _mark_of(self, task: Task) -> Path:
        return task.log.with_name(f"{task.name}.node")

    def _nodes(self) -> list[dict[str, float]]:
        """What the nodes that are alive have in all."""
        return [n["Resources"] for n in self._ray.nodes() if n["Alive"]]

    def _largest_mib(self, nodes: list[dict[str, float]]) -> float | None:
        """Memory of the largest node that has the cores and the accelerator; None where none has."""
        fit = [n for n in nodes if n.get("CPU", 0) >= self.cores and n.get("GPU", 0) >= self.gpus]
        return max((n.get("memory", 0.0) / 2**20 for n in fit), default=None)

    def _wanted(self) -> str:
        return _cores(self.cores) + (f" and {self.gpus:g} of an accelerator" if self.gpus else "")


# -- on the node -------------------------------------------------------------------------------------------------


def _run_here(words: list[str], where: dict[str, Any], shared: dict[str, str]) -> dict[str, Any]:
    """One task on the node that Ray has chosen; the command ends when this worker does."""
    import ray

    context = ray.get_runtime_context()
    node = f"{ray.util.get_node_ip_address()}/{context.get_node_id()[:6]}"
    if __version__ != shared["version"]:
        raise InputError(f"node {node}: expected mastd3r-slam {shared['version']}, got {__version__}")
    try:
        seen = (Path(shared["shared"]) / MARK).read_text()
    except OSError:
        seen = ""
    if seen != shared["mark"]:
        raise InputError(
            f"node {node}: expected to see {shared['shared']}, got no such folder, or another one; --out must be a "
            "folder that all nodes share"
        )
    write_text(Path(where["begun"]), f"{where['attempt']} {node}")
    end_s = time.monotonic() + HELD_S
    while is_held(Path(where["run"]) / "run.log") and time.monotonic() < end_s:
        time.sleep(POLL_S)
    child = Child([sys.executable, *words], Path(where["log"]))
    try:
        while (ended := child.ended()) is None:
            time.sleep(POLL_S)
    except BaseException:
        child.ask_to_stop()
        child.wait_or_kill(time.monotonic() + END_S)
        raise
    return {**asdict(ended), "node": node}


# -- the cluster -------------------------------------------------------------------------------------------------


def _connect(ray: Any, address: str) -> None:
    """Raises ConfigError and InputError."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # a cluster that is begun here tells nobody of it
    before = signal.getsignal(signal.SIGTERM)
    quiet = {"log_to_driver": False, "configure_logging": False, "include_dashboard": None}
    if address == "local":
        ray.init(num_cpus=usable_cores(), **{**quiet, "include_dashboard": False})
    else:
        _check_answers(address)
        try:
            ray.init(address=address, **quiet)
        except (ConnectionError, RuntimeError, ValueError) as e:
            raise InputError(f"--ray {address}: expected a cluster, got {short(_last_line(e), 200)}") from e
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)  # Ray would leave by a way of its own


def _check_answers(address: str) -> None:
    """Ask from another process, which can be given up: Ray itself waits for a minute."""
    expected = f"--ray {short(address)}: expected a Ray cluster"
    if address != "auto":
        found = re.fullmatch(r"\[?([\w.:-]+?)\]?:(\d{1,5})", address)
        if found is None or not 0 < int(found[2]) < 2**16:
            raise ConfigError(f"--ray: expected auto, local or HOST:PORT, got {short(repr(address))}")
        try:
            socket.create_connection((found[1], int(found[2])), CONNECT_S).close()
        except OSError as e:
            raise InputError(f"{expected}, got no answer ({e.strerror or e})") from e
    try:
        words = [sys.executable, "-c", PROBE, address]
        asked = subprocess.run(words, capture_output=True, text=True, errors="replace", timeout=ANSWER_S, check=False)
    except subprocess.TimeoutExpired as e:
        raise InputError(f"{expected}, got no answer within {ANSWER_S:.0f} s") from e
    if asked.returncode:
        lines = asked.stderr.strip().splitlines() or ["no answer"]
        raise InputError(f"{expected}, got: {short(lines[-1], 200)}")


def _said(nodes: list[dict[str, float]]) -> str:
    """The nodes' resources in words."""
    return ", ".join(
        f"{_cores(n.get('CPU', 0))} with {n.get('memory', 0.0) / 2**20:.0f} MiB"
        + (f" and {n['GPU']:g} accelerators" if n.get("GPU") else "")
        for n in nodes
    )


def _cores(count: float) -> str:
    return f"{count:g} core{'' if count == 1 else 's'}"


def _read(path: Path, attempt: int) -> str:
    """The node that has begun this attempt; empty where none has yet."""
    with suppress(OSError, ValueError):
        number, _, node = path.read_text().partition(" ")
        return node if int(number) == attempt else ""
    return ""


def _last_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[-1]
