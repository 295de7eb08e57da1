"""The fixers of a summary: label, training, mode, and counts of blocks and predictions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

COUNTS = ("predicted", "hits", "exact", "drafts", "redrafts")


def fixers(manifests: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return for each renderer with a fixer: ``label``, ``trained``, ``mode``, ``rollouts`` and ``frames``; ``blocks`` unless the
    mode is ``frame``.

    In speculative mode also the counts of `block_fixers.speculation.SpeculationStats` over rollouts, ``hit_rate`` (the share of
    predicted frames within tolerance), and the largest ``forecast_error`` and ``shown_error``.

    Args:
        manifests: Of finished rollouts of one policy.
    """
    out: dict[str, Any] = {}
    for name in dict.fromkeys(m["renderer"] for m in manifests):
        facts = [m["fixer"] for m in manifests if m["renderer"] == name and m.get("fixer")]
        if not facts:
            continue
        entry = {key: facts[0][key] for key in ("label", "trained", "mode")} | {"rollouts": len(facts)}
        entry |= {key: sum(one[key] for one in facts) for key in ("frames", "blocks") if key in facts[0]}
        if entry["mode"] == "speculative":
            entry |= {key: sum(one[key] for one in facts) for key in COUNTS}
            entry["hit_rate"] = round(entry["hits"] / entry["predicted"], 4) if entry["predicted"] else None
            entry |= {key: _largest(one[key] for one in facts) for key in ("forecast_error", "shown_error")}
        out[name] = entry
    return out


def chosen(manifests: Sequence[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Return for each renderer with a fixer what was chosen by measuring the machines, for ``run.json``.

    One entry for each node (``node``; null: the machine that the command ran on) and choice, with what was measured and the number of
    rollouts. A node has several entries only where the run was continued, or its processes share no temporary folder.
    """
    out: dict[str, list[dict[str, Any]]] = {}
    for manifest in manifests:
        facts = (manifest.get("fixer") or {}).get("chosen")
        if not facts:
            continue
        node, entries = manifest.get("node"), out.setdefault(manifest["renderer"], [])
        same = [entry for entry in entries if (entry["node"], _picked(entry)) == (node, _picked(facts))]
        if same:
            same[0]["rollouts"] += 1
        else:
            entries.append({"node": node, **facts, "rollouts": 1})
    return out


def _picked(facts: Mapping[str, Any]) -> tuple[Any, Any]:
    return facts["precision"]["name"] if "precision" in facts else None, facts["threads"]["number"] if "threads" in facts else None


def _largest(spreads: Iterable[dict[str, dict[str, float] | None]]) -> dict[str, float | None]:
    """Return the largest value of each kind of error over rollouts; None where there is no finite one."""
    found: dict[str, list[float]] = {}
    for spread in spreads:
        for name, values in spread.items():
            found.setdefault(name, []).extend([] if values is None else [values["max"]])
    return {name: max(values, default=None) for name, values in found.items()}
