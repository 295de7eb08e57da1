"""Drive the shipped policies over the shipped suites, behind `clean` with one seed, and print how
their rollouts ended.

Usage: python docs/scripts/suite_outcomes.py FOLDER [POLICY...]; it continues when it is interrupted.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from pages import table

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.log.run_folder.reader import Run
from evaluators.metrics.outcomes import ENDINGS, ending_of
from scenarios.load import scene_id_of
from scenarios.suite import load_suite

POLICIES = ("constant-velocity", "pure-pursuit", "lane-camera", "learned", "rule-based")
DRIVEN = ("all", "first")  # between them they hold every scene of every suite
SUITES = ("first", "smoke", "gate_self_test", "urban", "highway", "hard", "all")


def drive(out: Path, suite: str, policies: Sequence[str]) -> None:
    """Drive one suite with every policy."""
    variants = ["--renderer", "clean", "--policy", ",".join(policies), "--seeds", "1"]
    kept = ["--video", "none", "--images", "none", "--no-report"]
    run_command([*variants, *kept, f"suites/{suite}", "--out", str(out / suite)])


def ended(out: Path, suite: str, policy: str) -> str:
    """Return how many rollouts of a suite ended in which way, the best first."""
    run = Run.read_so_far(out / (suite if suite in DRIVEN else DRIVEN[0]))
    scenes = {scene_id_of(ref) for ref in load_suite(f"suites/{suite}")}
    counts = Counter(
        ending_of(rollout)
        for rollout in run.rollouts
        if rollout.policy == policy and rollout.scene in scenes
    )
    return ", ".join(f"{counts[ending]} {ending}" for ending in ENDINGS if counts[ending])


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    chosen = sys.argv[2:] or POLICIES
    for name in DRIVEN:
        drive(folder, name, chosen)
    rows = [[f"`{name}`", *(ended(folder, name, policy) for policy in chosen)] for name in SUITES]
    print(table(["suite", *(f"`{policy}`" for policy in chosen)], rows))
