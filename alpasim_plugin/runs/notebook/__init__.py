"""`open_run`: a run folder as data frames, for notebooks and scripts; runs and rollouts show
themselves in a notebook.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa
import pyarrow.compute as pc

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.lazy import require_library
from alpasim_plugin.core.types import RolloutLog
from alpasim_plugin.log import read_asl
from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.log.run_folder.schema import (
    KEYS,
    LOG_NAME,
    ROLLOUTS,
    ROLLOUTS_TABLE,
    STEPS,
    STEPS_TABLE,
)
from evaluators.opening import Run, read_run
from evaluators.report.flips import inline_jpeg
from evaluators.report.headline import find
from evaluators.report.numbers import DASH, short
from evaluators.report.tables import metric_rows


def open_run(folder: str | Path, frames: Library = "pandas") -> OpenRun:
    """Open a run folder.

    Args:
        folder: What ``simrun run``, ``score`` or ``fork`` wrote.
        frames: Which library's data frames its tables are: ``pandas`` or ``polars``; each is
            imported here, and needs to be installed.

    Raises:
        InputError: No run folder, a damaged one, or a library that is not installed.

    Example:
        >>> open_run("runs/smoke").rollouts.groupby("renderer")["progress"].mean()  # doctest: +SKIP
    """
    require(frames)
    return OpenRun(read_run(folder), frames)


class OpenRun:
    """A run. In a notebook it shows its verdict, its headline metrics and frames; iterating gives
    its rollouts.

    Every table is read when it is first asked for. A metric that is not valid has no value in any
    of them (NaN, or null).
    """

    def __init__(self, run: Run, frames: Library) -> None:
        self._run, self._library = run, frames

    @property
    def folder(self) -> Path:
        """Give the run folder."""
        return self._run.folder

    @property
    def verdict(self) -> str:
        """Give what was found, in the sentence with which the report begins."""
        return find(self._run).title

    @cached_property
    def rollouts(self) -> Any:
        """Give a frame with a row a rollout: renderer, policy, scene, seed, status, every metric
        and ``METRIC_valid``.
        """
        return frame_of(valid_only(ROLLOUTS_TABLE.read(self.folder / ROLLOUTS)), self._library)

    @cached_property
    def steps(self) -> Any:
        """Give a frame with a row a rollout, metric and instant: ``t_us`` (microseconds),
        ``value``, ``valid``, ``reason``.
        """
        return frame_of(self._steps, self._library)

    @cached_property
    def summary(self) -> Any:
        """Give a frame with a row a renderer and metric: ``mean``, ``ci95``, ``ci95_low``,
        ``ci95_high``, and more.

        ``ci95`` is a half-width over rollouts; the two ends take scenes as clusters. Rates are
        fractions.
        """
        return frame_of(summary_table(self._run.summary), self._library)

    @cached_property
    def paired(self) -> Any:
        """Give a frame with a row a paired difference: ``renderer`` minus ``baseline``, its 95 %
        interval, p-value and verdict.
        """
        return frame_of(paired_table(self._run.summary), self._library)

    def rollout(
        self,
        renderer: str,
        policy: str | None = None,
        scene: str | None = None,
        seed: int | None = None,
    ) -> OpenRollout:
        """Return the one rollout that fits.

        Raises:
            InputError: None fits, or several.
        """
        wanted = dict(zip(KEYS, (renderer, policy, scene, seed), strict=True))
        found = [
            r
            for r in self._run.rollouts
            if all(value in (None, getattr(r, key)) for key, value in wanted.items())
        ]
        if len(found) != 1:
            asked = ", ".join(
                f"{key} {value!r}" for key, value in wanted.items() if value is not None
            )
            shown = "; ".join(title(one) for one in (found or self._run.rollouts)[:3])
            do_this = (
                f"name policy, scene and seed too: {shown}" if found else f"there are: {shown}"
            )
            raise InputError(
                f"{self.folder}: {asked}: {len(found)} rollouts fit",
                do_this,
            )
        return OpenRollout(self, found[0])

    def __iter__(self) -> Iterator[OpenRollout]:
        return (OpenRollout(self, one) for one in self._run.rollouts)

    def __len__(self) -> int:
        return len(self._run.rollouts)

    def __repr__(self) -> str:
        return f"{self.folder}: {len(self)} rollouts. {self.verdict}"

    def _repr_html_(self) -> str:
        return run_html(self._run)

    @cached_property
    def _steps(self) -> pa.Table:
        return STEPS_TABLE.read(self.folder / STEPS)


class OpenRollout:
    """A rollout of an open run. In a notebook it shows how it ended, its headline metrics and its
    frames.

    Attributes:
        renderer, policy, scene, seed: Which one it is.
        metrics: Values by name; None where a metric is not valid.
    """

    def __init__(self, run: OpenRun, rollout: Rollout) -> None:
        self._open, self._rollout = run, rollout
        self.renderer, self.policy, self.scene, self.seed = rollout.cell
        self.metrics = dict(rollout.metrics)

    @property
    def verdict(self) -> str:
        """Give how it ended: ``no event``, the events, or why it failed."""
        return outcome(self._rollout)

    @property
    def folder(self) -> Path:
        """Give its folder."""
        return self._open.folder / self._rollout.path

    @cached_property
    def steps(self) -> Any:
        """Give a frame with a column for each metric and a row for each instant ``t_us``; a metric
        that is not valid there has no value.

        The index is ``t_us`` in pandas; in polars it is a column.
        """
        table = self._open._steps
        mine = [
            pc.equal(table[key], pa.scalar(value, table[key].type))
            for key, value in zip(KEYS, self._rollout.cell, strict=True)
        ]
        keep = pc.and_(pc.and_(mine[0], mine[1]), pc.and_(mine[2], mine[3]))
        own = table.filter(pc.and_(keep, table["valid"])).select(["t_us", "metric", "value"])
        frame = frame_of(own, self._open._library)
        if self._open._library == "pandas":
            return frame.pivot(index="t_us", columns="metric", values="value")
        return frame.pivot("metric", index="t_us", values="value").sort("t_us")

    def log(self, images: bool = True) -> RolloutLog:
        """Read its log: poses, plans, other road users, and the encoded camera images.

        Raises:
            InputError: The log is missing or damaged.
        """
        return read_asl(self.folder / LOG_NAME, images=images)

    def __repr__(self) -> str:
        return f"{title(self._rollout)}: {self.verdict}"

    def _repr_html_(self) -> str:
        return rollout_html(self._open._run, self._rollout)


Library = Literal["pandas", "polars"]
LIBRARIES: tuple[Library, ...] = ("pandas", "polars")
DOING = "making a data frame"


def require(library: str) -> Any:
    """Import a library of data frames.

    Raises:
        InputError: It is none of the known ones, or not installed.
    """
    if library not in LIBRARIES:
        raise InputError(
            f"frames={library!r}: no such library",
            f"the libraries are {' and '.join(LIBRARIES)}",
        )
    other = next(name for name in LIBRARIES if name != library)
    do_this = f"install the extra [notebook], or pip install {library}; frames={other!r} gives frames of {other}"
    return require_library(library, f"frames={library!r}", do_this)


def frame_of(table: pa.Table, library: Library) -> Any:
    """Return a table as a frame of a library; text columns of few values become categories.

    Raises:
        InputError: The library is not installed.
    """
    found = require(library)
    return table.to_pandas() if library == "pandas" else found.from_arrow(table)


def valid_only(table: pa.Table) -> pa.Table:
    """Return a table of rollouts in which a metric that is not valid has no value.

    The column ``NAME_valid`` of each metric ``NAME`` stays.
    """
    for name in [
        column.removesuffix("_valid") for column in table.column_names if column.endswith("_valid")
    ]:
        empty = pa.scalar(None, table[name].type)
        kept = pc.if_else(pc.fill_null(table[f"{name}_valid"], False), table[name], empty)
        table = table.set_column(table.column_names.index(name), name, kept)
    return table


def summary_table(summary: Mapping[str, Any]) -> pa.Table:
    """Return ``metrics`` of a summary, one row a renderer and metric."""
    rows = []
    for renderer, metrics in (summary.get("metrics") or {}).items():
        for metric, entry in metrics.items():
            low, high = _ends(entry.get("ci95_clustered"))
            facts = {
                key: entry.get(key)
                for key in ("mean", "ci95", "n_rollouts", "n_scenes", "unit", "direction")
            }
            rows.append(
                {
                    "renderer": renderer,
                    "metric": metric,
                    **facts,
                    "ci95_low": low,
                    "ci95_high": high,
                }
            )
    return pa.Table.from_pylist(rows, SUMMARY)


def paired_table(summary: Mapping[str, Any]) -> pa.Table:
    """Return the paired differences of a summary, against the baseline and against a fixer's base,
    one row each.
    """
    rows = []
    for kind in ("paired", "paired_with_base"):
        for renderer, metrics in (summary.get(kind) or {}).items():
            for metric, entry in metrics.items():
                low, high = _ends(entry.get("ci95"))
                facts = {key: entry.get(key) for key in ("baseline", "diff", "p_value", "verdict")}
                rows.append(
                    {
                        "renderer": renderer,
                        "metric": metric,
                        **facts,
                        "ci95_low": low,
                        "ci95_high": high,
                    }
                )
    return pa.Table.from_pylist(rows, PAIRED)


SUMMARY = pa.schema(
    [
        ("renderer", pa.string()),
        ("metric", pa.string()),
        ("mean", pa.float64()),
        ("ci95", pa.float64()),
        ("ci95_low", pa.float64()),
        ("ci95_high", pa.float64()),
        ("n_rollouts", pa.int64()),
        ("n_scenes", pa.int64()),
        ("unit", pa.string()),
        ("direction", pa.string()),
    ]
)
PAIRED = pa.schema(
    [
        ("renderer", pa.string()),
        ("baseline", pa.string()),
        ("metric", pa.string()),
        ("diff", pa.float64()),
        ("ci95_low", pa.float64()),
        ("ci95_high", pa.float64()),
        ("p_value", pa.float64()),
        ("verdict", pa.string()),
    ]
)


def _ends(interval: Sequence[float | None] | None) -> tuple[float | None, float | None]:
    return (interval[0], interval[1]) if interval is not None else (None, None)


MOST_RENDERERS = 6
LEFT = 'style="text-align:left"'


def run_html(run: Run) -> str:
    """Return a run: its verdict, its headline metrics by renderer, and a strip of frames of its
    first rollout.
    """
    rows = metric_rows(run.summary, known=run.table)
    rows = [row for row in rows if row.is_headline] or rows
    names = list(run.summary.get("metrics") or {})[:MOST_RENDERERS]
    lines = []
    for row in rows:
        label = " ".join(part for part in (row.name, row.unit, row.arrow) if part)
        cells = [
            f"{cell.text} <small>{escape(cell.detail)}</small>" for cell in row.cells[: len(names)]
        ]
        lines.append([escape(label), *cells])
    first = next(
        (rollout for rollout in run.rollouts if run.file_of(rollout, "strip.jpg") is not None), None
    )
    preset = escape(str(run.summary.get("preset")))
    return _block(
        f"<b>{escape(find(run).title)}</b>",
        f"{len(run.rollouts)} rollouts, {len(run.scenes)} scenes, preset {preset}: {escape(str(run.folder))}",
        _table(["", *(escape(name) for name in names)], lines),
        "" if first is None else _picture(run, first),
    )


def rollout_html(run: Run, rollout: Rollout) -> str:
    """Return a rollout: how it ended, its headline metrics, and its strip of frames."""
    metrics = [run.table.shown(name) for name in run.table.ordered(rollout.metrics)]
    metrics = [metric for metric in metrics if metric.is_headline] or metrics
    lines = []
    for metric in metrics:
        value = rollout.metrics.get(metric.name)
        shown = (
            DASH
            if value is None
            else f"{100 * value:.1f} %"
            if metric.in_percent
            else escape(short(value, metric.unit))
        )
        lines.append([escape(metric.name), shown])
    return _block(
        f"<b>{escape(outcome(rollout))}</b>",
        escape(title(rollout)),
        _table(["metric", "value"], lines),
        _picture(run, rollout),
    )


def title(rollout: Rollout) -> str:
    """Name a rollout."""
    return f"{rollout.renderer}, {rollout.policy}, {rollout.scene}, seed {rollout.seed}"


def outcome(rollout: Rollout) -> str:
    """Say in a few words how a rollout ended."""
    if not rollout.ok:
        return f"failed ({rollout.failure_class}): {rollout.failure}"
    events = [
        word
        for word, metric in (("collision", "collision_any"), ("off-road", "offroad"))
        if rollout.flag(metric)
    ]
    return " and ".join(events) or "no event"


def _picture(run: Run, rollout: Rollout) -> str:
    path = run.file_of(rollout, "strip.jpg")
    picture = None if path is None else inline_jpeg(path)
    if picture is None:
        return "<small>no frames: the policy has no camera, or the rollout failed</small>"
    source, width, height = picture
    words = escape(f"frames of {title(rollout)}", quote=True)
    return f'<img src="{source}" width="{width}" height="{height}" style="max-width:100%;height:auto" alt="{words}">'


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    heads = "".join(f'<th scope="col" {LEFT}>{cell}</th>' for cell in head)
    lines = [
        f'<tr><th scope="row" {LEFT}>{row[0]}</th>'
        + "".join(f"<td>{cell}</td>" for cell in row[1:])
        + "</tr>"
        for row in rows
    ]
    return f"<table><thead><tr>{heads}</tr></thead><tbody>{''.join(lines)}</tbody></table>"


def _block(*parts: str) -> str:
    return "<div>" + "".join(f"<div>{part}</div>" for part in parts if part) + "</div>"
