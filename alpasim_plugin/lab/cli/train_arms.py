"""``simrun train arms``: every arm of the paper's comparison, with the stages that arms have in
common trained once.
"""

from __future__ import annotations

import json
import math
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.signals import Stopped
from alpasim_plugin.lab.bench.arm_choice import Choice
from alpasim_plugin.lab.bench.trained_arms import trained_arms
from alpasim_plugin.lab.cli import training_options as options
from alpasim_plugin.lab.cli.arms_tasks import (
    ChoiceTask,
    StageTask,
    Sweep,
    Trained,
    Updated,
    chosen_rates,
    tasks_of,
    work,
)
from alpasim_plugin.lab.cli.image_sizes import parse_size
from alpasim_plugin.lab.cli.train_fixer import PRECISIONS, named_weights
from alpasim_plugin.lab.paper.training import edge_of, training_table
from alpasim_plugin.lab.training.arms.budget import in_equal_time, related
from alpasim_plugin.lab.training.arms.plan import comparison, plan, training_names
from alpasim_plugin.lab.training.arms.run import ArmsRun, probe, write_plan
from alpasim_plugin.lab.training.clip_batches import BatchForm
from alpasim_plugin.lab.training.latent_clips import ClipForm
from alpasim_plugin.lab.training.recipes.appearance import APPEARANCE
from alpasim_plugin.lab.training.recipes.recipe import Recipe
from alpasim_plugin.lab.training.recipes.registry import with_perceptual_weight
from alpasim_plugin.lab.training.trainer import Schedule
from alpasim_plugin.lab.video_metrics.image_distance import distance_for_training
from alpasim_plugin.runs.executors.local import run_dependent

EVERY_S = 20.0  # between lines of progress
SHORT_S = 120.0  # a time left that is given in seconds
EPILOG = """
Examples:

- `simrun train arms data/pairs --size 256x144 --vae vae.safetensors --out runs/arms --steps 400 --jobs 2`

- `simrun train arms data/pairs --size 256x144 --vae vae.safetensors --out runs/arms-60 --budget minutes --minutes 60`

- `simrun train arms data/pairs --size 256x144 --vae vae.safetensors --out runs/arms-60 --budget minutes --minutes 60 --rates runs/swept`

- `simrun train arms data/pairs --size 256x144 --vae vae.safetensors --out runs/swept --sweep 1e-4,3e-4,1e-3 --sweep-steps 50`
"""


