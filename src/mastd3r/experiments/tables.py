"""results.json to tables in the paper's form, with what others printed beside our figures."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..export.metric_names import NAMES
from .published import PublishedRow, published_table, sources
from .suite import Suite, TableSpec, suite_from_dict

NOTHING = "–"
HIGHER_IS_BETTER = ("psnr", "ssim", "fps", "cloud_mib", "mask_iou", "frames_posed")
LOWER_IS_BETTER = ("ate", "rpe", "peak", "mask_false")


@dataclass(frozen=True)
class Cell:
    """One cell: its text, and whether it is the best of our own in its column."""

    text: str
    best: bool = False


@dataclass
class Table:
    """A table and what has to be known to read it."""

    title: str
    head: list[str]
    rows: list[list[Cell]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


class Figures:
    """The records of a results.json, by variant and sequence."""

    def __init__(self, results: dict[str, Any]) -> None:
        self.suite = suite_from_dict(results["definition"], results["suite"])
        self.sequences: list[str] = results["sequences"]
        self.missing = set(results["missing"])
        self.records: list[dict[str, Any]] = results["entries"]

    def of(self, variant: str, sequence: str) -> list[dict[str, Any]]:
        """Records of every seed."""
        return [r for r in self.records if r["variant"] == variant and r["sequence"] == sequence]

    def values(self, variant: str, sequence: str, metric: str) -> list[float]:
        """A figure of every seed that has it."""
        found = [r["metrics"].get(metric) for r in self.of(variant, sequence)]
        return [float(v) for v in found if v is not None]

    def mean(self, variant: str, sequence: str, metric: str) -> float | None:
        """Over the seeds."""
        values = self.values(variant, sequence, metric)
        return float(np.mean(values)) if values else None

    def mean_of_all(self, variant: str, metric: str) -> float | None:
        """Over the sequences; None unless every one of them has the figure."""
        means = [self.mean(variant, s, metric) for s in self.sequences]
        known = [m for m in means if m is not None]
        return float(np.mean(known)) if means and len(known) == len(means) else None

    def text(self, variant: str, sequence: str, metric: str) -> str:
        """Mean, and in brackets least and most over the seeds; or why there is none."""
        records, values = self.of(variant, sequence), self.values(variant, sequence, metric)
        if not records:
            return "missing" if sequence in self.missing else "not run"
        complete = sum(r["status"] == "complete" for r in records)
        if not complete:
            return "failed"
        if not values:
            return NOTHING
        text = number(metric, float(np.mean(values)))
        if len(values) > 1:
            text += f" ({number(metric, min(values))}–{number(metric, max(values))})"
        return text if complete == len(records) else f"{text}, {complete} of {len(records)} runs"


def tables_of(results: dict[str, Any]) -> list[Table]:
    """All tables of a suite's results."""
    figures = Figures(results)
    build = {"sequences": _over_sequences, "variants": _of_variants}
    return [build[spec.form](spec, figures) for spec in figures.suite.tables]


def number(metric: str, value: float) -> str:
    """A figure as tables write it; the unit stands in the head."""
    form = NAMES[metric][1]
    if form.endswith("%"):
        return format(value, form)
    return format(round(value) if form.endswith("d") else value, form)


def head_of(metric: str) -> str:
    """What a column or row shows, its unit, and the better direction."""
    title, _, unit = NAMES[metric]
    arrow = {True: " ↑", False: " ↓", None: ""}[higher_is_better(metric)]
    return title + (f" [{unit}]" if unit else "") + arrow


def higher_is_better(metric: str) -> bool | None:
    """None where neither direction is better."""
    if metric.startswith(HIGHER_IS_BETTER):
        return True
    return False if metric.startswith(LOWER_IS_BETTER) else None


def _over_sequences(spec: TableSpec, figures: Figures) -> Table:
    """Tables I to III: methods down, sequences across."""
    table = Table(spec.title, ["Method", "Figure", *figures.sequences, "Mean", "Source"])
    columns = [*figures.sequences, ""]
    for metric in spec.metrics:
        best = {c: _best(metric, [_mean(figures, v, c, metric) for v in spec.variants]) for c in columns}
        for variant in spec.variants:
            cells = [Cell(_title(figures.suite, variant)), Cell(head_of(metric))]
            for column in columns:
                mean = _mean(figures, variant, column, metric)
                text = figures.text(variant, column, metric) if column else _shown(metric, mean)
                cells.append(Cell(text, mean is not None and number(metric, mean) == best[column]))
            table.rows.append([*cells, Cell("this run")])
        for row in published_table(spec.published).rows:
            if row.metric == metric:
                table.rows.append(_printed_over_sequences(row, figures.sequences))
                table.notes += _odd_mean(row)
    _add_sources(table, published_table(spec.published).rows)
    return table


