"""A gate on boundaries: how much more of a parameter's range may fail than with the baseline."""

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.log.run_folder.sides import RolloutTable
from evaluators.results import Cause, Outcome
from evaluators.statistics.gate import Check, GateSpec, GateVerdict, failures_of
from evaluators.statistics.numbers import fixed
from evaluators.statistics.variants import base_named, short_name, usual_base, variants_in
from evaluators.statistics.verdicts import outcome_of_failures, worst

METRIC = "boundary"


def boundary_verdict(
    table: RolloutTable,
    spec: GateSpec,
    record: JsonView | None,
    stored: JsonView | None = None,
    stored_name: str = "",
) -> GateVerdict:
    """Check the boundaries, or the failing shares of a rectangle, that a search found against a
    margin.

    Args:
        table: The run's rollouts.
        spec: A gate with ``boundary_margin``.
        record: The member ``boundary`` of the run's ``summary.json``.
        stored: That of an earlier run; None: variants are compared with the run's first.
        stored_name: How to call the earlier run.

    Raises:
        InputError: A run without a search, an earlier run that searched elsewhere, or nothing to
            compare.
    """
    earlier = record if stored is None else stored
    if not record or not earlier:
        raise InputError(
            f"{stored_name if record else 'the run'}: it searched for no boundary",
            "drive it with --vary KEY=LOW..HIGH, and name the run's folder",
        )
    asked = [[one["parameter"], one["reachable"]] for one in (record, earlier)]
    if asked[0] != asked[1]:
        raise InputError(
            f"{stored_name}: it searched along {asked[1]}, the run along {asked[0]}",
            "drive both with the same --vary",
        )
    variants = variants_in(table)
    pairs = [(one, one) for one in variants if one.name in earlier["variants"]]
    if stored is None:
        named = spec.baseline and base_named(spec.baseline, variants, "the run")
        pairs = (named or usual_base(variants)).pairs(variants)
    if not pairs:
        raise InputError(
            "the boundaries: there is no variant to compare with",
            "run two renderers or two policies, or give --baseline-file",
        )
    checks = []
    for variant, other in pairs:
        label = stored_name or short_name(other, variant)
        cause, text, bounds = _checked(record, earlier, variant.name, other.name, spec)
        sentence = f"{variant.name}: {METRIC} against {label}: {text}"
        entry: JsonObject = {
            "baseline": label,
            "margin": spec.boundary_margin,
            "bounds": bounds,
            "worst": [],
        }
        checks.append(
            Check(variant.renderer, variant.policy, METRIC, "margin", cause, sentence, entry)
        )
    failures = failures_of(table)
    outcomes = [Outcome(check.cause, (check.text,)) for check in checks]
    outcomes.append(outcome_of_failures(failures, spec.max_failed))
    parameters = np.atleast_1d(record["parameter"])
    about = f"about {' and '.join(parameters)} of this scene and these seeds"
    return GateVerdict(worst(outcomes), tuple(checks), failures, stored_name or "the run", about)


def _checked(
    record: JsonView, earlier: JsonView, name: str, other: str, spec: GateSpec
) -> tuple[Cause, str, tuple[float, float] | None]:
    """Return a cause, a sentence, and by how much more of the range fails, at least and at most."""
    now = record["variants"][name]
    was = earlier["variants"][other]
    if record["stopped"] or earlier["stopped"]:
        return "incomplete", "a search was stopped", None
    bounds = more_that_fails(now, was, record["reachable"])
    difference = record["differences"].get(name)
    if record is earlier and difference and difference["baseline"] == other and bounds:
        bounds = _signed(now.get("fails", "below"), difference["low"], difference["high"])
    if now["outcomes"] == was["outcomes"]:
        bounds = 0.0, 0.0
    if bounds is None:
        return "undecided", "one of them has no single boundary, or they fail on other sides", None
    assert spec.boundary_margin is not None, "only a gate on boundaries comes here"
    low, high = bounds
    cause: Cause = "undecided"
    if low > spec.boundary_margin:
        cause = "regression"
    elif high <= spec.boundary_margin:
        cause = "pass"
    between = f"{fixed(low, 2, sign=True)} to {fixed(high, 2, sign=True)}"
    is_area = isinstance(record["unit"], list)
    unit = " of the rectangle" if is_area else f" {record['unit']}".rstrip()
    return cause, f"fails over {between}{unit} more, margin {spec.boundary_margin:g}{unit}", bounds


def more_that_fails(
    now: JsonView, was: JsonView, reachable: tuple[float, float]
) -> tuple[float, float] | None:
    """Return by how much more of a range fails, at least and at most, from the interval of each
    boundary; None where a variant has no single one, or they fail on different sides.

    Args:
        now, was: Facts of two variants in the record of a search.
        reachable: Ends of the range.
    """
    if len({facts["fails"] for facts in (now, was) if "fails" in facts}) > 1:
        return None
    extents = []
    for facts in (now, was):
        outcomes = {failed for points in facts["outcomes"].values() for *_, failed in points}
        if "areas" in facts:
            extents.append((facts["low"], facts["high"]))
        elif "fails" in facts:
            low, high = _signed(facts["fails"], facts["low"], facts["high"])
            end = reachable[0] if facts["fails"] == "below" else -reachable[1]
            extents.append((low - end, high - end))
        elif len(outcomes) == 1:
            extents.append((float(outcomes.pop()) * (reachable[1] - reachable[0]),) * 2)
        else:
            return None
    return extents[0][0] - extents[1][1], extents[0][1] - extents[1][0]


def _signed(fails: str, low: float, high: float) -> tuple[float, float]:
    """Return an interval along the side that fails."""
    return (low, high) if fails == "below" else (-high, -low)
