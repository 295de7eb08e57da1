"""Progress of a run: a bar on a terminal, one plain line per rollout on a pipe."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from evaluators.metrics.outcomes import NO_OUTCOME, event_words
from evaluators.report.numbers import plural

if TYPE_CHECKING:  # verbs that only read a run load neither the loop nor its kernels
    from alpasim_plugin.runs.execute import Threads
    from alpasim_plugin.runs.plan import RunPlan
    from evaluators.statistics.decision import State

SHOWN_CHANGES, SHOWN_SCENES = 4, 5
MAX_LINES = 1000


class Silent:
    """Say nothing."""

    def started(self, plan: RunPlan, root: Path, threads: Threads) -> None:
        """Ignore."""

    def rollout_done(self, manifest: dict[str, Any], reused: bool) -> None:
        """Ignore."""

    def looked(self, state: State, rollouts: int, ceiling: int) -> None:
        """Ignore."""

    def noticed(self, text: str) -> None:
        """Print the line: damage is reported even with ``--quiet``."""
        print(f"warning: {text}", file=sys.stderr, flush=True)


class Lines:
    """One line per finished rollout on stderr, for pipes and CI logs; of a large run some
    `MAX_LINES` in all, and one per failure.
    """

    def __init__(self) -> None:
        self._done, self._total, self._failed = 0, 0, 0

    def started(self, plan: RunPlan, root: Path, threads: Threads) -> None:
        """Print the run's headline."""
        self._total = len(plan.cells)
        print(headline(plan, root, threads), file=sys.stderr, flush=True)

    def rollout_done(self, manifest: dict[str, Any], reused: bool) -> None:
        """Print one rollout's result."""
        self._done += 1
        has_failed = manifest["status"] != "ok"
        self._failed += has_failed
        if (
            has_failed
            or self._done == self._total
            or self._done % max(1, self._total // MAX_LINES) == 0
        ):
            failed = f", {self._failed} failed" if self._failed else ""
            print(
                f"[{self._done}/{self._total}{failed}] {describe(manifest, reused)}",
                file=sys.stderr,
                flush=True,
            )

    def looked(self, state: State, rollouts: int, ceiling: int) -> None:
        """Print an interim analysis."""
        print(look_line(state, rollouts, ceiling), file=sys.stderr, flush=True)

    def noticed(self, text: str) -> None:
        """Print it."""
        print(f"warning: {text}", file=sys.stderr, flush=True)


class Bar:
    """A live bar on stderr."""

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=self._console,
            transient=True,
        )

    def started(self, plan: RunPlan, root: Path, threads: Threads) -> None:
        """Show the bar."""
        self._console.print(headline(plan, root, threads), highlight=False)
        self._task = self._progress.add_task("rollouts", total=len(plan.cells))
        self._progress.start()

    def rollout_done(self, manifest: dict[str, Any], reused: bool) -> None:
        """Advance the bar, and print failures above it."""
        if manifest["status"] != "ok":
            self._progress.console.print(describe(manifest, reused), highlight=False, markup=False)
        self._progress.update(
            self._task, advance=1, description=f"{manifest['renderer']} {manifest['scene']}"
        )
        if self._progress.finished:
            self._progress.stop()

    def looked(self, state: State, rollouts: int, ceiling: int) -> None:
        """Print an interim analysis above the bar."""
        self._progress.console.print(look_line(state, rollouts, ceiling), highlight=False)
        if state.answer != "open":
            self._progress.stop()

    def noticed(self, text: str) -> None:
        """Print it above the bar."""
        self._progress.console.print(f"warning: {text}", highlight=False, markup=False)


def warn(text: str) -> None:
    """Print a line on standard error."""
    print(text, file=sys.stderr, flush=True)


def report_line(root: Path) -> str:
    """Return the lines that say where a run's report is, or how to get it, and how to watch its
    drives.
    """
    page, run = root / "report.html", shlex.quote(str(root))
    report = (
        f"report   {shlex.quote(str(page))}"
        if page.exists()
        else f"report   not written; simrun report {run}"
    )
    return f"{report}\nwatch    simrun view {run}"