def _printed_over_sequences(row: PublishedRow, sequences: list[str]) -> list[Cell]:
    values = [row.values.get(s) for s in sequences]
    known = [v for v in values if v is not None]
    mean = float(np.mean(known)) if known and len(known) == len(values) else None
    texts = [_shown(row.metric, v) for v in [*values, mean]]
    return [Cell(row.name), Cell(head_of(row.metric)), *map(Cell, texts), Cell(f"[{_mark(row.source)}]")]


def _odd_mean(row: PublishedRow) -> list[str]:
    """Where the mean that was printed is not that of the columns that were printed."""
    mean = float(np.mean(list(row.values.values())))
    if row.average is None or abs(mean - row.average) < 1.01 * 10.0 ** -_digits(row.average):
        return []
    text = f"{number(row.metric, row.average)} for {row.name}, of columns whose mean is {number(row.metric, mean)}"
    return [f"[{_mark(row.source)}] prints a mean {NAMES[row.metric][0]} of {text}."]


def _digits(value: float) -> int:
    return len(str(value).partition(".")[2])


def _of_variants(spec: TableSpec, figures: Figures) -> Table:
    """Tables IV and V: variants down, figures across; every sequence, then their mean, then what was printed."""
    table = Table(spec.title, ["Sequence", "Variant", *(head_of(m) for m in spec.metrics)])
    for sequence in figures.sequences:
        best = {m: _best(m, [figures.mean(v, sequence, m) for v in spec.variants]) for m in spec.metrics}
        for variant in spec.variants:
            cells = [Cell(sequence), Cell(_title(figures.suite, variant))]
            for metric in spec.metrics:
                mean = figures.mean(variant, sequence, metric)
                text = figures.text(variant, sequence, metric)
                cells.append(Cell(text, mean is not None and number(metric, mean) == best[metric]))
            table.rows.append(cells)
    if len(figures.sequences) > 1:
        table.rows += _mean_rows(spec, figures)
    printed = published_table(spec.published)
    for row in printed.rows:
        texts = [_shown(m, row.values.get(m)) for m in spec.metrics]
        name = _title(figures.suite, row.name)
        table.rows.append([Cell(f"as printed [{_mark(row.source)}]"), Cell(name), *map(Cell, texts)])
    if printed.note:
        table.notes.append(f"As printed: {printed.note}.")
    _add_sources(table, printed.rows)
    return table


def _mean_rows(spec: TableSpec, figures: Figures) -> list[list[Cell]]:
    best = {m: _best(m, [figures.mean_of_all(v, m) for v in spec.variants]) for m in spec.metrics}
    rows = []
    for variant in spec.variants:
        cells = [Cell(f"mean of {len(figures.sequences)}"), Cell(_title(figures.suite, variant))]
        for metric in spec.metrics:
            mean = figures.mean_of_all(variant, metric)
            text = _shown(metric, mean)
            cells.append(Cell(text, mean is not None and text == best[metric]))
        rows.append(cells)
    return rows


def _mean(figures: Figures, variant: str, column: str, metric: str) -> float | None:
    return figures.mean(variant, column, metric) if column else figures.mean_of_all(variant, metric)


def _best(metric: str, values: list[float | None]) -> str | None:
    """The best of our own as it is shown, where what is shown differs: a tie is bold in every row."""
    known, higher = [v for v in values if v is not None], higher_is_better(metric)
    if len({number(metric, v) for v in known}) < 2 or higher is None:
        return None
    return number(metric, max(known) if higher else min(known))


def _shown(metric: str, value: float | None) -> str:
    return NOTHING if value is None else number(metric, value)


def _title(suite: Suite, variant: str) -> str:
    return next((v.title for v in suite.variants if v.name == variant), variant)


def _mark(source: str) -> int:
    return list(sources()).index(source) + 1


def _add_sources(table: Table, rows: Iterable[PublishedRow]) -> None:
    for key in dict.fromkeys(row.source for row in rows):
        table.notes.append(f"[{_mark(key)}] {sources()[key].title}. {sources()[key].protocol}.")
