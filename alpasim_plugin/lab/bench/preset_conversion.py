"""The same rollouts under several presets: what each metric comes to, and in how many rollouts it
differs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.types import RolloutLog, Scene
from evaluators.metrics import METRICS
from evaluators.metrics.presets import Preset
from evaluators.metrics.presets import preset as find_preset
from evaluators.metrics.score import score
from evaluators.statistics.reduce import reduce_rollout

SAME = 1e-3  # values nearer than this are the same: presets differ in precision too

Values = Mapping[str, float | None]  # metric -> value of a rollout, None where not valid


@dataclass(frozen=True)
class Converted:
    """One rollout under several presets."""

    name: str
    values: Mapping[str, Values]  # preset -> values; a preset that refused the rollout is missing
    refused: Mapping[str, str]  # preset -> why it gave no number


@dataclass(frozen=True)
class MetricRow:
    """One metric over the same rollouts; per preset in the order of `presets`, differences from the
    first preset.
    """

    metric: str
    unit: str
    is_flag: bool  # it fired in a rollout or not
    presets: tuple[str, ...]
    n: tuple[int, ...]  # rollouts with a value
    total: tuple[
        float | None, ...
    ]  # rollouts with the event for flags, the mean of the valid values otherwise
    differ: tuple[
        int, ...
    ]  # rollouts whose value is not that of the first preset: another number, or valid in one only


def convert(
    name: str, rollout: RolloutLog, scene: Scene, presets: Sequence[str | Preset]
) -> Converted:
    """Score one rollout under several presets; a preset that refuses it is noted, not raised.

    Raises:
        InputError: Unknown preset.
    """
    values: dict[str, Values] = {}
    refused: dict[str, str] = {}
    for chosen in [find_preset(one) for one in presets]:
        try:
            reduced = reduce_rollout(score(rollout, scene, chosen), chosen).values
        except EvaluatorError as error:
            refused[chosen.name] = error.message
            continue
        values[chosen.name] = {
            metric: one.value if one.valid else None for metric, one in reduced.items()
        }
    return Converted(name, values, refused)


def conversion_table(rollouts: Sequence[Converted], presets: Sequence[str]) -> list[MetricRow]:
    """Return one row per metric that any preset gives, in order of appearance."""
    metrics = dict.fromkeys(
        m for one in rollouts for name in presets for m in one.values.get(name, {})
    )
    return [_row(metric, rollouts, presets) for metric in metrics]


def _row(metric: str, rollouts: Sequence[Converted], presets: Sequence[str]) -> MetricRow:
    facts = METRICS.info(metric)
    columns = [[one.values.get(name, {}).get(metric) for one in rollouts] for name in presets]
    # A metric that a preset does not have at all differs in nothing: there is no value to convert
    # to.
    known = [any(metric in one.values.get(name, {}) for one in rollouts) for name in presets]
    found = [[v for v in column if v is not None and np.isfinite(v)] for column in columns]
    is_flag = (
        facts.is_flag and facts.aggregation == "max"
    )  # other flags are shares of a rollout's steps
    totals = tuple(
        (float(np.sum(v)) if is_flag else float(np.mean(v))) if v else None for v in found
    )
    differ = [
        sum(not _same(a, b) for a, b in zip(columns[0], column, strict=True))
        if known[0] and has
        else 0
        for column, has in zip(columns, known, strict=True)
    ]
    return MetricRow(
        metric,
        facts.unit,
        is_flag,
        tuple(presets),
        tuple(len(v) for v in found),
        totals,
        tuple(differ),
    )


def _same(a: float | None, b: float | None) -> bool:
    return a is b if a is None or b is None else a == b or abs(a - b) <= SAME


def as_markdown(rows: Sequence[MetricRow], rollouts: Sequence[Converted]) -> str:
    """Return the table as Markdown, with a line for each preset that refused rollouts."""
    if not rows:
        return ""
    presets = rows[0].presets
    heads = [
        "metric",
        *(f"`{name}`" for name in presets),
        *(f"differs in `{name}`" for name in presets[1:]),
    ]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for row in rows:
        cells = [_cell(row, k) for k in range(len(presets))]
        lines.append(
            "| "
            + " | ".join(
                [f"`{row.metric}`", *cells, *(str(d) if d else "-" for d in row.differ[1:])]
            )
            + " |"
        )
    for name in presets:
        why = sorted({one.refused[name] for one in rollouts if name in one.refused})
        if why:
            lines += [
                "",
                f"`{name}` refused {sum(name in one.refused for one in rollouts)} of {len(rollouts)} rollouts: {'; '.join(why)}.",
            ]
    return "\n".join(lines)


def _cell(row: MetricRow, k: int) -> str:
    total = row.total[k]
    if total is None:
        return "-"
    return (
        f"{total:.0f} of {row.n[k]}"
        if row.is_flag
        else f"{total:.3f} {row.unit}".strip() + f" ({row.n[k]})"
    )
