"""What every arm of a comparison was given: updates, processor time, and the learning rate that a
sweep chose.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

from alpasim_plugin.lab.paper.tables import markdown_table

WITHIN = 0.1  # of a budget's core-minutes: a training that took so long needs no second one
HOW = """A stage that several arms have counts for each; the initial networks, which all share, do not count. Core-minutes are processor
time of the updates on one machine, without the candidates of a sweep, whose `perceptual-syn` on `val` is in brackets.
"""


@dataclass(frozen=True)
class TrainedArm:
    """How an arm was trained.

    Args:
        arm: Its name.
        stages: Name of each stage -> its updates, in order.
        core_minutes: Processor time of all stages.
        rate: Peak learning rate before the recipe's own factors.
        swept: Learning rate -> ``perceptual-syn``, lower is better; empty where none was chosen.
    """

    arm: str
    stages: Mapping[str, int]
    core_minutes: float
    rate: float
    swept: Mapping[float, float] = field(default_factory=dict)


def edge_of(rate: float, swept: Collection[float]) -> str | None:
    """Return which end of the swept learning rates the chosen one is; None: it has others on both
    sides, or there was no choice.

    Example:
        >>> edge_of(1e-3, [1e-4, 3e-4, 1e-3])
        'highest'
    """
    if len(swept) < 2:
        return None
    return {max(swept): "highest", min(swept): "lowest"}.get(rate)


def training_table(arms: Sequence[TrainedArm]) -> str:
    """Return one line for each arm."""
    lines = []
    for one in arms:
        stages = " + ".join(f"{name} {updates}" for name, updates in one.stages.items())
        lines.append(
            [one.arm, stages, f"{one.core_minutes:.2f}", f"{one.rate:g}{_candidates(one)}"]
        )
    return markdown_table(["arm", "stages and updates", "core-minutes", "learning rate"], lines)


def training_section(arms: Sequence[TrainedArm]) -> str:
    """Return the table with what its numbers mean; empty where nothing is known of the training."""
    if not arms:
        return ""
    return f"{HOW}\n{training_table(arms)}{''.join(_at_an_edge(arms, edge) for edge in ('highest', 'lowest'))}"


def _at_an_edge(arms: Sequence[TrainedArm], edge: str) -> str:
    names = ", ".join(f"`{one.arm}`" for one in arms if edge_of(one.rate, one.swept) == edge)
    return (
        f"\nThe {edge} rate of its sweep was the best of {names}: a better one may lie beyond it.\n"
        if names
        else ""
    )


def _candidates(one: TrainedArm) -> str:
    if not one.swept:
        return ""
    return f" ({', '.join(f'{rate:g}: {value:.3f}' for rate, value in sorted(one.swept.items()))})"
