"""What a run folder holds: its files in the order in which they are written, its tables column by
column, and the names of its cells.
"""

from __future__ import annotations

import math
import re
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import or_
from pathlib import Path
from typing import TYPE_CHECKING

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.parts import digest
from alpasim_plugin.core.reading import parsing
from alpasim_plugin.core.reading.tables import Kind, check_columns, check_parquet, read_parquet

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.compute as pc

AGAIN = "give a folder written by simrun run or simrun score, or write it again with the same command and --resume"
# of a metric's value: a double holds no thousandths of larger ones, and no image a thousand times
# as much
LARGEST = 1e15
LATEST_US = 2.0**62  # of a time: the difference of two is one of 64 bits
VALID = "_valid"  # ends the name of the column that tells where a metric is valid


# Files of a run folder.
RUN_INFO = "run.json"  # the command, and everything that decides the results
SCENES = "scenes"  # lanes, edges and the logged path: a report needs no source files
ROLLOUTS_FOLDER = "rollouts"
ROLLOUTS = "rollouts.parquet"  # a row for each rollout
STEPS = "steps.parquet"  # a row for each metric at each instant of a rollout
SUMMARY = "summary.json"  # the last of the tables
TABLES = (ROLLOUTS, STEPS, SUMMARY)
PAGES = ("report.html", "flips.html", "flips.json")
REPORTS = (*PAGES, "summary.md", "junit.xml")
GATE_FILES = ("gate.json", "gate.md", "gate.junit.xml")
DECISION = "decision.json"  # the question of a run that stopped when it was decided
FILES = "files.json"  # digests of these; the rollouts have manifests
STAGES = ".stages"  # what the workers of a run do, while they do it
LOCK = ".simrun.lock"  # while somebody writes the folder
AGGREGATE = "aggregate"  # AlpaSim's aggregation of scored logs
# Files of the folder of a rollout.
LOG_NAME = "rollout.asl"
FRAMES_NAME = "frames.jsonl"  # facts of every camera frame
DEBUG_NAME = "debug.jsonl"  # what the policy reports about itself with its plans
OUTPUT_NAME = "output.log"  # what its parts printed
VIDEO_NAME = "front.mp4"
STEPS_NAME = "steps.parquet"  # its rows of the run's table
WHY_NAME = "why.html"
SAME_POSES = "same_poses.json"  # of a failure: what the run's other renderers show
MANIFEST = "manifest.json"  # written last, with the digests of DRIVEN and DERIVED
# Only driving makes them.
DRIVEN = (LOG_NAME, FRAMES_NAME, DEBUG_NAME, OUTPUT_NAME, VIDEO_NAME)
DERIVED = (STEPS_NAME,)  # made from the log


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        name: Its name.
        kind: Its type: text, integer (64 bits), number (double) or flag (boolean).
        is_required: A table without it, and a row without a value in it, is refused.
        least: The least value; None: any.
        most: The greatest value; infinite: any.
        of_logs: Only tables of scored logs have it.
    """

    name: str
    kind: Kind
    is_required: bool = False
    least: float | None = None
    most: float = math.inf
    of_logs: bool = False

    def faults(self) -> list[tuple[pc.Expression, str]]:
        """Return what must not be, with what a row that has it lacks; a number that is not finite
        counts as missing.
        """
        import pyarrow.compute as pc

        value = pc.field(self.name)
        faults = []
        if self.is_required:
            faults.append((value.is_null(), f"nothing, wanted {self.kind}"))
        # Arrow compares an integer with a float as floats, and refuses integers that a float does
        # not hold.
        bound = int if self.kind == "integer" else float
        if self.least is not None:
            is_less = pc.is_finite(value) & (value < bound(self.least))
            faults.append((is_less, f"a value below {self.least:g}"))
        if math.isfinite(self.most):
            is_greater = pc.is_finite(value) & (value > bound(self.most))
            faults.append((is_greater, f"a value above {self.most:g}"))
        return faults


@dataclass(frozen=True)
class TableSchema:
    """A table of a run folder.

    Attributes:
        name: Its file.
        columns: In the order of the file; those of the metrics follow.
        identity: Columns that name a row, as far as a file has them: no two rows agree in all.
    """

    name: str
    columns: tuple[Column, ...]
    identity: tuple[str, ...] = ()

    @property
    def required(self) -> dict[str, Kind]:
        """Give the columns that every such table has, with their kinds."""
        return {column.name: column.kind for column in self.columns if column.is_required}

    def arrow(self, metrics: Iterable[str] = (), of_logs: bool = False) -> pa.Schema:
        """Return the schema by which the table is written.

        Args:
            metrics: Names, in the order of their columns.
            of_logs: The table is one of scored logs, which names the log's folder in ``rollout``.
        """
        import pyarrow as pa

        types = {
            "text": pa.string(),
            "integer": pa.int64(),
            "number": pa.float64(),
            "flag": pa.bool_(),
        }
        own = [column for column in self.columns if of_logs or not column.of_logs]
        return pa.schema(
            [(column.name, types[column.kind]) for column in (*own, *columns_of(metrics))]
        )

    def check(self, path: Path, do_this: str = AGAIN, rates: Container[str] = ()) -> list[str]:
        """Compare a file with the schema before any of it is used, and return the names of its
        columns.

        Rows are read only where the statistics in the header do not tell. Metrics that are
        ``rates`` lie in [0, 1].

        Raises:
            InputError: It is no such table: the error names the file, the column, and the first row
                that is wrong.
        """
        import pyarrow.compute as pc
        import pyarrow.dataset as pads

        names = check_parquet(path, self.required, do_this)
        stated = [
            *(c for c in self.columns if c.name in names),
            *columns_of(metrics_in(names), rates),
        ]
        kinds = {column.name: column.kind for column in stated}
        with parsing(path, do_this, "no readable parquet"):
            data = pads.dataset(path, format="parquet")
        check_columns(data.schema.empty_table(), kinds, path, do_this)
        faults = {column.name: column.faults() for column in stated}
        wrong = reduce(or_, (fault for found in faults.values() for fault, _ in found))
        with parsing(path, do_this, "no readable parquet"):
            n_wrong = data.count_rows(filter=wrong)
        for name, found in faults.items() if n_wrong else ():
            for fault, text in found:
                row = pc.index(data.to_table(columns={"wrong": fault})["wrong"], True).as_py()
                if row >= 0:
                    raise InputError(f"{path}, row {row}: column {name!r}: {text}", do_this)
        identity = {name: kinds[name] for name in self.identity if name in names}
        if identity:
            _check_identity(read_parquet(path, identity, do_this, only=True), path, do_this)
        return names

    def read(
        self,
        path: Path,
        do_this: str = AGAIN,
        only: Sequence[str] | None = None,
    ) -> pa.Table:
        """Return a file, or ``only`` the named columns of it, after `check`."""
        names = self.check(path, do_this)
        wanted = names if only is None else only
        kinds = {
            column.name: column.kind
            for column in (*self.columns, *columns_of(metrics_in([*names, *wanted])))
        }
        return read_parquet(
            path,
            {name: kinds[name] for name in wanted if name in kinds},
            do_this,
            only=only is not None,
        )


def columns_of(metrics: Iterable[str], rates: Container[str] = ()) -> list[Column]:
    """Return the columns of metrics: a number, and a flag that tells whether it is valid; null
    where a rollout failed.

    A number is one that reports can draw (`LARGEST`); one of the ``rates`` is in [0, 1].
    """
    out: list[Column] = []
    for name in metrics:
        least, most = (0.0, 1.0) if name in rates else (-LARGEST, LARGEST)
        out += [Column(name, "number", least=least, most=most), Column(name + VALID, "flag")]
    return out


def metrics_in(columns: Iterable[str]) -> tuple[str, ...]:
    """Return the metrics among the columns of ``rollouts.parquet``: those with a column of
    validity.
    """
    return tuple(name.removesuffix(VALID) for name in columns if name.endswith(VALID))


CELL_COLUMNS = (
    Column("renderer", "text", is_required=True),
    Column("policy", "text", is_required=True),
    Column("scene", "text", is_required=True),
    Column("seed", "integer", is_required=True),
)
KEYS = tuple(column.name for column in CELL_COLUMNS)
LOG_COLUMN = Column("rollout", "text", of_logs=True)

ROLLOUTS_TABLE = TableSchema(
    ROLLOUTS,
    (
        *CELL_COLUMNS,
        LOG_COLUMN,
        Column("status", "text", is_required=True),
        Column("failure_class", "text"),
        Column("failure", "text"),
        Column("path", "text"),
        Column("copied_from", "text"),
        Column("wall_s", "number", least=0.0),
        Column("frames", "integer", least=0),
        Column("steps", "integer", least=0),
    ),
    identity=(*KEYS, LOG_COLUMN.name),
)
STEPS_TABLE = TableSchema(
    STEPS,
    (
        *CELL_COLUMNS,
        Column("t_us", "integer", is_required=True, least=-LATEST_US, most=LATEST_US),
        Column("metric", "text", is_required=True),
        Column("value", "number", least=-LARGEST, most=LARGEST),
        Column("valid", "flag", is_required=True),
        Column("reason", "text"),
        LOG_COLUMN,
    ),
)


def _check_identity(keys: pa.Table, path: Path, do_this: str) -> None:
    """Refuse rows that are named alike: each would count as a rollout of its own."""
    counted = keys.group_by(keys.column_names).aggregate([([], "count_all")])
    if counted.num_rows == keys.num_rows:
        return
    often = counted.sort_by([("count_all", "descending")]).slice(0, 1).to_pylist()[0]
    times = often.pop("count_all")
    raise InputError(
        f"{path}: {times} rows of {', '.join((f'{key} {value!r}' for key, value in often.items()))}, wanted one",
        do_this,
    )


SLUG_LENGTH = 80
SEPARATOR = "/"  # joins the names of a cell, wherever one key stands for several


def slug(name: str) -> str:
    """Return a name that is safe as one folder; different names have different slugs.

    Example:
        >>> slug("onefixer@1"), slug("nre://host:50051")
        ('onefixer@1', 'nre-host-50051-9d6a75a3')
    """
    safe = re.sub(r"[^A-Za-z0-9._@+-]+", "-", name).strip("-.")[:SLUG_LENGTH]
    return name if safe == name and safe else f"{safe}-{digest(name)[:8]}"


def cell_name(*names: str | int) -> str:
    """Return the key of a cell, or of a part of one, such as ``RENDERER/POLICY`` or
    ``RENDERER/POLICY/SCENE/SEED``.

    It is compared, never taken apart: names may hold the separator themselves.
    """
    return SEPARATOR.join(map(str, names))


def rollout_folder(renderer: str, policy: str, scene: str, seed: int | str) -> Path:
    """Return a rollout's folder below the run folder; of a scored log the last part is its own name
    instead of a seed.
    """
    return Path(
        ROLLOUTS_FOLDER,
        slug(renderer),
        slug(policy),
        slug(scene),
        slug(seed) if isinstance(seed, str) else str(seed),
    )