def arms(
    data: options.Pairs,
    vae: Annotated[
        Path,
        typer.Option(
            "--vae", help="Trained autoencoder ('simrun train vae'), or a fixer's bundle."
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", help="Folder of the arms; the same command resumes it.")
    ],
    scenes: Annotated[
        Path | None,
        typer.Option("--scenes", help="Folder of the pairs' scenes; the arm appearance needs it."),
    ] = None,
    only: Annotated[
        str | None,
        typer.Option("--only", help="Comma-separated arms; by default all of docs/lab/arms.md."),
    ] = None,
    weights: Annotated[
        list[str] | None,
        typer.Option(
            "--weights",
            help="base=FILE or base-bi=FILE: an initial network that is not trained. Repeatable.",
        ),
    ] = None,
    size: options.Size = None,
    steps: options.Unit = 400,
    base_steps: Annotated[
        int, typer.Option("--base-steps", min=1, help="Updates of base and of base-bi.")
    ] = 400,
    base_lr: Annotated[
        float, typer.Option("--base-lr", min=1e-7, help="Peak learning rate of base and base-bi.")
    ] = 1e-3,
    budget: Annotated[
        Literal["updates", "minutes"],
        typer.Option(
            "--budget", help="Updates as in the paper; or equal core-minutes for every arm."
        ),
    ] = "updates",
    minutes: Annotated[
        float | None,
        typer.Option("--minutes", min=0.01, help="Core-minutes of every arm, all of its stages."),
    ] = None,
    probe_updates: Annotated[
        int,
        typer.Option("--probe-updates", min=5, help="Updates of every stage that are timed first."),
    ] = 20,
    sweep: Annotated[
        str | None,
        typer.Option(
            "--sweep", help="Learning rates, comma-separated: the best on split val is the arm."
        ),
    ] = None,
    sweep_steps: Annotated[
        int | None,
        typer.Option("--sweep-steps", min=1, help="U of the candidates; then the best in full."),
    ] = None,
    sweep_clips: Annotated[
        int | None, typer.Option("--sweep-clips", min=1, help="At most so many clips to choose by.")
    ] = None,
    rates: Annotated[
        Path | None,
        typer.Option(
            "--rates",
            help="Folder of arms with a sweep: every arm has the learning rate that was chosen there.",
        ),
    ] = None,
    clips: options.Clips = 4,
    accumulate: options.Accumulate = 2,
    latents: options.Latents = 12,
    columns: options.Columns = None,
    stride: options.Stride = 24,
    lr: options.PeakLr = 2e-4,
    ema: options.Ema = 0.99,
    perceptual: options.Perceptual = 10.0,
    channels: options.Channels = "amplitude",
    precision: options.Precision = "fp32",
    snapshots: options.Snapshots = 8,
    jobs: Annotated[
        int,
        typer.Option("--jobs", min=1, help="Stages at a time, each in a process with one thread."),
    ] = 1,
    threads: Annotated[
        int, typer.Option("--threads", min=1, help="Torch threads, with one job.")
    ] = 1,
    seed: options.Seed = 0,
    metric_weights: options.MetricWeights = None,
    as_json: options.AsJson = False,
    debug: options.Debug = False,
) -> None:
    """Train the systems of the paper's comparison into OUT/NAME, every stage that several have
    once; 'simrun bench paper' measures them.
    """
    del debug
    if jobs > 1 and threads > 1:
        raise InputError(
            f"--jobs {jobs} --threads {threads}: several threads in several processes",
            "leave one of them out",
        )
    if (minutes is None) == (budget == "minutes"):
        found = (
            "minutes without a number"
            if minutes is None
            else "a number of minutes for a budget of updates"
        )
        raise InputError(f"--budget {budget}: {found}", "write --budget minutes --minutes 60")
    options.use_threads(threads)
    schedule = Schedule(steps, peak_lr=lr, accumulate=accumulate, ema=ema).of_length(steps)
    run = ArmsRun(
        data,
        vae,
        out,
        ClipForm(latents, stride),
        BatchForm(clips, None, columns, seed),
        schedule,
        replace(schedule, peak_lr=base_lr).of_length(base_steps),
        named_weights(None, weights or []),
        channels == "equal",
        PRECISIONS[precision],
        snapshots,
        metric_weights,
        scenes,
        None if size is None else parse_size(size),
    )
    recipes = tuple(with_perceptual_weight(recipe, perceptual) for recipe in comparison())
    telling = Telling()
    chosen = (
        [recipe.name for recipe in recipes]
        if only is None
        else [name.strip() for name in only.split(",") if name.strip()]
    )
    if only is None and scenes is None:
        chosen.remove(APPEARANCE.name)
        telling.say(
            f"{APPEARANCE.name} is left out: its targets need the depth of the scenes; give --scenes for it"
        )
    swept = None if sweep is None else Sweep(rates_of(sweep), sweep_steps, sweep_clips)
    if swept is None and (sweep_steps, sweep_clips) != (None, None):
        raise InputError(
            "--sweep-steps, --sweep-clips: no rates to choose from",
            "give --sweep 1e-4,3e-4,1e-3",
        )
    if swept is not None and rates is not None:
        raise InputError(
            "--sweep, --rates: rates to choose from, and chosen ones",
            "leave one of them out",
        )
    known = {} if rates is None else chosen_rates(rates)
    planned = plan(recipes, chosen, run.given)
    telling.say(f"perceptual term: {distance_for_training(metric_weights)[0]}")
    run.clips(telling.encoded)
    if minutes is not None:
        recipes = equal_time(run, recipes, chosen, minutes, probe_updates, telling)
        planned = plan(recipes, chosen, run.given)
    write_plan(run, planned, {"budget": budget, "minutes": minutes})
    tasks = list(tasks_of(run, planned, swept, known))
    telling.begin(tasks, jobs)
    try:
        run_dependent(work, tasks, jobs, telling.heard)
    except Stopped as stopped:
        stopped.kept = f"{out} keeps finished stages and the last checkpoint of those begun; the same command resumes"
        raise
    trained = trained_arms(out, planned.arms)
    telling.say(training_table(trained))
    if as_json:
        print(
            json.dumps(
                {
                    "arms": [
                        {**asdict(arm), "weights": str(run.bundle_of(arm.arm))} for arm in trained
                    ]
                }
            )
        )


def equal_time(
    run: ArmsRun,
    recipes: Sequence[Recipe],
    chosen: Sequence[str],
    minutes: float,
    updates: int,
    telling: Telling,
) -> tuple[Recipe, ...]:
    """Return the recipes with equal core-minutes, their updates timed where they are not yet."""
    mine = related(recipes, chosen)
    names = training_names(recipes)
    wanted = {names[recipe.name, stage.name] for recipe in mine for stage in recipe.stages}
    trainings = [
        one
        for one in plan(recipes, [recipe.name for recipe in recipes]).trainings
        if one.name in wanted
    ]
    seconds = probe(
        run,
        trainings,
        updates,
        lambda name, s: telling.say(f"{name}: {s:.3g} core-seconds an update"),
    )
    return in_equal_time(mine, names, seconds, minutes, run.schedule.steps)


def rates_of(text: str) -> tuple[float, ...]:
    """Return the learning rates of a sweep.

    Raises:
        InputError: Not at least two different positive numbers.
    """
    try:
        rates = tuple(float(part) for part in text.split(","))
    except ValueError:
        rates = ()
    if (
        len(rates) < 2
        or len(set(rates)) != len(rates)
        or not all(0 < rate < math.inf for rate in rates)
    ):
        raise InputError(
            f"--sweep {text}: not at least two different learning rates",
            "write for example --sweep 1e-4,3e-4,1e-3",
        )
    return rates


class Telling:
    """Progress on standard error: stages, losses, and the time left."""

    def __init__(self) -> None:
        self.console, self.last_s = Console(stderr=True), time.monotonic()
        self.total: dict[str, int] = {}  # updates by stage
        self.updates: dict[str, int] = {}  # of unfinished stages: those still to make
        self.made: dict[str, int] = defaultdict(int)  # updates of this process
        self.trainings: dict[str, str] = {}  # by stage; the candidates of a sweep are one training
        self.latents: dict[str, int] = {}  # of a clip, by training
        self.taken: dict[str, list[float]] = defaultdict(list)  # seconds of updates, by training
        self.stages = self.jobs = 0

    def say(self, text: str) -> None:
        """Print a line as it is."""
        self.console.print(text, highlight=False, markup=False, soft_wrap=True)

    def encoded(self, done: int, count: int) -> None:
        """Report the encoding of clips."""
        if done == count or time.monotonic() - self.last_s > EVERY_S:
            self.last_s = time.monotonic()
            self.say(f"clips as latents, sequences: {done}/{count}")

    def begin(self, tasks: Sequence[StageTask | ChoiceTask], jobs: int) -> None:
        """Take the stages, and name those in another precision than the run's."""
        self.jobs = jobs
        stages = [task for task in tasks if isinstance(task, StageTask)]
        self.updates = {task.name: task.updates for task in stages}
        self.trainings = {task.name: task.training.name for task in stages}
        self.latents = {
            task.training.name: task.training.stage.latents or task.run.form.latents
            for task in stages
        }
        self.total, self.stages = dict(self.updates), len(self.updates)
        self.say(f"{self.stages} stages, {sum(self.updates.values())} updates")
        for task in tasks:
            if (
                isinstance(task, StageTask)
                and task.training.stage.always_float32
                and task.run.precision is not None
            ):
                self.say(f"{task.name} is trained in float32, whatever --precision says")

    def heard(self, name: str, said: Any) -> None:
        """Report what a task says."""
        if isinstance(said, Updated):
            of = self.total[name]
            self.taken[self.trainings[name]].append(said.s)
            self.made[name] += 1
            self.updates[name] = of - said.step
            if time.monotonic() - self.last_s > EVERY_S:
                self.last_s = time.monotonic()
                self.say(f"{name} {said.step}/{of}, loss {said.loss:.4g}; {self._left()}")
        elif isinstance(said, Trained):
            made = self.made[name]
            self.updates.pop(name)
            done = self.stages - len(self.updates)
            self.say(
                f"[{done}/{self.stages}] {name}: {f'{made} updates' if made else 'was finished'}; {self._left()}"
            )
        elif isinstance(said, Choice):
            scores = "; ".join(f"{rate:g}: {score}" for rate, score in said.scores.items())
            edge = edge_of(said.rate, said.scores)
            beyond = (
                "" if edge is None else f": the {edge} of the sweep, a better one may lie beyond it"
            )
            self.say(
                f"{name}: learning rate {said.rate:g} is the best ({scores}; {len(said.clips)} clips of val){beyond}"
            )

    def _left(self) -> str:
        if not self.updates:
            return "nothing left"
        left: dict[str, int] = defaultdict(int)
        for name, count in self.updates.items():
            left[self.trainings[name]] += count
        left_s = seconds_left(left, self.latents, self.taken)
        if left_s is None:
            return "time left not known yet"
        left_s /= self.jobs
        return (
            f"about {left_s:.0f} s left"
            if left_s < SHORT_S
            else f"about {left_s / 60:.0f} min left"
        )


def seconds_left(
    updates: Mapping[str, int], latents: Mapping[str, int], taken: Mapping[str, Sequence[float]]
) -> float | None:
    """Return the time that updates of several trainings will take; None while none has been timed.

    A training without an update yet is taken to need the others' mean time for each latent of its
    clips: an update of an image arm, whose clips have one latent, is a tenth of a video arm's.

    Args:
        updates: Still to make, by training.
        latents: Of a clip, by training.
        taken: Seconds of the updates made, by training.
    """
    means = {one: sum(times) / len(times) for one, times in taken.items() if times}
    if not means:
        return None
    of_latent = sum(mean / latents[one] for one, mean in means.items()) / len(means)
    return sum(means.get(one, of_latent * latents[one]) * count for one, count in updates.items())
