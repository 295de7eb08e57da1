"""What verbs print: results on standard output, progress and warnings on standard error."""

from __future__ import annotations

import os
import shlex
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any

from rich import progress
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.table import Table

from alpasim_plugin.core.escape import terminal
from alpasim_plugin.core.files.stage import stages_in
from alpasim_plugin.core.json_types import JsonView
from alpasim_plugin.core.printing import say, say_document
from alpasim_plugin.core.printing import warn as warn
from alpasim_plugin.log.run_folder.records import Manifest
from alpasim_plugin.log.run_folder.schema import STAGES
from evaluators.statistics.numbers import duration, plural

if TYPE_CHECKING:  # verbs that only read a run load neither the loop nor its kernels
    from alpasim_plugin.core.types import Scenario
    from alpasim_plugin.runs.execute import Threads
    from alpasim_plugin.runs.plan import RunPlan
    from evaluators.statistics.decision import State
    from evaluators.statistics.opening import Run

SHOWN_CHANGES = 4
SHOWN_SCENES = 5
MAX_LINES = 1000  # of finished rollouts on a pipe
MOST_LETTERS = 1000  # of a table that is measured
LARGE_PX = 1_000_000  # of the cameras of a scene, from which on a run says what they cost
PX_PER_S = 5e6  # that one core draws of a built scene, within a factor of two
LINE_EVERY_S = 10.0  # on a pipe, within one stage


def show(as_json: bool, facts: JsonView, *lines: Any) -> None:
    """Print a result: its facts as one JSON document, or lines of text and tables of rich."""
    if as_json:
        say_document(facts)
        return
    for line in lines:
        if isinstance(line, str):
            say(line)
        else:
            Console(emoji=False).print(Escaped(line))


