"""What the paper prints: its tables of numbers, and the metrics that stand in their place here."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, model_validator

from alpasim_plugin.core.files.config import load_yaml, validate

HERE = Path(__file__).resolve().parent
FILE = HERE / "printed.yaml"


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class PrintedTable(_Strict):
    """One table of the paper; a row holds its metrics in the order of ``metrics``."""

    title: str
    protocol: str
    metrics: tuple[str, ...]
    rows: dict[str, str]

    @model_validator(mode="after")
    def _is_full(self) -> PrintedTable:
        for name, row in self.rows.items():
            if len(row.split()) != len(self.metrics):
                raise ValueError(f"row {name}: {len(row.split())} values | write one a metric")
        return self

    def cell(self, row: str, metric: str) -> str | None:
        """Return a value as printed, such as ``.117±.013``; None where the paper has none."""
        if row not in self.rows or metric not in self.metrics:
            return None
        text = self.rows[row].split()[self.metrics.index(metric)]
        return None if text == "-" else text


class PrintedMetric(_Strict):
    """A metric of the paper, and those of ours that stand in its place, the best one first."""

    heading: str
    better: Literal["higher", "lower"]
    ours: tuple[str, ...]
    scale: float = 1.0


class Printed(_Strict):
    """All tables that are compared."""

    version: Literal[1]
    source: str
    tables: dict[str, PrintedTable]
    metrics: dict[str, PrintedMetric]


@cache
def printed() -> Printed:
    """Return the paper's tables."""
    return validate(Printed, load_yaml(FILE))
