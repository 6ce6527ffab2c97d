"""The command line. The only place that prints and that decides exit codes."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

EXIT_BAD_INPUT, EXIT_INTERRUPTED = 2, 130
KEPT = "what was computed so far is in the run folder"
KEPT_BY = dict.fromkeys(("download", "weights"), "what has arrived is kept, the same command goes on from there")
KEPT_BY["export"] = "nothing half-written stays"


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; 0 = done, 2 = something that the user can mend (one line says what), 130 = Ctrl-C."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # waiting threads must not eat the cores
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the solvers' matrices are small: threads only wait
    from ..errors import SlamError
    from .dispatch import dispatch

    words = list(sys.argv[1:] if argv is None else argv)
    try:
        return dispatch(words)
    except SlamError as e:
        print(f"mastd3r: {e}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        command = next((w for w in words if not w.startswith("-")), "")
        print(f"mastd3r: stopped; {KEPT_BY.get(command, KEPT)}", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        return 0


if __name__ == "__main__":
    sys.exit(main())
