"""Level and power of a gate about its suite whose policy is not repeatable, by simulation.

    python docs/scripts/gate_power.py [RUNS]

prints the table of docs/experiments/verdict-error.md. Two variants have the chances of events and the noise given
below in every rollout; the functions that decide are those of the gate.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np

from alpasim_plugin.core.types import F64
from alpasim_plugin.log.run_folder.sides import Side
from evaluators.metrics import METRICS
from evaluators.statistics.suite import Change, chances, verdict_of

SCENES = (3, 6, 14, 42)
SEEDS = (1, 3, 6, 20)
RULES = {"collision_at_fault": 0.1, "offroad": 0.1, "lateral_distance_m": 0.1, "progress": 0.05}
Draw = Callable[[np.random.Generator, int, int], dict[str, F64]]  # scenes, seeds -> differences


def differences(
    random: np.random.Generator, shape: tuple[int, int], rate: float, more: F64, shift_m: F64
) -> dict[str, F64]:
    """Draw the differences of two variants that are alike but for more events and a shift."""
    rates = np.clip(random.random((shape[0], 1)) * 2 * rate, 0.0, 1.0)
    now = random.random(shape) < np.clip(rates + more, 0.0, 1.0)
    was = random.random(shape) < rates
    offroad = (random.random(shape) < rates).astype(float) - (random.random(shape) < rates)
    lateral = 0.1 * random.standard_t(3, shape) + shift_m  # a tail of metres
    progress = 0.02 * random.standard_normal(shape)
    return {
        "collision_at_fault": now.astype(float) - was,
        "offroad": offroad,
        "lateral_distance_m": lateral,
        "progress": progress,
    }


def alike(rate: float) -> Draw:
    """Return the draw of two equal variants."""
    return lambda random, scenes, seeds: differences(
        random, (scenes, seeds), rate, np.zeros((1, 1)), np.zeros((1, 1))
    )


def everywhere(rate: float, more: float, shift_m: float) -> Draw:
    """Return the draw of a variant that is worse in every scene."""
    return lambda random, scenes, seeds: differences(
        random, (scenes, seeds), rate, np.full((1, 1), more), np.full((1, 1), shift_m)
    )


def in_one_scene(random: np.random.Generator, scenes: int, seeds: int) -> dict[str, F64]:
    """Draw a variant that always collides in one scene, in which the baseline never does."""
    drawn = differences(random, (scenes, seeds), 0.0, np.zeros((1, 1)), np.zeros((1, 1)))
    drawn["collision_at_fault"][0] = 1.0
    return drawn


CASES: dict[str, Draw] = {
    "alike, events in 2 %": alike(0.02),
    "alike, events in 30 %": alike(0.3),
    "one scene always collides": in_one_scene,
    "30 points more collisions": everywhere(0.02, 0.3, 0.0),
    "0.2 m farther from the path": everywhere(0.02, 0.0, 0.2),
}


def shares(draw: Draw, scenes: int, seeds: int, runs: int) -> tuple[float, float]:
    """Return the shares of red and of green gates."""
    random = np.random.Generator(np.random.Philox(key=[scenes, seeds]))
    cells = [(f"s{i:02d}", seed) for i in range(scenes) for seed in range(seeds)]
    side = Side.of([{"policy": "p", "scene": scene, "seed": seed} for scene, seed in cells])
    every, none = np.ones(len(cells), dtype=bool), np.zeros(len(cells))
    red = green = 0
    for _ in range(runs):
        changes = [
            Change(
                METRICS[name], RULES[name], side, none, diff.reshape(-1), every, ~every, 0, 0, []
            )
            for name, diff in draw(random, scenes, seeds).items()
        ]
        verdicts = [
            verdict_of(change, p, 0) for change, p in zip(changes, chances(changes), strict=True)
        ]
        red += "worse" in verdicts
        green += set(verdicts) == {"non-inferior"}
    return red / runs, green / runs


def main(runs: int) -> None:
    """Print the table: red / green in percent; of variants that are alike from four times as many
    runs.
    """
    print("| | scenes |", " | ".join(f"{seeds} seeds" for seeds in SEEDS), "|", flush=True)
    print("|---|---:|" + "---:|" * len(SEEDS), flush=True)
    for name, draw in CASES.items():
        for scenes in SCENES:
            n = 4 * runs if name.startswith("alike") else runs
            found = [shares(draw, scenes, seeds, n) for seeds in SEEDS]
            texts = [f"{100 * red:.1f} / {100 * green:.0f}" for red, green in found]
            print(f"| {name} | {scenes} |", " | ".join(texts), "|", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 50)
