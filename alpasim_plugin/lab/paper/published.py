"""The paper's printed numbers, from ``configs/paper/published.yaml``."""

from __future__ import annotations

import re
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from alpasim_plugin.core.config import load_yaml, validate
from alpasim_plugin.core.errors import InputError

DOING = "reading the paper's numbers"
CELL = re.compile(r"\d*\.?\d+(±\d*\.?\d+)?")


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class PaperMetric(_Part):
    """A metric of the paper and what we measure in its place."""

    heading: str
    better: Literal["higher", "lower"]
    ours: str | None = Field(description="Our metric; null where nothing stands in its place.")
    scale: float = Field(
        default=1.0, description="By what ours is multiplied to be printed like the paper's."
    )


class PaperTable(_Part):
    """One table of the paper."""

    title: str
    protocol: str
    metrics: tuple[str, ...] = Field(description="Names of its columns.")
    rows: dict[str, str] = Field(
        description="Arm to its printed numbers, one a metric: VALUE, VALUE±HALF-WIDTH, or - where none is."
    )
    no_counterpart: tuple[str, ...] = Field(
        default=(), description="Rows of systems that cannot be run here."
    )

    def cells(self, arm: str) -> list[str]:
        """Return a row's printed numbers, in the order of the metrics."""
        return self.rows[arm].split()


class Published(_Part):
    """The whole file."""

    version: Literal[1]
    source: str
    tables: dict[str, PaperTable]
    metrics: dict[str, PaperMetric]


@cache
def published(path: Path | None = None) -> Published:
    """Read the numbers; without a path those that come with the package.

    Raises:
        InputError: A row with more or fewer cells than its table has metrics, a cell that is no
            number, or an unknown metric.
    """
    path = path or Path(str(resources.files("configs.paper"))) / "published.yaml"
    file = validate(Published, load_yaml(path))
    for name, table in file.tables.items():
        if unknown := [metric for metric in table.metrics if metric not in file.metrics]:
            raise InputError(
                f"{path}, table {name}: metrics {', '.join(unknown)}",
                "describe them under 'metrics'",
            )
        for arm in table.rows:
            cells, where = table.cells(arm), f"{path}, table {name}, row {arm}"
            if len(cells) != len(table.metrics):
                found, do = (
                    f"{len(cells)} cells for {len(table.metrics)} metrics",
                    "give one cell for each metric, '-' for none",
                )
                raise InputError(f"{where}: {found}", do)
            for metric, cell in zip(table.metrics, cells, strict=True):
                if cell != "-" and not CELL.fullmatch(cell):
                    raise InputError(
                        f"{where}, {metric}: cell {cell!r}",
                        "write VALUE, VALUE±HALF-WIDTH or '-'",
                    )
    return file
