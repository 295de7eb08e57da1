"""The work behind ``simrun train arms`` as tasks: stages to train, and choices between learning
rates, each after what it needs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from alpasim_plugin.core.atomic import write_json
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.reading import parsing, read_json_object
from alpasim_plugin.lab.bench.arm_choice import Choice, Score, choose, take, write_card
from alpasim_plugin.lab.training.arms.plan import (
    INITIAL,
    Plan,
    Training,
    comparison,
    training_names,
)
from alpasim_plugin.lab.training.arms.run import ArmsRun, train
from alpasim_plugin.runs.executors.local import Send

SWEEP = "sweep"
DOING = "training the arms"


class Updated(NamedTuple):
    """An update of a stage was made."""

    step: int
    loss: float
    s: float  # wall clock


class Trained(NamedTuple):
    """A stage is finished."""

    path: Path


@dataclass(frozen=True)
class Sweep:
    """Learning rates that every arm is trained with.

    Args:
        rates: Of the last stage.
        steps: U of the candidates; None: they are trained in full, and the best is the arm.
        clips: At most so many that they are judged on.
    """

    rates: tuple[float, ...]
    steps: int | None = None
    clips: int | None = None


@dataclass(frozen=True)
class StageTask:
    """Train one stage.

    Args:
        run: Shared options.
        training: Which.
        after: Tasks before it.
        name: Its folder.
        peak_lr: Instead of the run's.
        steps: U, instead of the run's.
        chosen: Whether the rate is the one that a sweep chose.
    """

    run: ArmsRun
    training: Training
    after: tuple[str, ...]
    name: str
    peak_lr: float | None = None
    steps: int | None = None
    chosen: bool = False

    @property
    def updates(self) -> int:
        """How many it has in all."""
        initial = self.training.recipe.name in INITIAL.values()
        unit = (
            self.run.initial.steps
            if initial
            else self.run.schedule.steps
            if self.steps is None
            else self.steps
        )
        return self.training.stage.updates(unit)


@dataclass(frozen=True)
class ChoiceTask:
    """Choose an arm's learning rate.

    Args:
        run: Shared options.
        arm: Its name.
        after: The candidates.
        name: Of the arm where the best candidate becomes it, else of the sweep.
        sweep: The rates.
    """

    run: ArmsRun
    arm: str
    after: tuple[str, ...]
    name: str
    sweep: Sweep


def tasks_of(
    run: ArmsRun, plan: Plan, sweep: Sweep | None, rates: Mapping[str, float] | None = None
) -> Iterator[StageTask | ChoiceTask]:
    """Yield the tasks of a plan, every one behind those it depends on.

    With a sweep, an arm's last stage has a candidate for each rate, from the same stages before it.
    What starts from an arm starts from the best of them.

    Args:
        run: Shared options.
        plan: What is trained.
        sweep: Rates to choose from; None: no choice.
        rates: Instead of a sweep, peak rates by training, as the whole comparison names them;
            others have the run's.
    """
    names = training_names(comparison())
    for training in plan.trainings:
        name = training.name
        if sweep is None or not training.is_last or training.recipe.name in INITIAL.values():
            known = names.get((training.recipe.name, training.stage.name), name)
            yield StageTask(run, training, training.after, name, (rates or {}).get(known))
            continue
        candidates = tuple(candidate_name(name, rate) for rate in sweep.rates)
        for rate, candidate in zip(sweep.rates, candidates, strict=True):
            yield StageTask(run, training, training.after, candidate, rate, sweep.steps)
        whole = sweep.steps is None
        yield ChoiceTask(run, name, candidates, name if whole else choice_name(name), sweep)
        if not whole:
            yield StageTask(run, training, (*training.after, choice_name(name)), name, chosen=True)


def candidate_name(arm: str, rate: float) -> str:
    """Return the folder of an arm trained with a rate."""
    return f"{SWEEP}/{arm}@{rate:g}"


def choice_name(arm: str) -> str:
    """Return where the choice of an arm's rate is kept, without its suffix."""
    return f"{SWEEP}/{arm}"


def work(task: StageTask | ChoiceTask, send: Send) -> None:
    """Do one task; what is done already is left as it is.

    Raises:
        InputError: A folder that was begun with other options.
    """
    if isinstance(task, ChoiceTask):
        send(_choose(task))
        return
    folder = task.run.out / task.name
    rate = task.peak_lr
    choice = None
    record = _record(task.run, task.training.name)
    if task.chosen:
        choice = read_choice(record)
        rate = choice.rate
    elif task.name == task.training.name and record.exists():
        raise InputError(
            f"{folder}: its learning rate was chosen by a sweep ({record.name})",
            "give the same --sweep, or another folder",
        )

    def report(step: int, numbers: Mapping[str, float]) -> None:
        send(Updated(step, numbers["loss"], numbers["s"]))

    path = train(task.run, task.training, task.name, rate, task.steps, report)
    if choice is not None:
        write_card(folder, folder, choice)
    send(Trained(path))


def _choose(task: ChoiceTask) -> Choice:
    run, folders = (
        task.run,
        {rate: task.run.out / candidate_name(task.arm, rate) for rate in task.sweep.rates},
    )
    choice = choose(
        folders,
        run.data,
        run.out / SWEEP / "quality" / task.arm,
        task.sweep.clips,
        run.batches.seed,
    )
    if task.name == task.arm:
        take(folders[choice.rate], run.out / task.arm, choice)
    write_json(_record(run, task.arm), choice.facts())
    return choice


def _record(run: ArmsRun, arm: str) -> Path:
    return run.out / f"{choice_name(arm)}.json"


def read_choice(path: Path) -> Choice:
    """Read what a sweep chose.

    Raises:
        InputError: No such file, or another one.
    """
    found = read_json_object(path)
    with parsing(path, "remove it and start the command again", "not a choice of a rate"):
        scores = {
            float(rate): Score(*(float(value) for value in values.values()))
            for rate, values in found["scores"].items()
        }
        return Choice(float(found["rate"]), scores, tuple(found["clips"]))


def chosen_rates(folder: Path) -> dict[str, float]:
    """Return the rates that a sweep chose, by arm.

    Raises:
        InputError: No sweep was made there, or a record that is not whole.
    """
    records = sorted((folder / SWEEP).glob("*.json"))
    if not records:
        raise InputError(
            f"--rates {folder}: no rates that a sweep chose",
            "name a folder of 'simrun train arms --sweep RATES'",
        )
    return {path.stem: read_choice(path).rate for path in records}