class Escaped:
    """A table or a page of rich in which no text makes a terminal act; its own styles do.

    Args:
        inner: What rich prints.
    """

    def __init__(self, inner: RenderableType) -> None:
        self.inner = inner

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the segments of what is printed, each with its text escaped."""
        for segment in console.render(self.inner, options):
            lines = segment.text.split("\n")
            text = segment.text if segment.control else "\n".join(map(terminal, lines))
            yield segment._replace(text=text)


def first_screen(run: Run) -> list[Any]:
    """Return the one table of a run as lines for `show`."""
    from evaluators.pages.overview import overview_of
    from evaluators.pages.terminal import overview_lines

    return list(overview_lines(overview_of(run), terminal_width()))


def terminal_width() -> int:
    """Return how many letters fit on a line of standard output, 80 where it is no terminal."""
    return Console().width


def letters_of(table: Table) -> int:
    """Return how many letters a line of a table takes where nothing is folded."""
    return Console(width=MOST_LETTERS).measure(table).maximum


KERNELS_NOTE = ", which compiles kernels once"
PACE_STEPS = 20  # of a long stage, by which its time is estimated
LONG_STEPS = 200
LONG_S = 60.0


@dataclass
class Pace:
    """How fast a stage begins.

    Attributes:
        first: How much was done when it was first seen.
        began_s: When that was.
        is_said: Whether its estimate was given.
    """

    first: int
    began_s: float
    is_said: bool = False

    def estimate(self, stage: str, done: int, total: int, now_s: float) -> str:
        """Return how long a stage of many steps will take, once `PACE_STEPS` are done; empty before
        and after, and where it is short.

        Example:
            >>> pace = Pace(0, 10.0)
            >>> pace.estimate("fitting", 20, 3000, 20.0)
            'fitting: 3000 steps, about 25 min at the pace of the first 20; later ones may be slower'
            >>> pace.estimate("fitting", 21, 3000, 20.5)
            ''
        """
        steps = done - self.first
        if self.is_said or steps < PACE_STEPS or total - self.first < LONG_STEPS:
            return ""
        self.is_said = True
        whole_s = (now_s - self.began_s) / steps * (total - self.first)
        if whole_s < LONG_S:
            return ""
        span = duration(whole_s).replace("\u00a0", " ")
        return (
            f"{stage}: {total - self.first} steps, about {span} at the pace of the first {steps}; "
            f"later ones may be slower"
        )


class Progress(progress.Progress):
    """Progress on standard error: a bar on a terminal, lines on a pipe; silent, only warnings."""

    def __init__(self, silent: bool = False) -> None:
        console = Console(stderr=True, highlight=False, markup=False, emoji=False, soft_wrap=True)
        super().__init__(
            progress.TextColumn("{task.description}", markup=False),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TimeElapsedColumn(),
            progress.TimeRemainingColumn(),
            console=console,
            transient=True,
            disable=silent or not console.is_terminal,
        )
        self.silent = silent
        self.printed_s = time.monotonic()
        self.kernels_named = False  # that they are compiled is said once
        self.paces: dict[str, Pace] = {}

    def say(self, text: str) -> None:
        """Print a line above the bar."""
        if not self.silent:
            self.console.print(terminal(text))

    def show(self, stage: str, done: int, total: int | None) -> None:
        """Show how much of a stage is done; on a pipe when it begins, and every ten seconds."""
        is_new = not self.tasks or self.tasks[-1].description != stage
        if is_new:
            self.add_task(stage)
        task = self.tasks[-1]
        self.update(task.id, completed=done, total=total)
        now_s = time.monotonic()
        pace = self.paces.setdefault(stage, Pace(done, now_s))
        if total is not None and (sentence := pace.estimate(stage, done, total, now_s)):
            self.say(sentence)
        if self.disable and (is_new or now_s - self.printed_s > LINE_EVERY_S):
            self.printed_s = now_s
            whole = "" if total is None else f"/{total}"
            left = task.time_remaining
            self.say(f"{stage} {done}{whole}" + (f", about {left:.0f} s left" if left else ""))

    def started(self, plan: RunPlan, root: Path, threads: Threads) -> None:
        """Announce a run."""
        for line in headline(plan, root, threads):
            self.say(line)
        self.add_task("rollouts", total=len(plan.cells))
        if not self.silent:
            Thread(target=self.watch, args=(root / STAGES,), daemon=True).start()

    def watch(self, folder: Path) -> None:
        """Show what a worker does, until the run ends; on a pipe every ten seconds."""
        while not self.finished:
            time.sleep(1.0)
            for stated in stages_in(folder)[:1]:
                text = self.without_known(stated)
                self.update(self.tasks[-1].id, description=f"rollouts; {terminal(text)}")
                now_s = time.monotonic()
                if self.disable and now_s - self.printed_s > LINE_EVERY_S:
                    self.printed_s = now_s
                    self.say(text)

    def without_known(self, text: str) -> str:
        """Return what a worker does, without the note on kernels where it was said before."""
        if self.kernels_named:
            return text.removesuffix(KERNELS_NOTE)
        # A bar shows it as long as the stage lasts; a pipe has it in one line.
        self.kernels_named = self.disable and text.endswith(KERNELS_NOTE)
        return text

    def rollout_done(self, manifest: Manifest, reused: bool) -> None:
        """Count a rollout and print its result; on a terminal only failures."""
        task = self.tasks[-1]
        self.advance(task.id)
        self.kernels_named = True
        done = int(task.completed)
        total = int(task.total or 0)
        is_shown = done == total or done % max(1, total // MAX_LINES) == 0
        if not manifest.ok or (self.disable and is_shown):
            self.say(f"[{done}/{total}] {describe(manifest, reused)}")

    def looked(self, state: State, rollouts: int, ceiling: int) -> None:
        """Print an interim analysis: scenes, and each metric's interval and verdict."""
        scenes = plural(state.n_scenes, "scene")
        parts = []
        for name, look in state.metrics.items():
            low, high = ("unbounded" if end is None else f"{end:+.4g}" for end in look["interval"])
            parts.append(f"{name} {low} to {high} {look['verdict']}")
        self.say(f"{scenes}, {rollouts} of at most {ceiling} rollouts: {'; '.join(parts)}")

    def noticed(self, text: str) -> None:
        """Print a warning, even if silent: what is damaged, or who is waited for."""
        self.console.print(terminal(f"warning: {text}"))


def report_lines(root: Path) -> list[str]:
    """Return the lines that name a run's report and the command that replays its rollouts."""
    page = root / "report.html"
    run = shlex.quote(str(root))
    report = shlex.quote(str(page)) if os.path.exists(page) else f"not written; simrun report {run}"
    return [f"report   {report}", f"watch    simrun view {run}"]


def headline(plan: RunPlan, root: Path, threads: Threads) -> list[str]:
    """Return one line with the size of the run, its workers and its folder, and notes below it."""
    axes = (
        plural(len(plan.renderers), "renderer"),
        plural(len(plan.policies), "policy", "policies"),
        plural(len(plan.scenarios), "scene"),
        plural(len(plan.seeds), "seed"),
    )
    cores = f"{plural(threads.workers, 'worker')} x {plural(threads.per_worker, 'thread')}"
    size = f"{plural(len(plan.cells), 'rollout')} ({' x '.join(axes)}), {cores}"
    notes = [
        *fixer_labels(plan),
        *policy_notes(plan),
        *size_lines(plan),
        *varied_lines(plan),
        *background_lines(plan),
    ]
    return [f"{size} -> {root}", *notes]


