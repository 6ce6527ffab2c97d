"""The command line. The only place that prints and that decides exit codes."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from .screen import plain

MOST_SHOWN = 2000  # characters of the one line
EXIT_FAULT, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 1, 2, 130
KEPT = "what was computed so far is in the run folder"
KEPT_BY = dict.fromkeys(("download", "weights"), "what has arrived is kept, the same command goes on from there")
KEPT_BY |= dict.fromkeys(("export", "save", "localise"), "nothing half-written stays")
KEPT_BY["batch"] = "runs that are complete stay, the same command goes on with the others"
KEPT_BY["view"] = "the run is as it was"


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; 0 = done, 2 = something that the user can mend (one line says what), 130 = told to stop.

    1 = a fault of ours: one line, and the file that has its traceback.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # waiting threads must not eat the cores
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the solvers' matrices are small: threads only wait
    from ..errors import SlamError, reason_of
    from .dispatch import dispatch
    from .signals import stopping_signals

    words = list(sys.argv[1:] if argv is None else argv)
    _open_what_is_closed()
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # names of files may be what its encoding does not have
            stream.reconfigure(errors="backslashreplace")
    try:
        with stopping_signals():
            code = dispatch(words)
            if sys.stdout is not None:
                sys.stdout.flush()  # not when the interpreter ends, who would complain in words of its own
            return code
    except (SlamError, MemoryError) as e:
        say(reason_of(e), e)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt as e:
        command = next((w for w in words if not w.startswith("-")), "")
        say(f"stopped; {KEPT_BY.get(command, KEPT)}", e)
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0
    except Exception as e:  # noqa: BLE001  the boundary that nothing passes
        say(reason_of(e), e if hasattr(e, "__notes__") else _kept(e))
        return EXIT_FAULT


def _open_what_is_closed() -> None:
    """Without this a file of the run would become standard output, and take what libraries print."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free


def say(line: str, error: BaseException | None = None) -> None:
    """The one line of a command that has not done its work, with what is known about ``error``."""
    text = plain("; ".join([f"mastd3r: {line}", *getattr(error, "__notes__", ())]), keep="")
    if sys.stderr is not None:  # it may be closed
        with suppress(OSError, ValueError):
            print(text if len(text) <= MOST_SHOWN else f"{text[:MOST_SHOWN]}…", file=sys.stderr)


def _kept(error: Exception) -> Exception:
    """The same, with its traceback in a file that a note names: outside a run there is no run.log."""
    import tempfile
    import traceback

    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="mastd3r-", suffix=".log", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as file:
            file.write("".join(traceback.format_exception(error)))
        error.add_note(f"{file.name} holds the traceback: please report it with that file")
    except OSError as e:  # nothing can be written anywhere
        where = traceback.extract_tb(error.__traceback__)[-1]
        error.add_note(
            f"at {Path(where.filename).name}:{where.lineno}; no file could be written for its traceback ({e})"
        )
    return error


if __name__ == "__main__":
    sys.exit(main())