def look_line(state: State, rollouts: int, ceiling: int) -> str:
    """Return one line for an interim analysis: scenes, and each metric's interval and verdict."""

    def bound(value: float | None) -> str:
        return "unbounded" if value is None else f"{value:+.4g}"

    parts = []
    for one in state.metrics:
        low, high = one.interval
        parts.append(f"{one.metric} {bound(low)} to {bound(high)} {one.answer}")
    scenes = plural(state.n_scenes, "scene").replace("\u00a0", " ")
    return f"{scenes}, {rollouts} of at most {ceiling} rollouts: {'; '.join(parts)}"


def make_progress(quiet: bool) -> Silent | Lines | Bar:
    """Choose how to show progress on standard error."""
    if quiet:
        return Silent()
    return Bar() if sys.stderr.isatty() else Lines()


def headline(plan: RunPlan, root: Path, threads: Threads) -> str:
    """Return one line with the size of the run, its workers and its folder, and one per fixer."""
    axes = (
        plural(len(plan.renderers), "renderer"),
        plural(len(plan.policies), "policy", "policies"),
        plural(len(plan.scenarios), "scene"),
        plural(len(plan.seeds), "seed"),
    )
    cores = f"{plural(threads.workers, 'worker')} x {plural(threads.per_worker, 'thread')}"
    line = (
        f"{plural(len(plan.cells), 'rollout')} ({' x '.join(axes)}), {cores}".replace("\u00a0", " ")
        + f" -> {root}"
    )
    return "\n".join([line, *fixer_labels(plan), *varied_lines(plan), *background_lines(plan)])


def background_lines(plan: RunPlan) -> list[str]:
    """Return what the planning has noted about scenes with a background file: where it stands, and
    what it replaces.
    """
    return [
        f"{name}: {note}"
        for name, s in plan.scenarios.items()
        if s.background
        for note in s.notes
        if note.startswith("background ")
    ]


def varied_lines(plan: RunPlan) -> list[str]:
    """Return one line per scene whose numbers are not those in its file: what the scene seed has
    made of them.
    """
    lines = []
    for name, scenario in list(plan.scenarios.items()):
        changes = [
            f"{key} {_value(old)} -> {_value(new)}" for key, (old, new) in scenario.varied.items()
        ]
        if changes:
            more = (
                f", and {len(changes) - SHOWN_CHANGES} more in run.json"
                if len(changes) > SHOWN_CHANGES
                else ""
            )
            lines.append(
                f"{name}: scene seed {scenario.seed} varies {', '.join(changes[:SHOWN_CHANGES])}{more}"
            )
    hidden = len(lines) - SHOWN_SCENES
    return (
        lines
        if hidden <= 0
        else [
            *lines[:SHOWN_SCENES],
            f"{plural(hidden, 'more scene')} with varied numbers: see run.json",
        ]
    )


def _value(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def fixer_labels(plan: RunPlan) -> list[str]:
    """Return one line per fixer: label, with the origin of its weights, and mode."""
    named = [(spec.name, spec.fixer) for spec in plan.renderers if spec.fixer is not None]
    return [
        ", ".join(
            filter(None, (f"{name}: {fixer.label}", getattr(fixer.settings, "loop_mode", "")))
        )
        for name, fixer in named
    ]


def describe(manifest: dict[str, Any], reused: bool) -> str:
    """Return one line with a rollout's result."""
    cell = (
        f"{manifest['renderer']} {manifest['policy']} {manifest['scene']} seed {manifest['seed']}"
    )
    if manifest["status"] != "ok":
        return (
            f"{cell}: FAILED ({manifest['error']['failure_class']}) {manifest['error']['message']}"
        )
    events = (
        ", ".join(
            dict.fromkeys(event_words(event["metric"]) for event in manifest.get("events", []))
        )
        or NO_OUTCOME
    )
    return f"{cell}: {events}" + (" (reused)" if reused else f", {manifest['wall_s']:.1f} s")