def size_lines(plan: RunPlan) -> list[str]:
    """Return how much is drawn for one instant of the scene with the most pixels, where its cameras
    have a megapixel or more.
    """
    from alpasim_plugin.renderers.reconstruction_key import fit_cpu_s
    from alpasim_plugin.runs.lenses import drawn_pixels
    from scenarios.budget import memory_mb

    def pixels_of(scenario: Scenario) -> int:
        return sum(camera.width * camera.height for camera in scenario.cameras)

    largest = max(plan.scenarios.values(), key=pixels_of)
    pixels = pixels_of(largest)
    if pixels < LARGE_PX:
        return []
    pinholes, pinhole_px = drawn_pixels(largest.cameras)
    cameras = plural(len(largest.cameras), "camera")
    size = f"{cameras} of {pixels / 1e6:.1f} megapixels"
    cost = f"{pixels / PX_PER_S:.1f} CPU seconds"
    if largest.background is None and largest.model is None:
        cost += f" and {memory_mb(largest, pinhole_px) / 1e3:.1f} GB"
    line = f"{largest.scene_id}: {size}, {cost} behind clean"
    fit_min = fit_cpu_s(largest, pinholes) / 60
    if fit_min and any(spec.base.name == "3dgs" for spec in plan.renderers):
        line += f"; about {fit_min:.1f} CPU minutes to fit its model once"
    return [line]


def background_lines(plan: RunPlan) -> list[str]:
    """Return where the background file of each scene stands, and what it replaces."""
    return [
        f"{name}: {note}"
        for name, scenario in plan.scenarios.items()
        for note in scenario.notes
        if note.startswith("background ")
    ]


def varied_lines(plan: RunPlan) -> list[str]:
    """Return one line per scene whose numbers the scene seed has changed."""
    lines = []
    for name, scenario in plan.scenarios.items():
        changes = varied_numbers(scenario.varied)
        if changes:
            more = f", and {len(changes) - SHOWN_CHANGES} more" * (len(changes) > SHOWN_CHANGES)
            excerpt = ", ".join(changes[:SHOWN_CHANGES])
            lines.append(f"{name}: scene seed {scenario.seed} varies {excerpt}{more}")
    hidden = len(lines) - SHOWN_SCENES
    if hidden > 0:
        more_scenes = plural(hidden, "more scene")
        lines = [*lines[:SHOWN_SCENES], f"{more_scenes} with varied numbers: see run.json"]
    return lines


def varied_numbers(varied: Mapping[str, tuple[Any, Any]]) -> list[str]:
    """Return what the scene seed has made of the numbers of a scenario file.

    Example:
        >>> varied_numbers({"actors.0.s_m": (30.0, 31.25)})
        ['actors.0.s_m 30 -> 31.25']
    """
    texts = {
        key: [f"{value:.4g}" if isinstance(value, float) else str(value) for value in pair]
        for key, pair in varied.items()
    }
    return [f"{key} {' -> '.join(pair)}" for key, pair in texts.items()]


def fixer_labels(plan: RunPlan) -> list[str]:
    """Return one line per fixer: label, with the origin of its weights, and mode."""
    lines = []
    for spec in plan.renderers:
        if spec.fixer is not None:
            mode = getattr(spec.fixer.settings, "loop_mode", "")
            lines.append(f"{spec.name}: {spec.fixer.label}" + (f", {mode}" if mode else ""))
    return lines


def policy_notes(plan: RunPlan) -> list[str]:
    """Return a line for each thing that a policy with an address does not read of its files."""
    from alpasim_plugin.core.parts.source import load

    lines = []
    for spec in plan.policies:
        if spec.address is not None:
            factory = load(spec.target, "policy")
            notes_of = getattr(factory, "address_notes", None)
            notes = () if notes_of is None else notes_of(spec.address)
            lines += [f"{spec.name}: {note}" for note in notes]
    return lines


def describe(manifest: Manifest, reused: bool) -> str:
    """Return one line with a rollout's result."""
    names = [manifest.renderer, manifest.policy, manifest.scene]
    cell = f"{' '.join(names)} seed {manifest.seed}"
    if manifest.rollout is not None:  # of a log that is scored
        cell = f"{manifest.rollout}: {cell}"
    if not manifest.ok:
        return f"{cell}: FAILED ({manifest.failure_class})"
    from evaluators.metrics.outcomes import (
        NO_OUTCOME,
        events_in_words,
    )  # a listing needs no metrics

    events = events_in_words(manifest.events)
    cost = " (reused)" if reused else f", {manifest.wall_s:.1f} s"
    if manifest.copied_from is not None and not reused:
        cost = f" (copied from {manifest.copied_from})"
    return f"{cell}: {', '.join(events) or NO_OUTCOME}{cost}"
