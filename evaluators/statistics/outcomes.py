"""How the drives of a run end, counted by arm, with where and when; and the same in sentences."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from alpasim_plugin.log.run_folder.rows import Rollout
from evaluators.metrics.outcomes import (
    CONTACT_SIDES,
    OUTCOMES,
    has_ended,
    outcomes_of,
    reached_end,
    told,
)

Times = Mapping[
    tuple[str, str, str, int], Mapping[str, float]
]  # cell -> outcome -> seconds after the first frame
LISTED = 20  # cells named per outcome in summary.json
NAMED = 2  # in a sentence


def rollouts_of(manifests: Iterable[Mapping[str, Any]]) -> tuple[list[Rollout], Times]:
    """Return manifests as rows, and when their outcomes began."""
    rows: list[Rollout] = []
    times: dict[tuple[str, str, str, int], dict[str, float]] = {}
    for manifest in manifests:
        metrics = {
            name: facts["value"] if facts["valid"] else None
            for name, facts in (manifest.get("metrics") or {}).items()
        }
        numbers = {
            name: value
            for name, value in metrics.items()
            if isinstance(value, int | float) or value is None
        }
        error = manifest.get("error") or {}
        row = Rollout(
            manifest["renderer"],
            manifest["policy"],
            manifest["scene"],
            int(manifest["seed"]),
            manifest["status"],
            str(error.get("failure_class") or ""),
            str(error.get("message") or ""),
            metrics=numbers,
        )
        rows.append(row)
        began = {
            event["metric"]: float(event["t_s"])
            for event in manifest.get("events") or []
            if "t_s" in event
        }
        contact = [began[side] for side in CONTACT_SIDES if side in began]
        if contact:
            began |= dict.fromkeys(("collision_any", "collision_at_fault"), min(contact))
        times.setdefault(row.cell, began)
    return rows, times


def outcome_table(
    rollouts: Sequence[Rollout], times: Times | None = None
) -> dict[str, dict[str, Any]]:
    """Count outcomes by arm.

    Args:
        rollouts: Those of a run, in its order.
        times: When outcomes began, as far as it is known.

    Returns:
        RENDERER/POLICY -> ``n_rollouts``; ``n_ended`` (ran to their end, or were broken by the
        policy); ``n_failed`` (of these: with an outcome); ``n_reached_end`` (without one, at the
        end of the path); ``outcomes``: NAME -> ``n`` and ``cells`` (the first `LISTED`: ``scene``,
        ``seed``, ``t_s`` or None).
    """
    arms: dict[str, list[Rollout]] = {}
    for rollout in rollouts:
        arms.setdefault(rollout.variant, []).append(rollout)
    return {name: _of_arm(own, times or {}) for name, own in arms.items()}


def _of_arm(rollouts: Sequence[Rollout], times: Times) -> dict[str, Any]:
    ended = [r for r in rollouts if has_ended(r)]
    cells: dict[str, list[dict[str, Any]]] = {}
    for rollout in ended:
        began = times.get(rollout.cell, {})
        for outcome in told(outcomes_of(rollout)):
            cells.setdefault(outcome.name, []).append(
                {"scene": rollout.scene, "seed": rollout.seed, "t_s": began.get(outcome.name)}
            )
    return {
        "n_rollouts": len(rollouts),
        "n_ended": len(ended),
        "n_failed": sum(bool(outcomes_of(r)) for r in ended),
        "n_reached_end": sum(reached_end(r) for r in ended),
        "outcomes": {
            name: {"n": len(cells[name]), "cells": cells[name][:LISTED]}
            for name in OUTCOMES
            if name in cells
        },
    }


def sentence(entry: Mapping[str, Any]) -> str:
    """Say how the drives of an arm end.

    Args:
        entry: One of `outcome_table`.

    Example:
        >>> cells = [{"scene": "bend", "seed": 0, "t_s": 3.12}]
        >>> sentence({"n_ended": 3, "n_reached_end": 2, "outcomes": {"offroad": {"n": 1, "cells": cells}}})
        'off-road in 1 of 3 (bend at 3.1 s); 2 of 3 reach the end'
    """
    n, reached = int(entry["n_ended"]), int(entry["n_reached_end"])
    if n == 0:
        return "no drive has ended"
    parts = [_counted(name, facts, n) for name, facts in entry["outcomes"].items()]
    if n == 1:
        ends = (
            "reaches the end"
            if reached
            else ""
            if parts
            else "no event, but the end is not reached"
        )
        return "; ".join([*parts, *([ends] if ends else [])])
    all_of = "both" if n == 2 else f"all {n}"
    ends = (
        f"{all_of} reach the end"
        if reached == n
        else f"{reached} of {n} reach{'es' if reached == 1 else ''} the end"
    )
    return "; ".join([*parts, ends] if parts or reached == n else ["no event", ends])


def _counted(name: str, facts: Mapping[str, Any], n: int) -> str:
    cells, k = list(facts["cells"]), int(facts["n"])
    several_seeds = len({cell["scene"] for cell in cells}) < len(cells)
    where = [_place(cell, several_seeds) for cell in cells[:NAMED]]
    if n == 1:
        t_s = cells[0]["t_s"] if cells else None
        return OUTCOMES[name].words + (f" at {t_s:.1f} s" if t_s is not None else "")
    more = f" and {k - len(where)} more" if k > len(where) else ""
    return f"{OUTCOMES[name].words} in {k} of {n} ({', '.join(where)}{more})"


def _place(cell: Mapping[str, Any], with_seed: bool) -> str:
    seed = f" seed {cell['seed']}" if with_seed else ""
    return f"{cell['scene']}{seed}" + (
        f" at {cell['t_s']:.1f} s" if cell["t_s"] is not None else ""
    )
