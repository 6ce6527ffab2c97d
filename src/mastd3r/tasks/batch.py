"""Many sources, a run each: what LIST means, which folder each run gets, and batch.json, which says how all are."""

from __future__ import annotations

import os
import sys
import unicodedata
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from ..errors import InputError, OutputError
from ..export.claim import RECORD_FILE, claim_shelf
from ..export.files import write_json, writing
from ..reading.files import entries_of, is_file, resolved, user_path, whole_json, whole_text
from ..registry import LARGEST
from .runner import Change, Task

VIDEOS = (
    ".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v", ".mpg", ".mpeg", ".mts", ".m2ts", ".3gp", ".wmv", ".flv", ".ogv",
)  # fmt: skip
MOST_SOURCES = 10_000
MOST_LIST_BYTES = 2**22
RECORD, LOGS = "batch.json", "logs"
MADE_BY = "mastd3r batch"
MEMORY_MIB = 1500.0  # of a run, while none of this batch has ended
NETWORK_MIB = 6000.0  # the same with a network's pointmaps, of any run
MORE_THAN_SEEN = 1.1  # the next run may need a little more than those that have ended
MOST_NAME_BYTES = 100  # of a run's folder
TAKEN = {RECORD, LOGS}


# -- which sources -----------------------------------------------------------------------------------------------


