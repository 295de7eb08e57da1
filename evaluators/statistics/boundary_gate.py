"""A gate on boundaries: over how much of a parameter's range a variant may fail where the baseline does
not, counted at the points that both have driven. What no longer fails makes up for nothing.
"""

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.log.run_folder.sides import RolloutTable
from evaluators.results import Cause, Outcome
from evaluators.statistics.boundary import Difference, difference_of
from evaluators.statistics.boundary_words import apart_text, difference_text
from evaluators.statistics.gate import Check, GateSpec, GateVerdict, failures_of
from evaluators.statistics.variants import base_named, short_name, usual_base, variants_in
from evaluators.statistics.verdicts import outcome_of_failures, worst

METRIC = "boundary"
ROUNDING = 1e-9  # of sums of lengths


def boundary_verdict(
    table: RolloutTable,
    spec: GateSpec,
    record: JsonView | None,
    stored: JsonView | None = None,
    stored_name: str = "",
) -> GateVerdict:
    """Check what fails at the driven points of a search, beyond what fails at those points with the
    baseline, against a margin.

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
    record, earlier = _comparable(record, earlier, stored_name)
    variants = variants_in(table)
    pairs = [(variant, variant) for variant in variants if variant.name in earlier["variants"]]
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
        cause, text, difference = _checked(record, earlier, variant.name, other.name, spec)
        sentence = f"{variant.name}: {METRIC} against {label}: {text}"
        entry: JsonObject = {
            "baseline": label,
            "margin": spec.boundary_margin,
            "points": None if difference is None else vars(difference),
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


def _comparable(
    record: JsonView | None, earlier: JsonView | None, stored_name: str
) -> tuple[JsonView, JsonView]:
    """Return both searches, which went along the same points.

    Raises:
        InputError: One is missing, was made by an earlier version, or went along other points.
    """
    if not record or not earlier:
        raise InputError(
            f"{stored_name if record else 'the run'}: it searched for no boundary",
            "drive it with --vary KEY=LOW..HIGH/STEP, and name the run's folder",
        )
    for searched in (record, earlier):
        if "first" not in searched:
            raise InputError(
                f"{stored_name or 'the run'}: its search was made by an earlier version of simrun",
                "drive it again",
            )
    ranges = [
        [searched[name] for name in ("parameter", "reachable", "spacing")]
        for searched in (record, earlier)
    ]
    if ranges[0] != ranges[1]:
        raise InputError(
            f"{stored_name}: it searched along {ranges[1]}, the run along {ranges[0]}",
            "drive both with the same --vary",
        )
    return record, earlier


def _checked(
    record: JsonView, earlier: JsonView, name: str, other: str, spec: GateSpec
) -> tuple[Cause, str, Difference | None]:
    """Return a cause, a sentence, and the outcomes at points that both have driven."""
    if record["stopped"] or earlier["stopped"]:
        return "incomplete", "a search was stopped", None
    is_area = isinstance(record["unit"], list)
    first = record["first"] if is_area else [record["first"]]
    now = record["variants"][name]["outcomes"]
    difference = difference_of(now, earlier["variants"][other]["outcomes"], first)
    if difference is None:
        return "incomplete", "no point was driven with both, for no seed is that of both", None
    assert spec.boundary_margin is not None, "only a gate on boundaries comes here"
    cause: Cause = "regression" if difference.anew > spec.boundary_margin + ROUNDING else "pass"
    unit = " of the points" if is_area else f" {record['unit']}".rstrip()
    return (
        cause,
        f"{difference_text(vars(difference), unit)}, margin {spec.boundary_margin:g}{unit}; "
        f"points {apart_text(record)} apart, a narrower change is not seen",
        difference,
    )
