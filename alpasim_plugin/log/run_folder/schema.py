"""What a run folder holds: its files in the order in which they are written, its tables column by
column, and the names of its cells.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from alpasim_plugin.core.files.tables import Kind, check_parquet, read_parquet
from alpasim_plugin.core.parts import digest

if TYPE_CHECKING:
    import pyarrow as pa

AGAIN = "give a folder written by simrun run or simrun score, or write it again with the same command and --resume"
VALID = "_valid"  # ends the name of the column that tells where a metric is valid


# Files of a run folder.
RUN_INFO = "run.json"  # the command, and everything that decides the results
SCENES = "scenes"  # lanes, edges and the logged path: a report needs no source files
ROLLOUTS_FOLDER = "rollouts"
ROLLOUTS = "rollouts.parquet"  # a row for each rollout
STEPS = "steps.parquet"  # a row for each metric at each instant of a rollout
SUMMARY = "summary.json"  # the last of the tables
TABLES = (ROLLOUTS, STEPS, SUMMARY)
PAGES = ("report.html", "flips.json")
REPORTS = (*PAGES, "summary.md", "junit.xml")
STAGES = ".stages"  # what the workers of a run do, while they do it
GATE_FILES = ("gate.json", "gate.md", "gate.junit.xml")
DECISION = "decision.json"  # the question of a run that stopped when it was decided
FILES = "files.json"  # digests of these; the rollouts have manifests
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
        is_required: A table without it is refused.
        of_logs: Only tables of scored logs have it.
    """

    name: str
    kind: Kind
    is_required: bool = False
    of_logs: bool = False


@dataclass(frozen=True)
class TableSchema:
    """A table of a run folder.

    Attributes:
        name: Its file.
        columns: In the order of the file; those of the metrics follow.
    """

    name: str
    columns: tuple[Column, ...]

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
        columns = [column for column in self.columns if of_logs or not column.of_logs]
        return pa.schema(
            [(column.name, types[column.kind]) for column in (*columns, *columns_of(metrics))]
        )

    def kinds(self, names: Sequence[str]) -> dict[str, Kind]:
        """Give the kinds of the columns of a file with these names, as far as they are known."""
        columns = [column for column in self.columns if column.name in names]
        return {column.name: column.kind for column in (*columns, *columns_of(metrics_in(names)))}

    def check(self, path: Path, do_this: str = AGAIN) -> list[str]:
        """Compare the header of a file with the schema, and return the names of its columns.

        Raises:
            InputError: It is no such table.
        """
        required = {column.name: column.kind for column in self.columns if column.is_required}
        names = check_parquet(path, required, do_this)
        check_parquet(path, self.kinds(names), do_this)
        return names

    def read(self, path: Path) -> pa.Table:
        """Return a file after `check`."""
        return read_parquet(path, self.kinds(self.check(path)), AGAIN)


def columns_of(metrics: Iterable[str]) -> list[Column]:
    """Return the columns of metrics: a number, and a flag that tells whether it is valid; null
    where a rollout failed.
    """
    out = []
    for name in metrics:
        out += [Column(name, "number"), Column(name + VALID, "flag")]
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
        Column("wall_s", "number"),
        Column("frames", "integer"),
        Column("steps", "integer"),
    ),
)
STEPS_TABLE = TableSchema(
    STEPS,
    (
        *CELL_COLUMNS,
        Column("t_us", "integer", is_required=True),
        Column("metric", "text", is_required=True),
        Column("value", "number"),
        Column("valid", "flag", is_required=True),
        Column("reason", "text"),
        LOG_COLUMN,
    ),
)


UNKNOWN = "unknown"  # renderer or policy that a log does not name; all three of an unreadable one


def is_named(cell: Sequence[str | int], is_ok: bool) -> bool:
    """Tell whether the rollout of a cell has names: a log that cannot be read has none, and its
    `UNKNOWN` is no variant beside others.
    """
    return is_ok or any(name != UNKNOWN for name in cell[:3])


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
