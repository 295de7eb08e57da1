"""Make the tables of docs/experiments/sequential.md.

    python docs/scripts/sequential.py [--runs 4000] [--only NAME] [--write]

Without --write the tables are printed; with it they replace what stands between the markers of the
page.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
from scipy import stats

from alpasim_plugin.lab.bench.coverage import write_into
from alpasim_plugin.lab.bench.decision_study import (
    ALPHA,
    GAP,
    NEVER,
    Case,
    Way,
    ceiling_for,
    ends,
    family_ends,
    fixed_scenes,
    hidden_suites,
    overall,
    rate_pairs,
    seed_costs,
    shape,
    spread_of,
    suite_ends,
)
from alpasim_plugin.lab.bench.interval_study import CORRELATIONS, RATES

PAGE = Path(__file__).resolve().parents[1] / "experiments" / "sequential.md"
POWERS = (0.8, 0.9, 0.95)
LONG = 1000  # scenes of the runs that must not err
UNEQUAL = [40, 30, 25, 20, 5]
SHAPES = ("normal", "log-normal difference", "log-normal", "log-normal, other way")


def errors(runs: int) -> str:
    """Return how often each answer is given where the truth lies on the threshold."""
    rows = []
    for candidate, baseline in (
        (RATES[0], RATES[1]),
        (RATES[1], RATES[1]),
        (0.3, 0.3),
        (0.02, 0.02),
    ):
        for seeds in (1, 5):
            found = []
            for correlation in CORRELATIONS:
                draw = rate_pairs(candidate, baseline, correlation, seeds)
                case = Case(
                    f"error {candidate} {baseline} {correlation} {seeds}",
                    draw,
                    candidate - baseline,
                    GAP,
                )
                done = ends(case, runs if seeds == 1 else runs // 2, LONG)
                found.append(
                    " / ".join(
                        _percent(float(np.mean(side < NEVER))) for side in (done.good, done.bad)
                    )
                )
            rows.append([f"{100 * candidate:g} and {100 * baseline:g} %", str(seeds), *found])
    return _markdown(["rates", "seeds", *(f"correlation {c:g}" for c in CORRELATIONS)], rows)


def asymptotic_errors(runs: int) -> str:
    """Return the same of metrics without bounds, by the first look."""
    rows = []
    for name in SHAPES:
        found = []
        for first in (5, 10, 20, 40, 80):
            case = Case(f"error {name} {first}", shape(name, 0.0), 0.0, 0.3, False, first)
            done = ends(case, runs, 500)
            found.append(
                " / ".join(_percent(float(np.mean(side < NEVER))) for side in (done.good, done.bad))
            )
        rows.append([name, *found])
    return _markdown(
        ["scene differences", *(f"first look at {n}" for n in (5, 10, 20, 40, 80))], rows
    )


def efficiency(runs: int) -> str:
    """Return scenes against the fixed design of equal power."""
    rows = []
    for label, planned, twice in _planned():
        spread = spread_of(planned.draw, planned.name)
        for power in POWERS:
            fixed = fixed_scenes(planned.distance, spread, power, ALPHA)
            compared = fixed_scenes(planned.distance, spread, power, ALPHA / 2)
            ceiling, first = ceiling_for(planned, runs, fixed, power)
            means = [done.mean_scenes(ceiling) for done in (first, ends(twice, runs, ceiling))]
            rows.append(
                [
                    label if power == POWERS[0] else "",
                    f"{100 * power:.0f} %",
                    str(fixed),
                    f"{ceiling / fixed:.2f}",
                    *(
                        _judged(mean / fixed, aim)
                        for mean, aim in zip(means, (0.6, 0.25), strict=True)
                    ),
                    str(compared),
                    *(
                        _judged(mean / compared, aim)
                        for mean, aim in zip(means, (0.6, 0.25), strict=True)
                    ),
                ]
            )
    head = [
        "differences",
        "power",
        "fixed, 5 %",
        "ceiling",
        "as planned",
        "twice",
        "fixed, 2.5 %",
        "as planned",
        "twice",
    ]
    return _markdown(head, rows)


def rollouts(runs: int) -> str:
    """Return rollouts of both renderers: the fixed design of five seeds a scene, and decisions with
    one.
    """
    rows = []
    for correlation in CORRELATIONS:
        cells = [f"{correlation:g}"]
        one = rate_pairs(RATES[1], RATES[1], correlation, 1)
        case = Case(f"rollouts {correlation}", one, GAP, GAP)
        for power in POWERS[:2]:
            five = spread_of(rate_pairs(RATES[1], RATES[1], correlation, 5), f"five {correlation}")
            fixed = 2 * 5 * fixed_scenes(GAP, five, power, ALPHA / 2)
            single = 2 * fixed_scenes(GAP, spread_of(one, f"one {correlation}"), power, ALPHA / 2)
            ceiling, done = ceiling_for(
                case,
                runs,
                fixed_scenes(GAP, spread_of(one, f"one {correlation}"), power, ALPHA),
                power,
            )
            better = replace(
                case,
                name=f"twice {correlation}",
                draw=rate_pairs(RATES[1], RATES[0], correlation, 1),
            )
            twice = ends(better, runs, ceiling)
            means = [2 * d.mean_scenes(ceiling) for d in (done, twice)]
            cells += [
                str(fixed),
                str(single),
                *(f"{m:.0f} ({100 * m / fixed:.0f} %)" for m in means),
            ]
        rows.append(cells)
    one_power = ["fixed, 5 seeds", "fixed, 1 seed", "as planned", "twice"]
    return _markdown(
        ["correlation", *(f"{name}, {p:.0%}" for p in POWERS[:2] for name in one_power)], rows
    )


def bound(_: int) -> str:
    """Return the least share of the fixed design that any test of the same error and power can need
    (Wald).
    """
    rows = []
    for alpha in (ALPHA, ALPHA / 2):
        cells = []
        for power in POWERS:
            miss = 1.0 - power
            least = 2.0 * (power * math.log(power / alpha) + miss * math.log(miss / (1.0 - alpha)))
            cells.append(
                f"{100 * least / (stats.norm.isf(alpha) + stats.norm.ppf(power)) ** 2:.0f} %"
            )
        rows.append([f"{100 * alpha:g} %", *cells])
    return _markdown(["error", *(f"power {p:.0%}" for p in POWERS)], rows)


def several(runs: int) -> str:
    """Return the errors of decisions on several metrics."""
    rows = []
    for k in (1, 2, 4):
        for correlation in (0.0, 0.7):
            on_edge, one_worse = (
                overall(runs, k, correlation, truths)
                for truths in ("all on the threshold", "one on the threshold")
            )
            rows.append([str(k), f"{correlation:g}", _percent(on_edge[1]), _percent(one_worse[0])])
    head = ["metrics", "correlation", "worse, though none is", "non-inferior, though one is not"]
    return _markdown(head, rows)


def suites(runs: int) -> str:
    """Return errors and scenes for a finite suite, without and with controls."""
    rows = []
    for size in (60, 120, 300):
        for share in (None, 0.0, 0.3, 0.7):
            label = (
                "population"
                if share is None
                else f"suite, control explains {100 * share:g} %"
                if share
                else "suite"
            )
            edge = suite_ends(runs, size, share, on_threshold=True)
            far = suite_ends(runs, size, share, on_threshold=False)
            err = [float(np.mean(side <= size - 1)) for side in (edge.good, edge.bad)]
            known = "" if share is None else " / ".join(map(_percent, err))
            rows.append(
                [
                    str(size),
                    label,
                    known,
                    f"{far.mean_scenes(size):.0f}",
                    _percent(far.share(far.good, size)),
                ]
            )
    return _markdown(
        ["scenes", "asked about", "errors on the threshold", "mean scenes", "decided"], rows
    )


def families(runs: int) -> str:
    """Return scenes and errors for suites of families: random order, families as control, and
    stratified order.
    """
    return _by_family(
        runs,
        {
            "60, five equal": [12] * 5,
            "120, five equal": [24] * 5,
            "120, five unequal": UNEQUAL,
            "120, twelve": [10] * 12,
        },
        False,
    )


def family_rates(runs: int) -> str:
    """Return the same for differences of -1, 0 and 1, which are bet on."""
    return _by_family(runs, {"120, five equal": [24] * 5, "120, five unequal": UNEQUAL}, True)


def _by_family(runs: int, suites_of: Mapping[str, list[int]], bounded: bool) -> str:
    rows = []
    for label, sizes in suites_of.items():
        size = sum(sizes)
        for between in (0.0, 0.3, 0.6):
            cells = [label, f"{100 * between:g} %"]
            for way in get_args(Way):
                edge, far = (
                    family_ends(runs, sizes, between, way, on_threshold, bounded)
                    for on_threshold in (True, False)
                )
                err = [float(np.mean(side <= size - 1)) for side in (edge.good, edge.bad)]
                cells += [f"{far.mean_scenes(size):.1f}", " / ".join(map(_percent, err))]
            rows.append(cells)
    return _markdown(
        [
            "scenes, families",
            "variance between",
            *(name for way in get_args(Way) for name in (way, "errors")),
        ],
        rows,
    )


def hidden(runs: int) -> str:
    """Return errors on suites with few scenes that change much: what an asymptotic sequence cannot
    see, and a bet can.
    """
    rows = []
    for share in (0.02, 0.05, 0.1):
        found = [hidden_suites(runs, share, bounded) for bounded in (True, False)]
        rows.append([f"{100 * share:g} %", *(_percent(err) for err in found)])
    return _markdown(["scenes that change from 0 to 1", "betting", "asymptotic"], rows)


def seeds(runs: int) -> str:
    """Return the cost of a decision by how seeds are chosen."""
    rows = []
    for within in (0.25, 1.0, 4.0):
        for cost in (0.0, 2.0, 8.0):
            found = [seed_costs(max(50, runs // 40), within, cost, rule) for rule in (1, 3, 5, 0)]
            rows.append(
                [
                    f"{within:g}",
                    f"{cost:g}",
                    *(f"{one[0]:.0f}" for one in found),
                    f"{found[-1][1]:.1f}",
                ]
            )
    head = [
        "within / between",
        "cost of a scene",
        "1 seed",
        "3 seeds",
        "5 seeds",
        "auto:5",
        "seeds chosen",
    ]
    return _markdown(head, rows)


def _planned() -> list[tuple[str, Case, Case]]:
    """Return label, the case as planned, and the case with twice the distance."""
    out = []
    for correlation in CORRELATIONS:
        even = Case(
            f"planned {correlation}", rate_pairs(RATES[1], RATES[1], correlation, 1), GAP, GAP
        )
        better = replace(
            even, name=f"twice {correlation}", draw=rate_pairs(RATES[1], RATES[0], correlation, 1)
        )
        out.append((f"rates, correlation {correlation:g}", even, better))
    five = Case("planned five", rate_pairs(RATES[1], RATES[1], 0.6, 5), GAP, GAP)
    out.append(
        (
            "rates, correlation 0.6, 5 seeds",
            five,
            replace(five, name="twice five", draw=rate_pairs(RATES[1], RATES[0], 0.6, 5)),
        )
    )
    for name in SHAPES[:2]:
        case = Case(f"planned {name}", shape(name, 0.0), 0.2, 0.2, False)
        out.append(
            (
                f"no bounds, {name}",
                case,
                replace(case, name=f"twice {name}", draw=shape(name, -0.2)),
            )
        )
    return out


def _percent(share: float) -> str:
    return f"{100 * share:.1f}"


def _judged(ratio: float, aim: float) -> str:
    text = f"{100 * ratio:.0f} %"
    return text if ratio <= aim + 0.005 else f"**{text}**"


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "".join("| " + " | ".join(line) + " |\n" for line in (head, ["---"] * len(head), *rows))


MAKERS: dict[str, Callable[[int], str]] = {
    "errors": errors,
    "asymptotic-errors": asymptotic_errors,
    "hidden": hidden,
    "several": several,
    "bound": bound,
    "efficiency": efficiency,
    "rollouts": rollouts,
    "suites": suites,
    "families": families,
    "family-rates": family_rates,
    "seeds": seeds,
}


def main() -> None:
    """Print the tables, or write them into the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--runs", type=int, default=4000)
    parser.add_argument("--only", choices=list(MAKERS))
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    for name, make in MAKERS.items():
        if options.only in (None, name):
            table = make(options.runs)
            if options.write:
                write_into(PAGE, {name: table})
            else:
                print(f"\n{name}\n\n{table}", flush=True)


if __name__ == "__main__":
    main()
