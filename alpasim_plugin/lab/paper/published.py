"""The paper's printed numbers, from ``configs/paper/published.yaml``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.config import load_yaml, validate

DOING = "reading the paper's numbers"
NUMBER = r"\d*\.?\d+"
CELL = re.compile(rf"({NUMBER})(?:±({NUMBER}))?")


@dataclass(frozen=True)
class Printed:
    """A printed number and its half-width at 95 %; None where none is printed."""

    value: float
    half_width: float | None
    text: str


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class PaperMetric(_Part):
    """A metric of the paper and what we measure in its place."""

    heading: str
    better: Literal["higher", "lower"]
    ours: str | None = Field(description="Our metric; null where nothing stands in its place.")
    scale: float = Field(default=1.0, description="By what ours is multiplied to be printed like the paper's.")


class _Table(_Part):
    title: str
    protocol: str
    metrics: tuple[str, ...]
    rows: dict[str, str]
    no_counterpart: tuple[str, ...] = ()


class _File(_Part):
    version: Literal[1]
    source: str
    tables: dict[str, _Table]
    metrics: dict[str, PaperMetric]


@dataclass(frozen=True)
class PaperTable:
    """One table of the paper.

    Args:
        title, protocol: As headings.
        metrics: Names of its columns.
        rows: ARM -> METRIC -> the printed number; a cell that is not printed is not there.
        no_counterpart: Rows of systems that cannot be run here.
    """

    title: str
    protocol: str
    metrics: tuple[str, ...]
    rows: Mapping[str, Mapping[str, Printed]]
    no_counterpart: tuple[str, ...] = ()


@dataclass(frozen=True)
class Published:
    """The whole file."""

    source: str
    tables: Mapping[str, PaperTable]
    metrics: Mapping[str, PaperMetric]

    def ours(self, metric: str) -> str | None:
        """Return our metric in the place of the paper's."""
        return self.metrics[metric].ours


@cache
def published(path: Path | None = None) -> Published:
    """Read the numbers; without a path those that come with the package.

    Raises:
        InputError: A row with more or fewer cells than its table has metrics, a cell that is no number, or an unknown metric.
    """
    path = path or Path(str(resources.files("configs.paper"))) / "published.yaml"
    file = validate(_File, load_yaml(path, DOING), DOING)
    tables = {}
    for name, table in file.tables.items():
        if unknown := [metric for metric in table.metrics if metric not in file.metrics]:
            raise InputError(DOING, f"{path}, table {name}", f"metrics {', '.join(unknown)}", "describe them under 'metrics'")
        rows = {arm: _row(text, table.metrics, f"{path}, table {name}, row {arm}") for arm, text in table.rows.items()}
        tables[name] = PaperTable(table.title, table.protocol, table.metrics, rows, table.no_counterpart)
    return Published(file.source, tables, file.metrics)


def _row(text: str, metrics: tuple[str, ...], where: str) -> dict[str, Printed]:
    cells = text.split()
    if len(cells) != len(metrics):
        raise InputError(DOING, where, f"{len(cells)} cells for {len(metrics)} metrics", "give one cell for each metric, '-' for none")
    out = {}
    for metric, cell in zip(metrics, cells, strict=True):
        if cell == "-":
            continue
        found = CELL.fullmatch(cell)
        if found is None:
            raise InputError(DOING, f"{where}, {metric}", f"cell {cell!r}", "write VALUE, VALUE±HALF-WIDTH or '-'")
        value, half = found.groups()
        out[metric] = Printed(float(value), None if half is None else float(half), cell)
    return out
