"""The gate's self-test: drive deliberately broken renderers in closed loop and check that the gate catches each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from alpasim_plugin.plugins.parts import names
from alpasim_plugin.run_folder.sides import Row
from alpasim_plugin.runtime.plan import RunOptions, make_plan
from alpasim_plugin.runtime.run import Progress, execute_run
from evaluators.metrics.presets import DEFAULT
from evaluators.opening import read_run
from evaluators.statistics.baselines import rows_of_run
from evaluators.statistics.gate import GateSpec, GateVerdict, judge
from evaluators.statistics.verdicts import Outcome, outcome_of_failures, worst
from scenarios.suite import load_suite

SUITE = "suites/gate_self_test"
POLICY = "lane-camera"  # the shipped policy that drives from camera frames
REFERENCE = "clean"
CONTROL = "clean, other noise"
SEED, OTHER_SEED = 0, 1


@dataclass(frozen=True)
class Trial:
    """The gate's verdict on one renderer, and whether it is right."""

    renderer: str
    is_broken: bool
    verdict: GateVerdict

    @property
    def is_right(self) -> bool:
        """Return whether a broken renderer is caught, or the control is not called worse."""
        return (self.verdict.outcome.cause == "regression") == self.is_broken

    @property
    def caught_by(self) -> list[str]:
        """Name the metrics whose rule was broken."""
        return [check.metric for check in self.verdict.checks if check.cause == "regression"]

    def as_dict(self) -> dict[str, Any]:
        """Return the trial for JSON."""
        facts = {"renderer": self.renderer, "is_broken": self.is_broken, "is_right": self.is_right, "caught_by": self.caught_by}
        return facts | {"verdict": self.verdict.as_dict()}


@dataclass(frozen=True)
class SelfTest:
    """All trials and their outcome."""

    trials: tuple[Trial, ...]
    outcome: Outcome
    root: Path


def broken_renderers() -> list[str]:
    """Return the registered renderers with a deliberate fault."""
    return [name for name in names("renderer") if name.startswith("broken-")]


def run_self_test(spec: GateSpec, root: Path, workers: int | None, command: Sequence[str], progress: Callable[[], Progress]) -> SelfTest:
    """Drive the suite behind the reference and every broken renderer and judge each pair by the gate.

    The gate's rules apply unchanged, except that the reference is `REFERENCE` and that ``min_scenes`` is at most the suite's size. As a
    control the reference is compared with itself under another seed: a gate that fails everything fails its test.

    Args:
        spec: The gate under test.
        root: Run folder; finished rollouts in it are reused.
        workers: As for a run.
        command: Written to run.json.
        progress: Creates a progress display, once for each of the two runs.
    """
    broken = broken_renderers()
    options = RunOptions(preset=spec.preset or DEFAULT, baseline=REFERENCE)
    plan = make_plan(load_suite(SUITE), [REFERENCE, *broken], [POLICY], [SEED], options)
    control = make_plan(load_suite(SUITE), [REFERENCE], [POLICY], [OTHER_SEED], options)
    runs = [(plan, root), (control, root / "control")]
    results = [execute_run(one, folder, workers, command, progress(), certificate="none") for one, folder in runs]
    rows = rows_of_run(read_run(root))
    # The rollouts of the other seed get the first seed, so that they are paired with its rollouts.
    again = [{**row, "renderer": CONTROL, "seed": SEED} for row in rows_of_run(read_run(root / "control"))]
    trials = [Trial(name, True, _judge(spec, rows, name, len(plan.scenarios))) for name in broken]
    trials.append(Trial(CONTROL, False, _judge(spec, [*rows, *again], CONTROL, len(plan.scenarios))))
    failed = worst([outcome_of_failures(result.summary["failures"]) for result in results])
    if failed.cause != "pass":
        return SelfTest(tuple(trials), failed, root)
    wrong = [trial for trial in trials if not trial.is_right]
    reasons = tuple(f"{t.renderer} is {'not caught' if t.is_broken else 'wrongly called worse'}" for t in wrong)
    return SelfTest(tuple(trials), Outcome("regression" if wrong else "pass", reasons), root)


def _judge(spec: GateSpec, rows: Sequence[Row], name: str, n_scenes: int) -> GateVerdict:
    fields = {"renderers": (name,), "baseline": REFERENCE, "min_scenes": min(spec.min_scenes, n_scenes), "max_failed": 0.0}
    only = [row for row in rows if row["renderer"] in (REFERENCE, name)]
    return judge(only, spec.model_copy(update=fields))
