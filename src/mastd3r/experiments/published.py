"""What others have printed: read from published.yaml, the only place where such numbers stand."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from ..errors import ConfigError

FILE = Path(__file__).with_name("published.yaml")


@dataclass(frozen=True)
class PublishedSource:
    """Where figures were printed, and how they were measured there."""

    title: str
    protocol: str


@dataclass(frozen=True)
class PublishedRow:
    """Figures of one method: one metric over sequences, or several metrics of one variant."""

    name: str  # the method, or the variant
    source: str
    metric: str  # empty where the columns are metrics
    values: dict[str, float]  # by column, in our units; a column that was not printed is absent
    average: float | None  # as printed


@dataclass(frozen=True)
class PublishedTable:
    """The rows of one of our tables."""

    rows: tuple[PublishedRow, ...]
    note: str


@cache
def sources() -> dict[str, PublishedSource]:
    """Every source by its key."""
    return {key: PublishedSource(value["title"], value["protocol"]) for key, value in _data()["sources"].items()}


@cache
def published_table(name: str) -> PublishedTable:
    """The printed rows of a table; none for an empty name. Raises ConfigError for an unknown one."""
    if not name:
        return PublishedTable((), "")
    tables = _data()["tables"]
    if name not in tables:
        raise ConfigError(f"published: expected one of {', '.join(tables)}, got {name!r}")
    table = tables[name]
    return PublishedTable(tuple(_row(r, table) for r in table["rows"]), table.get("note", ""))


def _row(row: dict[str, Any], table: dict[str, Any]) -> PublishedRow:
    scales = table.get("scale", [row.get("scale", 1)] * len(table["columns"]))
    cells = zip(table["columns"], row["values"], scales, strict=True)
    values = {column: value * scale for column, value, scale in cells if value is not None}
    return PublishedRow(
        row.get("method") or row["variant"], row["source"], row.get("metric", ""), values, row.get("average")
    )


@cache
def _data() -> dict[str, Any]:
    data: dict[str, Any] = yaml.safe_load(FILE.read_text(encoding="utf-8"))
    return data
