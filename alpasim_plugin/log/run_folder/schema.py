"""What a run folder holds: its files in the order in which they are written, its tables column by
column, and the names of its cells.
"""

from __future__ import annotations

import math
import re
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.parts import digest
from alpasim_plugin.core.reading import parsing
from alpasim_plugin.core.reading.tables import Kind, check_columns, check_parquet, read_parquet

if TYPE_CHECKING:
    import pyarrow as pa

AGAIN = "give a folder written by simrun run or simrun score, or write it again with the same command and --resume"
# of a metric's value: a double holds no thousandths of larger ones, and no picture a thousand times
# as much
LARGEST = 1e15
LATEST_US = 2.0**62  # of a time: the difference of two is one of 64 bits
VALID = "_valid"  # ends the name of the column that tells where a metric is valid


@dataclass(frozen=True)
class File:
    """A file or a folder of a run folder, or of the folder of a rollout.

    Attributes:
        name: Below the folder; a folder ends with ``/``.
        holds: What is in it, for docs/architecture.md.
        made_by: What writes it: the beginning of a run, the drive, the scoring of its log, the
            tables, the reports, a command of its own, or the end of the run.
        is_required: Finished runs, and finished rollouts, have it.
    """

    name: str
    holds: str
    made_by: Literal["start", "drive", "score", "tables", "report", "command", "end"]
    is_required: bool = True


LOG_NAME = "rollout.asl"
FRAMES_NAME = "frames.jsonl"
OUTPUT_NAME = "output.log"
STEPS_NAME = "steps.parquet"
STRIP_NAME = "strip.jpg"
VIDEO_NAME = "front.mp4"
MANIFEST = "manifest.json"
WHY_NAME = "why.html"
LOCK = ".simrun.lock"
RUN_INFO = "run.json"
SUMMARY = "summary.json"
ROLLOUTS = "rollouts.parquet"
STEPS = "steps.parquet"
SCENES = "scenes"
ROLLOUTS_FOLDER = "rollouts"
AGGREGATE = "aggregate"
PAGES = ("report.html", "flips.html")
REPORTS = (*PAGES, "summary.md", "junit.xml")  # made from the tables; nothing reads them

ROLLOUT_FILES = (
    File(LOG_NAME, "the log", "drive"),
    File(FRAMES_NAME, "facts of every camera frame", "drive"),
    File(OUTPUT_NAME, "what its parts printed", "drive", is_required=False),
    File(STEPS_NAME, "its rows of the run's steps.parquet", "score"),
    File(STRIP_NAME, "a few frames", "drive", is_required=False),
    File(VIDEO_NAME, "the video, on request", "drive", is_required=False),
    File(WHY_NAME, "of a drive that failed: the page that shows why", "report", is_required=False),
    File(MANIFEST, "what it is, how it went, and the digests of the other files", "end"),
)
RUN_FILES = (
    File(LOCK, "who writes the folder, while somebody does", "start", is_required=False),
    File(
        f"{SCENES}/",
        "lanes, edges and the logged path, so that a report needs no source files",
        "start",
    ),
    File(RUN_INFO, "the command, and everything that decides the results", "start"),
    File(f"{ROLLOUTS_FOLDER}/", "a folder for each rollout", "drive"),
    File(f"{AGGREGATE}/", "AlpaSim's aggregation of scored logs", "score", is_required=False),
    File(
        "decision.json",
        "question, order of scenes, looks and verdict of a run driven until decided",
        "drive",
        is_required=False,
    ),
    File(ROLLOUTS, "a row for each rollout", "tables"),
    File(STEPS, "a row for each metric at each instant of a rollout", "tables"),
    File(
        SUMMARY, "metrics with intervals, paired differences, censoring, failures, speed", "tables"
    ),
    File(
        "flips.json",
        "of every pair that ends differently: when the plans diverge",
        "report",
        is_required=False,
    ),
    File("flips/", "both frames at that time", "report", is_required=False),
    *(
        File(name, "reports for people and for CI", "report", is_required=False)
        for name in reversed(REPORTS)
    ),
    File("view.html", "drives side by side", "command", is_required=False),
    File("gate.json", "what the last gate found, for the report", "command", is_required=False),
    File("forks/", "forks of logged rollouts", "command", is_required=False),
)
TABLES = tuple(
    file.name for file in RUN_FILES if file.made_by == "tables"
)  # made from the manifests
DRIVEN = tuple(
    file.name for file in ROLLOUT_FILES if file.made_by == "drive"
)  # only driving makes them
DERIVED = tuple(
    file.name for file in ROLLOUT_FILES if file.made_by == "score"
)  # scoring makes them from the log


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

        Types are read from the header; so are missing values and values out of range, where the
        header has statistics. Metrics that are ``rates`` lie in [0, 1].

        Raises:
            InputError: It is no such table: the error names the file, the column, and the first row
                that is wrong.
        """
        import pyarrow.parquet as pq

        names = check_parquet(path, self.required, do_this)
        stated = [
            *(c for c in self.columns if c.name in names),
            *columns_of(metrics_in(names), rates),
        ]
        with parsing(path, do_this, "no readable parquet"):
            facts = pq.read_metadata(path)
            empty = pq.read_schema(path).empty_table()
        check_columns(empty, {column.name: column.kind for column in stated}, path, do_this)
        for column in stated:
            if _is_suspicious(facts, column):
                _check_values(path, column, do_this)
        if identity := [name for name in self.identity if name in names]:
            kinds = {column.name: column.kind for column in self.columns if column.name in identity}
            _check_identity(read_parquet(path, kinds, do_this, only=True), path, do_this)
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


def _is_suspicious(facts: Any, column: Column) -> bool:
    """Tell whether the statistics in a file's header do not show that all values of a column are
    there and in range.
    """
    if not column.is_required and column.least is None:
        return False
    (at,) = [i for i in range(facts.num_columns) if facts.schema.column(i).path == column.name]
    for group in range(facts.num_row_groups):
        stats = facts.row_group(group).column(at).statistics
        if stats is None or not stats.has_null_count or (column.is_required and stats.null_count):
            return True
        if (
            column.least is None or stats.num_values == 0
        ):  # of a chunk of nothing but nulls no least value is stated
            continue
        if not stats.has_min_max or not column.least <= stats.min <= stats.max <= column.most:
            return True
    return False


def _check_values(path: Path, column: Column, do_this: str) -> None:
    """Refuse a column with a value that is missing or out of range; the first row with one is
    named, counted from 0.
    """
    import pyarrow.compute as pc

    values = read_parquet(path, {column.name: column.kind}, do_this, only=True)[column.name]
    checks = [(pc.is_null(values), f"nothing, wanted {column.kind}")] if column.is_required else []
    if column.least is not None:
        # Arrow compares an integer with a float as floats, and refuses integers that a float does
        # not hold.
        bound = int if column.kind == "integer" else float
        known = pc.is_finite(values)  # what is not finite counts as missing
        checks.append(
            (
                pc.and_(known, pc.less(values, bound(column.least))),
                f"a value below {column.least:g}",
            )
        )
        if math.isfinite(column.most):
            checks.append(
                (
                    pc.and_(known, pc.greater(values, bound(column.most))),
                    f"a value above {column.most:g}",
                )
            )
    for wrong, found in checks:
        row = pc.index(wrong, True).as_py()
        if row >= 0:
            raise InputError(f"{path}, row {row}: column {column.name!r}: {found}", do_this)


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
