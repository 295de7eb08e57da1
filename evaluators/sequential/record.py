"""``decision.json``: the question, every look, and the answer of a run that was driven until it was decided."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NotRequired

from typing_extensions import TypedDict

from alpasim_plugin.io.checksums import read_sealed, write_sealed
from alpasim_plugin.io.reading.files import as_shape
from evaluators.sequential.decision import State
from evaluators.sequential.question import METHOD_NAMES, Question

DECISION = "decision.json"
SCHEMA_VERSION = 1
DOING = "reading a decision"
AGAIN = "give the command of the run again: finished rollouts are kept"


class MetricAsked(TypedDict):
    """One metric of the question."""

    margin: float  # in the metric's unit
    threshold: float  # difference at which the answer changes, positive is worse
    expected: float | None  # expected difference, positive is worse
    binding: bool
    method: str  # betting or asymptotic
    guarantee: str


class Asked(TypedDict):
    """The question."""

    asked: str  # non-inferior or better
    population: str  # scenes or suite
    alpha: float  # chance of a wrong decision over all looks
    rule: str  # how several metrics are joined
    min_scenes: int
    first_look: int
    metrics: dict[str, MetricAsked]


class MetricLook(TypedDict):
    """One metric at one look."""

    verdict: str
    n_scenes: int
    diff: float | None
    interval: list[float | None]  # each end holds over all looks with probability 1 - alpha
    e_good: float
    e_bad: float


class Look(TypedDict):
    """One look."""

    n_scenes: int
    rollouts: int
    seeds: int  # of the scenes driven since the look before
    answer: str  # good, bad or open
    metrics: dict[str, MetricLook]


class Decision(TypedDict):
    """The file."""

    schema_version: int
    question: Asked
    candidate: str
    baseline: str
    policy: str
    order_seed: int
    look_every: int
    ceiling: dict[str, int]  # scenes, rollouts
    seeds: dict[str, Any]  # how many a scene and why
    controls: dict[str, Any]  # what takes out variance, by metric
    drawn: NotRequired[dict[str, Any]]  # order: random (where absent) or stratified, then the number of scenes of each family
    order: list[str]  # scenes driven, in their order
    looks: list[Look]
    verdict: str
    stopped: str  # why no more scenes are driven; empty while the run goes on
    outcome: dict[str, Any]
    rollouts: int


def question_as_dict(question: Question) -> Asked:
    """Return a question for JSON."""
    return {
        "asked": question.metrics[0].asked,
        "population": question.population,
        "alpha": question.alpha,
        "rule": question.rule,
        "min_scenes": question.min_scenes,
        "first_look": question.first_look,
        "metrics": {
            one.metric: {
                "margin": one.margin,
                "threshold": one.threshold,
                "expected": one.expected,
                "binding": one.binding,
                "method": one.method,
                "guarantee": METHOD_NAMES[one.method],
            }
            for one in question.metrics
        },
    }


def look_as_dict(state: State, rollouts: int, seeds: int) -> Look:
    """Return a look for JSON."""
    metrics: dict[str, Any] = {one.metric: one.as_dict() for one in state.metrics}
    return {"n_scenes": state.n_scenes, "rollouts": rollouts, "seeds": seeds, "answer": state.answer, "metrics": metrics}


def write_decision(root: Path, decision: Decision) -> None:
    """Write ``decision.json`` with its seal.

    Raises:
        InfrastructureError: The disk refuses.
    """
    write_sealed(root / DECISION, decision, "writing a decision")


def stopping_note(root: Path) -> str | None:
    """Say that the intervals of a fixed number of scenes do not hold for a run that stopped when it was decided; None of any other run."""
    if read_decision(root) is None:
        return None
    return f"note: {root} was driven until it was decided: only the intervals of {DECISION} and of the report's first section hold for it"


def read_decision(root: Path) -> Decision | None:
    """Read ``decision.json`` of a run folder; None where the run was no decision.

    Raises:
        InputError: It is damaged.
    """
    path = root / DECISION
    if not path.exists():
        return None
    found, _ = read_sealed(path, DOING, AGAIN)
    shaped: Mapping[str, Any] = as_shape(Decision, found, path, DOING, AGAIN)
    return shaped  # type: ignore[return-value]
