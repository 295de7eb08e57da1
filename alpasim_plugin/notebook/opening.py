"""`open_run`: a run folder as data frames, for notebooks and scripts."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import RolloutLog
from alpasim_plugin.log import read_asl
from alpasim_plugin.notebook.frames import Library, frame_of, paired_table, require, summary_table, valid_only
from alpasim_plugin.notebook.html import outcome, rollout_html, run_html, title
from alpasim_plugin.run_folder.rows import Rollout
from alpasim_plugin.run_folder.schema import KEYS, LOG_NAME, ROLLOUTS, ROLLOUTS_TABLE, STEPS, STEPS_TABLE
from evaluators.opening import Run, read_run
from evaluators.report.headline import find


def open_run(folder: str | Path, frames: Library = "pandas") -> OpenRun:
    """Open a run folder.

    Args:
        folder: What ``simrun run``, ``score`` or ``fork`` wrote.
        frames: Which library's data frames its tables are: ``pandas`` or ``polars``; each is imported here, and needs to be installed.

    Raises:
        InputError: No run folder, a damaged one, or a library that is not installed.

    Example:
        >>> open_run("runs/smoke").rollouts.groupby("renderer")["progress"].mean()  # doctest: +SKIP
    """
    require(frames)
    return OpenRun(read_run(folder), frames)


class OpenRun:
    """A run. In a notebook it shows its verdict, its headline metrics and frames; iterating gives its rollouts.

    Every table is read when it is first asked for. A metric that is not valid has no value in any of them (NaN, or null).
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
        """Give a frame with a row a rollout: renderer, policy, scene, seed, status, every metric and ``METRIC_valid``."""
        return frame_of(valid_only(ROLLOUTS_TABLE.read(self.folder / ROLLOUTS)), self._library)

    @cached_property
    def steps(self) -> Any:
        """Give a frame with a row a rollout, metric and instant: ``t_us`` (microseconds), ``value``, ``valid``, ``reason``."""
        return frame_of(self._steps, self._library)

    @cached_property
    def summary(self) -> Any:
        """Give a frame with a row a renderer and metric: ``mean``, ``ci95``, ``ci95_low``, ``ci95_high``, and more.

        ``ci95`` is a half-width over rollouts; the two ends take scenes as clusters. Rates are fractions.
        """
        return frame_of(summary_table(self._run.summary), self._library)

    @cached_property
    def paired(self) -> Any:
        """Give a frame with a row a paired difference: ``renderer`` minus ``baseline``, its 95 % interval, p-value and verdict."""
        return frame_of(paired_table(self._run.summary), self._library)

    def rollout(self, renderer: str, policy: str | None = None, scene: str | None = None, seed: int | None = None) -> OpenRollout:
        """Return the one rollout that fits.

        Raises:
            InputError: None fits, or several.
        """
        wanted = dict(zip(KEYS, (renderer, policy, scene, seed), strict=True))
        found = [r for r in self._run.rollouts if all(value in (None, getattr(r, key)) for key, value in wanted.items())]
        if len(found) != 1:
            asked = ", ".join(f"{key} {value!r}" for key, value in wanted.items() if value is not None)
            shown = "; ".join(title(one) for one in (found or self._run.rollouts)[:3])
            do_this = f"name policy, scene and seed too: {shown}" if found else f"there are: {shown}"
            raise InputError("choosing a rollout", f"{self.folder}: {asked}", f"{len(found)} rollouts fit", do_this)
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
    """A rollout of an open run. In a notebook it shows how it ended, its headline metrics and its frames.

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
        """Give a frame with a column a metric and a row an instant ``t_us``; a metric that is not valid there has no value.

        The index is ``t_us`` in pandas; in polars it is a column.
        """
        table = self._open._steps
        mine = [pc.equal(table[key], pa.scalar(value, table[key].type)) for key, value in zip(KEYS, self._rollout.cell, strict=True)]
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
