"""report.html of what a run folder holds."""

from __future__ import annotations

from pathlib import Path

from ..evaluation.evaluate import Evaluation
from ..export.evidence import EvidenceSample
from ..export.read_run import read_run
from ..export.report import write_report
from ..export.report_data import gather_report_data
from ..types import Source


def write_run_report(
    path: Path, source: Source, evaluation: Evaluation, evidence: EvidenceSample | None = None
) -> None:
    """Write the report of the run folder ``path``; ``evidence`` of one frame is shown where it is given.

    Raises InputError for files of the run that cannot be read, OutputError.
    """
    run, ate = read_run(path), evaluation.ate
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
