"""Gathering what the report shows: one pass over the frames, a few pictures kept."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import Frame
from .evidence import EvidenceSample
from .read_run import Run
from .report import MaskSample, RenderSample, ReportData
from .report_files import run_files
from .run_folder import stamp

Array = NDArray[Any]
MASK_SAMPLES = 6


def gather_report_data(
    run: Run,
    frames: Iterable[Frame],
    psnr_db: Mapping[float, float],
    truth_in_map: Array | None = None,
    metres_per_unit: float | None = None,
    title: str = "",
    evidence: EvidenceSample | None = None,
) -> ReportData:
    """Choose the pictures and put the path into metres where truth, or else run.json, gives the scale.

    ``psnr_db`` holds timestamp_s -> PSNR of each holdout frame: the best, median and worst are shown.
    ``truth_in_map`` (n, 3) are the true positions in the map's frame and units, one a row of the trajectory,
    NaN where there is none; it needs ``metres_per_unit``. Raises InputError for unreadable files of the run.
    """
    labels = {stamp(t): label for t, label in pick_renders(psnr_db)}
    chosen_masks = {stamp(float(t)) for t in spread(run.mask_times_s(), MASK_SAMPLES)}
    renders: dict[str, RenderSample] = {}
    masks: list[MaskSample] = []
    for frame in frames:
        name = stamp(frame.timestamp_s)
        if name in chosen_masks:
            masks.append(MaskSample(frame.timestamp_s, frame.image, run.mask(frame.timestamp_s)))
        if name in labels:
            splat = run.render(frame.timestamp_s)
            size = (splat.shape[1], splat.shape[0])
            photograph = np.asarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA))
            decibels = next(v for t, v in psnr_db.items() if stamp(t) == name)
            renders[name] = RenderSample(labels[name], frame.timestamp_s, photograph, splat, decibels)
    has_truth = truth_in_map is not None and metres_per_unit is not None
    known = metres_per_unit if has_truth else run.metres_per_unit
    scale = 1.0 if known is None else known
    return ReportData(
        title=title or run.path.resolve().name,
        trajectory=run.trajectory,
        positions=run.trajectory.world_from_cam[:, :3, 3] * scale,
        truth=truth_in_map * scale if has_truth and truth_in_map is not None else None,
        unit="map units" if known is None else "m",
        renders=tuple(renders[name] for name in labels if name in renders),
        masks=tuple(masks),
        metrics=run.metrics,
        record=run.record,
        config=run.config,
        evidence=evidence,
        files=run_files(run.path),
    )


def pick_renders(psnr_db: Mapping[float, float]) -> list[tuple[float, str]]:
    """The best, the median and the worst of the holdout frames; fewer where there are fewer."""
    order = sorted(psnr_db, key=lambda t: (-psnr_db[t], t))
    if not order:
        return []
    if len(order) < 3:
        return list(zip(order, ("best", "worst"), strict=False))
    return [(order[0], "best"), (order[len(order) // 2], "median"), (order[-1], "worst")]


def spread(times_s: Array, count: int) -> Array:
    """Up to ``count`` of the times, evenly spaced by rank, ends kept a little away from."""
    if len(times_s) <= count:
        return times_s
    return np.asarray(times_s[((np.arange(count) + 0.5) / count * len(times_s)).astype(int)])
