"""The methods of `simrun decide` side by side: wrong "non-inferior" with the truth on the margin,
and scenes to a right one.

Run: ``python docs/scripts/sequential_methods.py 200`` (runs a cell); it prints the table of
    docs/experiments/sequential.md.
"""

from __future__ import annotations

import sys

import numpy as np

from evaluators.statistics.sequential.decision import state_after
from evaluators.statistics.sequential.question import Question, metric_question

MOST, EVERY = 200, 10


def rate(rng: np.random.Generator, worse: float) -> np.ndarray:
    """Differences of flags: 5 % of scenes lose the event, and so many more gain it."""
    return np.asarray(rng.choice([-1.0, 0.0, 1.0], MOST, p=[0.05, 0.9 - worse, 0.05 + worse]))


def tailed(rng: np.random.Generator, worse: float) -> np.ndarray:
    """Differences in metres: a share of scenes is 4 m worse."""
    return np.asarray(
        rng.normal(0.0, 0.05, MOST) + np.where(rng.random(MOST) < worse / 4.0, 4.0, 0.0)
    )


def decided(question: Question, metric: str, x: np.ndarray) -> tuple[str, int]:
    """Return the answer and after how many scenes it is given."""
    for n in range(EVERY, MOST + 1, EVERY):
        answer = state_after(question, {metric: x[:n]}, MOST).answer
        if answer != "open":
            return answer, n
    return "open", MOST


def main(runs: int) -> None:
    """Print the table."""
    print(
        "| differences | method | wrong, truth on the margin | right, no difference | scenes to it |\n|---|---|---|---|---|"
    )
    for metric, draw, methods in (
        ("offroad", rate, ("betting", "obrien-fleming", "pocock")),
        ("lateral_distance_m", tailed, ("asymptotic", "obrien-fleming", "pocock")),
    ):
        for method in methods:
            question = Question((metric_question(metric, 0.1, "non-inferior", method=method),))  # type: ignore[arg-type]
            wrong = [
                decided(question, metric, draw(np.random.default_rng(k), 0.1))[0] == "good"
                for k in range(runs)
            ]
            right = [
                n
                for a, n in (
                    decided(question, metric, draw(np.random.default_rng(k), 0.0))
                    for k in range(runs)
                )
                if a == "good"
            ]
            mean = f"{np.mean(right):.0f}" if right else "-"
            print(
                f"| {metric} | `{method}` | {100 * np.mean(wrong):.1f} % | {100 * len(right) / runs:.0f} % | {mean} |",
                flush=True,
            )


if __name__ == "__main__":
    main(int(sys.argv[1]))
