"""report.html of what a run folder holds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from ..evaluation.evaluate import Evaluation
from ..export.evidence import EvidenceSample
from ..export.files import plain
from ..export.read_run import read_run
from ..export.report import write_report
from ..export.report_data import gather_report_data
from ..types import Source


def write_run_report(
    path: Path,
    source: Source,
    evaluation: Evaluation,
    evidence: EvidenceSample | None = None,
    record: dict[str, Any] | None = None,
) -> None:
    """Write the report of the run folder ``path``; ``evidence`` of one frame is shown where it is given.

    ``record`` stands for run.json of a run that is about to end. Raises InputError for files of the
    run that cannot be read, OutputError.
    """
    run, ate = read_run(path), evaluation.ate
    run = run if record is None else replace(run, record=plain(record))
    known = ate if ate is not None and ate.rmse is not None else None
    data = gather_report_data(
        run,
        source.frames(),
        {h.timestamp_s: h.psnr_db for h in evaluation.holdout},
        known.truth_in_map(len(run.trajectory.timestamps_s)) if known else None,
        known.scale if known else None,
        title=source.name,
        evidence=evidence,
    )
    write_report(path, data)