def sources_of(arguments: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """Absolute paths of the sources that are meant, each once, and a line about each that was named twice.

    An argument is a list (a text file with a source a line; # begins a comment, relative paths are counted from the
    list's folder), a folder of videos, or a source itself. Whether a source can be read is found out by its run.
    Raises InputError for an argument that is not there, for a list without sources or of more than ``MOST_SOURCES``.
    """
    found: dict[Path, Path] = {}
    twice: list[str] = []
    for argument in arguments:
        for where, source in _meant_by(argument):
            known = found.setdefault(resolved(source), source)
            if known is not source:
                twice.append(f"{where}: {source} is named before: one run")
            if len(found) > MOST_SOURCES:
                raise InputError(f"{argument}: expected at most {MOST_SOURCES} sources, got more")
    return [Path(os.path.abspath(source)) for source in found.values()], twice


def _meant_by(argument: Path) -> list[tuple[str, Path]]:
    """(where it was said, source) of one argument."""
    if os.path.isdir(argument):
        inside = [p for p in entries_of(argument) if not p.name.startswith(".")]
        videos = [p for p in inside if p.suffix.lower() in VIDEOS and is_file(p)]
        return [(str(argument), p) for p in videos] or [(str(argument), argument)]
    if not os.path.lexists(argument):
        raise InputError(f"{argument}: expected a list of sources, a video or a folder, got no such path")
    if argument.suffix.lower() in VIDEOS or not is_file(argument):
        return [(str(argument), argument)]
    return _lines_of(argument)


def _lines_of(path: Path) -> list[tuple[str, Path]]:
    text = whole_text(path, "a list of sources, one a line", most=MOST_LIST_BYTES)
    found = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.strip()
        if words and not words.startswith("#"):
            where = f"{path}:{number}"
            found.append((where, path.parent / user_path(words, where)))
    if not found:
        raise InputError(f"{path}: expected a list of sources, one a line, got none")
    return found


def names_for(sources: Sequence[Path], known: dict[str, str]) -> dict[Path, str]:
    """A folder's name for the run of each source; one that has a name (``known``, by path) keeps it."""
    names = {s: known[str(s)] for s in sources if str(s) in known}
    used = {n.casefold() for n in (*TAKEN, *known.values())}
    for source in sources:
        if source not in names:
            plain, number = _plain(source), 1
            name = plain
            while name.casefold() in used:
                number += 1
                name = f"{plain}-{number}"
            names[source] = name
            used.add(name.casefold())
    return names


def _plain(source: Path) -> str:
    """A name that is a folder's on every system, made of a source's own."""
    return _safe(source.stem if source.suffix.lower() in VIDEOS else source.name) or "run"


def _safe(text: str) -> str:
    text = unicodedata.normalize("NFC", text.encode("utf-8", "replace").decode())
    kept = "".join(c if c.isalnum() or c in "-_." else "_" for c in text)
    return kept.encode()[:MOST_NAME_BYTES].decode("utf-8", "ignore").strip("._-")


def claim_batch(out: Path, sources: Sequence[Path]) -> None:
    """Make a folder ready for a batch. Raises OutputError, before anything is written, for one with other files."""
    claim_shelf(out, RECORD, "an earlier batch", sources)


# -- what is known of each ---------------------------------------------------------------------------------------


@dataclass
class SourceRun:
    """One source's run, as batch.json has it."""

    name: str
    source: str
    state: str = "waiting"  # running, again (was killed, waits), complete, failed
    exit_code: int | None = None
    reason: str | None = None
    attempts: int = 0
    wall_s: float = 0.0  # of all attempts
    processor_s: float = 0.0
    peak_rss_mib: float | None = None
    nodes: list[str] = field(default_factory=list)  # of a cluster, one an attempt


class Batch:
    """The folder of one batch: a run folder a source, batch.json, and what each run has said."""

    def __init__(
        self,
        out: Path,
        sources: Sequence[Path],
        options: Sequence[str],
        *,
        overwrite: bool = False,
        guess_mib: float = MEMORY_MIB,
        program: Sequence[str] = (sys.executable, "-m"),
    ) -> None:
        """``options``: words of ``mastd3r run``, the same for all; ``guess_mib``: what a run needs, while none of this
        batch has ended; ``program``: what makes words a process.

        A run that is complete under the same words is kept, unless ``overwrite``. ``out`` has been claimed, and nobody
        else is at work in it. Raises OutputError for a batch.json that is not ours.
        """
        self.out, self.options = Path(os.path.abspath(out)), list(options)
        self.overwrite, self.guess_mib, self._program = overwrite, guess_mib, list(program)
        before = _earlier(out / RECORD)
        names = names_for(sources, {run["source"]: run["name"] for run in before})
        self.runs = {names[s]: SourceRun(names[s], str(s)) for s in sources}
        self._others = [run for run in before if run["name"] not in self.runs]
        known = {run["name"]: run for run in before}
        for name, run in self.runs.items():
            if self._is_complete(run):
                self.runs[name] = replace(_read(known[name]) if name in known else run, state="complete", exit_code=0)
        self._seen_mib = [m for run in self.runs.values() if (m := run.peak_rss_mib) is not None]
        with writing(out):
            (out / LOGS).mkdir(exist_ok=True)
        self.save()

    def missing(self) -> list[Task]:
        """Those that are not complete, in the order of the sources."""
        return [self._task(run) for run in self.runs.values() if run.state != "complete"]

    def states(self) -> Counter[str]:
        """How many are in which state."""
        return Counter(run.state for run in self.runs.values())

    def needs(self, tasks: Collection[Task]) -> dict[str, float]:
        """MiB that runs need: a little more than the most that one of this batch has taken, else a guess."""
        need = MORE_THAN_SEEN * max(self._seen_mib) if self._seen_mib else self.guess_mib
        return {task.name: need for task in tasks}

    def note(self, change: Change) -> SourceRun:
        """Take what has become of a task, and write it down; gives its run. Raises OutputError."""
        run, ended = self.runs[change.task.name], change.ended
        if change.state == "started":
            run.state, run.attempts = "running", run.attempts + 1
            run.nodes += [change.node] if change.node else []
        if ended is not None:
            run.wall_s = round(run.wall_s + ended.wall_s, 2)
            run.processor_s = round(run.processor_s + (ended.processor_s or 0.0), 2)
            run.exit_code, run.peak_rss_mib = ended.exit_code, ended.peak_mib
            if ended.exit_code == 0:
                run.state, run.reason = "complete", None
                self._seen_mib += [] if ended.peak_mib is None else [ended.peak_mib]
            else:
                run.state = "again" if change.state == "again" else "failed"
                run.reason = ended.reason
        self.save()
        return run

    def stop(self) -> None:
        """Nothing runs any more: what was under way waits for the same command again."""
        for run in self.runs.values():
            if run.state in ("running", "again"):
                run.state = "waiting"
        self.save()

    def save(self) -> None:
        """batch.json. Raises OutputError."""
        runs = [*map(asdict, self.runs.values()), *self._others]
        write_json(self.out / RECORD, {"made_by": MADE_BY, "options": self.options, "runs": runs})

    def _task(self, run: SourceRun) -> Task:
        def argv(attempt: int) -> list[str]:
            renewed = ["--overwrite"] if self.overwrite and attempt == 1 else []
            return [*self._program, *self._words(run), *renewed]

        return Task(run.name, argv, self.out / LOGS / f"{run.name}.log", self.out / run.name)

    def _words(self, run: SourceRun) -> list[str]:
        return [
            "mastd3r",
            "run",
            run.source,
            "--out",
            str(self.out / run.name),
            *self.options,
            "--quiet",
            "--end-with-stdin",
        ]

    def _is_complete(self, run: SourceRun) -> bool:
        """Whether the folder holds what this very command leaves."""
        if self.overwrite:
            return False
        try:
            record = whole_json(self.out / run.name / RECORD_FILE)
        except InputError:
            return False
        command = [word for word in record.get("command") or [] if word != "--overwrite"]
        return record.get("status") == "complete" and command == self._words(run)


def _earlier(path: Path) -> list[dict[str, Any]]:
    """The runs of an earlier batch.json, as far as they are as we write them. Raises OutputError for another's."""
    if not os.path.lexists(path):
        return []
    try:
        record = whole_json(path)
    except InputError as e:
        raise OutputError(f"{e}; choose another folder with --out, or remove the file to begin anew") from e
    runs = record.get("runs")
    if record.get("made_by") != MADE_BY or not isinstance(runs, list):
        raise OutputError(f"{path}: expected that of an earlier batch, got another file; choose another folder")
    texts = ("name", "source", "state")
    whole = [run for run in runs if isinstance(run, dict) and all(isinstance(run.get(k), str) for k in texts)]
    return [run for run in whole if run["name"] == _safe(run["name"]) and run["name"] not in TAKEN]


def _read(run: dict[str, Any]) -> SourceRun:
    """What an earlier batch.json says of a run; numbers that are none are left out."""
    found = SourceRun(run["name"], run["source"], run["state"])
    for key in ("wall_s", "processor_s", "peak_rss_mib"):
        value = run.get(key)
        if isinstance(value, int | float) and 0 < value < LARGEST:
            setattr(found, key, float(value))
    for key in ("attempts", "exit_code"):
        value = run.get(key)
        if isinstance(value, int) and 0 <= value < LARGEST:
            setattr(found, key, value)
    found.nodes = [n for n in run.get("nodes") or [] if isinstance(n, str)]
    return found
