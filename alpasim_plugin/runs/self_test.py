"""The self-test of a gate: drive renderers with a known fault and see whether the gate catches each."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.parts import names
from alpasim_plugin.log.run_folder.sides import RolloutTable
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.run import Progress, execute_run
from evaluators.metrics.presets import DEFAULT
from evaluators.results import Outcome
from evaluators.statistics.baselines import table_of_run
from evaluators.statistics.gate import GateSpec, GateVerdict, check_gate
from evaluators.statistics.opening import read_run
from evaluators.statistics.verdicts import outcome_of_failures, worst
from scenarios.suite import load_suite

SUITE = "suites/gate_self_test"
POLICY = "lane-camera"  # the shipped policy that drives from camera frames
REFERENCE = "clean"
CONTROL = "clean, driven again"
SEED = 0


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
        return {
            **vars(self),
            "is_right": self.is_right,
            "caught_by": self.caught_by,
            "verdict": self.verdict.as_dict(),
        }


def run_self_test(
    spec: GateSpec, root: Path, command: Sequence[str], progress: Progress
) -> tuple[list[Trial], Outcome]:
    """Drive the suite behind the reference and every broken renderer, and gate each pair.

    The gate's rules apply unchanged, except that the reference is `REFERENCE` and that the suite's
    scenes are all that is asked about, however few. As a control the reference is driven a second
    time: a gate that fails equal runs fails its test.

    Args:
        spec: The gate under test.
        root: Run folder; finished rollouts in it are reused.
        command: Written to run.json.
        progress: Shows both runs.

    Raises:
        InputError: The gate has a ``boundary_margin``, which needs a run with ``--vary``.
    """
    if spec.boundary_margin is not None:
        raise InputError(
            "--self-test: a gate with boundary_margin counts points of --vary, and the self-test "
            "drives none",
            "Test a gate with metrics.",
        )
    broken = [name for name in names("renderer") if name.startswith("broken-")]
    suite = load_suite(SUITE)
    options = RunOptions(preset=spec.preset or DEFAULT, baseline=REFERENCE)
    plan = make_plan(suite, [REFERENCE, *broken], [POLICY], [SEED], options)
    control = make_plan(suite, [REFERENCE], [POLICY], [SEED], options)
    results = [
        execute_run(plan, root, None, command, progress),
        execute_run(control, root / "control", None, command, progress),
    ]
    failed = worst([outcome_of_failures(result.summary.failures) for result in results])
    first, again = (table_of_run(read_run(folder)) for folder in (root, root / "control"))
    trials = [Trial(name, True, gate_against(first, spec, first, name)) for name in broken]
    trials.append(Trial(CONTROL, False, gate_against(again, spec, first, REFERENCE)))
    reasons = tuple(
        f"{trial.renderer} is {'not caught' if trial.is_broken else 'wrongly called worse'}"
        for trial in trials
        if not trial.is_right
    )
    if failed.cause != "pass":
        return trials, failed
    return trials, Outcome("regression" if reasons else "pass", reasons)


def gate_against(
    table: RolloutTable, spec: GateSpec, first: RolloutTable, name: str
) -> GateVerdict:
    """Decide about one renderer of a table against the reference of the first."""
    fields = {
        "renderers": (name,),
        "baseline": REFERENCE,
        "min_scenes": 1,
        "max_failed": 0.0,
        "population": "suite",
    }
    preset = spec.preset or DEFAULT
    return check_gate(table, spec.model_copy(update=fields), first, "the reference", preset=preset)
