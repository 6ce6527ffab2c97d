"""Where a command is run: no terminal, a closed one, a small one, no home folder, another system."""

from __future__ import annotations

import builtins
import io
import os
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

import mastd3r
from mastd3r.cli import terminal
from mastd3r.cli.main import main
from mastd3r.cli.parser import parser
from mastd3r.cli.screen import plain, screen
from mastd3r.download import weights
from mastd3r.export import machine, run_log

LIST = [sys.executable, "-m", "mastd3r", "weights", "list"]


def test_nobody_reads_any_more() -> None:
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(LIST, stdout=write, stderr=subprocess.PIPE, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.skipif(os.name == "nt", reason="a POSIX shell closes the streams")
@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&- <&-"])
def test_streams_that_are_closed(closed: str) -> None:
    done = subprocess.run(f'"{sys.executable}" -m mastd3r weights path nothing {closed}', shell=True, check=False)
    assert done.returncode == 2


@pytest.mark.skipif(os.name == "nt", reason="/proc/nowhere is no folder that can be made")
def test_doctor_in_a_small_dumb_terminal_without_a_home() -> None:
    env = {k: v for k, v in os.environ.items() if not k.startswith(("XDG", "MASTD3R", "LC_"))}
    env |= {"HOME": "/proc/nowhere", "TERM": "dumb", "COLUMNS": "20", "LANG": "C", "PYTHONUTF8": "0"}
    env["PYTHONIOENCODING"] = "ascii"
    done = subprocess.run([sys.executable, "-m", "mastd3r", "doctor"], env=env, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"") and b"numbers may be" in done.stdout.replace(b"\n", b" ")


def test_kernels_are_kept_in_a_folder_of_the_users_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    mastd3r._let_kernels_be_kept()
    assert "NUMBA_CACHE_DIR" not in os.environ  # beside the package
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("NUMBA_CACHE_DIR", "x")
    monkeypatch.delenv("NUMBA_CACHE_DIR")  # put back at the end
    mastd3r._let_kernels_be_kept()
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    assert folder.parent == tmp_path and stat.S_IMODE(folder.stat().st_mode) == 0o700
    folder.chmod(0o755)
    mastd3r._let_kernels_be_kept()
    del os.environ["NUMBA_CACHE_DIR"]
    mastd3r._let_kernels_be_kept()
    assert Path(os.environ["NUMBA_CACHE_DIR"]) != folder  # others could write there
    del os.environ["NUMBA_CACHE_DIR"]


def test_a_user_without_a_home(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MASTD3R_HOME")
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    assert weights.home().is_absolute()


def test_a_line_now_and_then_where_output_is_no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    with terminal.Terminal(Console(file=out)).stage("tracking", 40, "frames") as bar:
        bar.advance(3)
    assert out.getvalue() == ""
    monkeypatch.setattr(terminal, "LINE_EVERY_S", 0.0)
    with terminal.Terminal(Console(file=out)).stage("tracking", 40, "frames") as bar:
        bar.advance(3)
        bar.say("a word")
    first, second = out.getvalue().splitlines()
    assert first.startswith("tracking: 3 of 40 frames, ") and second == "tracking: a word"


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["rum", "x"], "perhaps you meant run"),
        (["run", "x", "--out", "y", "--quite"], "perhaps you meant --quiet"),
        (["export", "x", "--to", "colmpa", "--out", "y"], "perhaps you meant colmap"),
        (["weights", "dowload"], "perhaps you meant download"),
    ],
)
def test_near_misses_are_named(capfd: pytest.CaptureFixture[str], words: list[str], meant: str) -> None:
    assert main(words) == 2
    err = capfd.readouterr().err
    assert meant in err and len(err.splitlines()) == 1


def test_say_more_anywhere() -> None:
    for words in (["-v", "doctor"], ["doctor", "-v"], ["run", "x", "--out", "y", "--verbose"]):
        assert parser().parse_args(words).verbose
    assert not parser().parse_args(["doctor"]).verbose


def test_what_others_say_is_plain() -> None:
    assert plain("a\x1b[2Jb\x9b\u202e\ud800\n") == "a\\x1b[2Jb\\x9b\\u202e\\ud800\n"
    console = screen()
    console.file = out = io.StringIO()
    console.print("name: a\x1b[2Jb\x9b", markup=False)
    assert out.getvalue() == "name: a\\x1b[2Jb\\x9b\n"


def test_a_system_without_locks_affinity_and_proc(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    imported = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name in ("fcntl", "resource"):
            raise ImportError(name)
        return imported(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.delattr(os, "sysconf", raising=False)
    monkeypatch.setattr(Path, "read_text", lambda *a, **k: (_ for _ in ()).throw(FileNotFoundError(2, "no /proc")))
    info = machine.machine_info()
    assert info["cores"] >= 1 and info["memory_mib"] is None
    log = run_log.RunLog(tmp_path / "run.log")
    log.begin({"started": "now", "command": [], "machine": {}})
    log.open()
    assert not run_log.is_held(tmp_path / "run.log")  # nobody can tell
    log.close()
