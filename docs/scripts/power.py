"""Drive shipped scenes with blind and broken drivers, and with those that they are made from: what
tells them apart, and how soon.

python -m docs.scripts.power drive --policy pure-pursuit,lane-camera OUT.json SCENE...
python -m docs.scripts.power drive --policy bugs OUT.json SCENE...    # those of tests/runs/seeded_bugs.py and what they are made from
python -m docs.scripts.power table OUT.json...        # the tables of docs/experiments/power.md
python -m docs.scripts.power rollouts OUT.json...
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from alpasim_plugin import load_scenario, make_policy, make_renderer, run_rollout
from alpasim_plugin.core.atomic import write_json
from alpasim_plugin.core.errors import PolicyError
from evaluators import reduce_rollout, score
from evaluators.metrics.outcomes import OUTCOMES, POLICY_FAULT, in_words
from evaluators.statistics.sequential import betting
from evaluators.statistics.sequential.draws import independent
from evaluators.statistics.sequential.line import Plan
from evaluators.statistics.verdicts import more_scenes
from scenarios.suite import expand, load_suite
from tests.runs import seeded_bugs

SUITES = ("first", "smoke", "gate_self_test", "urban", "highway", "hard")
BLIND, NOTHING = "pure-pursuit", in_words(())
SOUND = {"LaneCamera": "lane-camera", "Learned": "learned"}  # class -> name of a shipped policy
CLASSES = [
    one
    for one in vars(seeded_bugs).values()
    if isinstance(one, type) and one.__module__ == seeded_bugs.__name__
]
BASES = {one.__name__: one.__bases__[0].__name__ for one in CLASSES} | {
    BLIND: "LaneCamera",
    "MyPolicy": "LaneCamera",
}
MARGIN, ALPHA, CEILING, RUNS = (
    0.05,
    0.05,
    100,
    1000,
)  # of the default gate; most scenes, and simulated comparisons


def outcome(scene: str, policy: str) -> str:
    """Drive a scene behind `clean` and name how it ends."""
    (ref,) = expand(scene)
    scenario = load_scenario(ref.path, ref.seed, ref.overrides)
    made = make_policy(policy, scenario)
    try:
        recorder = run_rollout(scenario, make_renderer("clean", scenario, threads=1), made, seed=0)
    except PolicyError:
        return in_words([POLICY_FAULT])
    values = reduce_rollout(
        score(recorder.log(), scenario.scene, preset="paper"), "paper"
    ).as_dict()
    return in_words(
        name
        for name in OUTCOMES
        if values.get(name, {}).get("valid") and values[name]["value"] >= 0.5
    )


def drive(policies: list[str], out: Path, scenes: list[str]) -> None:
    """Add outcomes to a file; what it has is kept."""
    known = read([out]) if out.exists() else {}
    for scene in scenes:
        for policy in policies:
            name = policy.rpartition(":")[2]
            if name not in known.setdefault(scene, {}):
                known[scene][name] = outcome(scene, policy)
                print(f"{scene:<28}{name:<20}{known[scene][name]}", flush=True)
                write_json(out, known)


def read(files: list[Path]) -> dict[str, dict[str, str]]:
    """Return how drives ended, by scene and policy."""
    known: dict[str, dict[str, str]] = {}
    for file in files:
        for scene, ends in json.loads(file.read_text()).items():
            known.setdefault(scene, {}).update(ends)
    return known


def table(known: dict[str, dict[str, str]]) -> None:
    """Print a row a scene in which the blind driver fails, and a row a suite."""
    policies = list(dict.fromkeys(policy for ends in known.values() for policy in ends))
    print(
        "| scene | "
        + " | ".join(f"`{one}`" for one in policies)
        + " |\n|---"
        + "|---" * len(policies)
        + "|"
    )
    for scene, ends in known.items():
        if ends.get(BLIND, NOTHING) != NOTHING:
            print(
                f"| `{scene}` | "
                + " | ".join(ends.get(one, "not driven") for one in policies)
                + " |"
            )
    print(f"\n| suite | scenes | `{BLIND}` fails in |\n|---|---|---|")
    for suite in SUITES:
        names = [scene_name(ref.path) for ref in load_suite(f"suites/{suite}")]
        print(
            f"| `suites/{suite}` | {len(names)} | {sum(known[name][BLIND] != NOTHING for name in names)} |"
        )


def rollouts(known: dict[str, dict[str, str]]) -> None:
    """Print how many rollouts show that a broken driver fails more often than the one that it is
    made from, in scenes like these.
    """
    print(
        "| driver | fails in | made from | fails in | fixed design | until decided, median | decided |\n|---"
        + "|---" * 6
        + "|"
    )
    for name, base in BASES.items():
        sound = SOUND.get(base, base)
        pairs = np.array(
            [
                [ends[one] != NOTHING for one in (name, sound)]
                for ends in known.values()
                if {name, sound} <= {*ends}
            ],
            float,
        )
        if name in BASES.values() or not len(pairs):
            continue
        delta, n = pairs[:, 0] - pairs[:, 1], len(pairs)
        needed = (
            more_scenes(delta.mean(), delta.std(), 0, MARGIN, None)
            if delta.mean() > MARGIN
            else None
        )
        draws = independent(np.random.default_rng(0).choice(delta, (RUNS, CEILING)), -1.0, 1.0)
        capital = betting.log_capital(
            draws, MARGIN, betting.bet_sizes(draws, MARGIN, Plan(MARGIN, CEILING, ALPHA))
        )
        is_shown = capital >= -np.log(ALPHA)
        at = 2 * (1 + is_shown.argmax(axis=1)[is_shown.any(axis=1)])
        fails = [f"{int(side.sum())} of {n}" for side in pairs.T]
        found = (
            f"{np.median(at):.0f} | {100 * len(at) / RUNS:.0f} %"
            if 2 * len(at) > RUNS
            else f"not found | {100 * len(at) / RUNS:.0f} %"
        )
        print(
            f"| `{name}` | {fails[0]} | `{sound}` | {fails[1]} | {2 * needed if needed else 'not found'} | {found} |"
        )


def scene_name(path: str) -> str:
    """Return the shipped name of a scenario file."""
    return f"{Path(path).parent.name}/{Path(path).stem}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("drive", "table", "rollouts"))
    parser.add_argument("--policy", default=BLIND)
    parser.add_argument("out", type=Path)
    parser.add_argument("scenes", nargs="*")
    asked = parser.parse_intermixed_args()
    if asked.what == "drive":
        broken = [*SOUND.values(), *(f"{seeded_bugs.__name__}:{one.__name__}" for one in CLASSES)]
        asked_for = broken if asked.policy == "bugs" else asked.policy.split(",")
        drive(
            asked_for,
            asked.out,
            [
                scene_name(ref.path)
                for item in asked.scenes or ["suites/all"]
                for ref in expand(item)
            ],
        )
    else:
        {"table": table, "rollouts": rollouts}[asked.what](
            read([asked.out, *map(Path, asked.scenes)])
        )
