"""The section of docs/results.md on bad inputs, of the JSON that ``make fuzz`` writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

# name in the JSON -> heading
FAULTS = {
    "traceback": "tracebacks",
    "hang": "hangs",
    "running": "left `running`",
    "lines": "many-lined",
    "control": "control characters",
    "memory": "over 1.5 GiB",
    "changed": "changed inputs",
    "code": "other exit codes",
}


def fuzz(path: Path) -> list[str]:
    """Lines of Markdown; none where nothing was tried."""
    if not path.is_file():
        return []
    found: dict[str, Any] = json.loads(path.read_text())
    made = found["made"]
    codes = ", ".join(f"{code}: {count}" for code, count in found["exit codes"].items())
    out = ["", "## Bad inputs", ""]
    out.append(
        f"By `make fuzz SEED={made['seed']}`, kept as `{path.as_posix()}` (commit {made['commit']}, {made['date']}, "
        f"{made['processor']}): {found['cases']} malformed or hostile inputs of {len(found['kinds'])} kinds "
        "(tests/fuzz/), each by one command in a process of its own under limits of time and memory. Exit codes "
        f"{codes}. Most processor time {found['longest_cpu_s']} s, longest {found['longest_s']} s beside other work, "
        f"most memory {found['peak_mib']} MiB."
    )
    out += ["", f"| kind | inputs | {' | '.join(FAULTS.values())} |", "|---" * (2 + len(FAULTS)) + "|"]
    rows = {**found["kinds"], "all": {"cases": found["cases"], **found["faults"]}}
    for kind, row in rows.items():
        out.append(f"| {kind} | {row['cases']} | {' | '.join(str(row[f]) for f in FAULTS)} |")
    return out
