"""Drive shipped scenes with a driver that looks at nothing, and with those that look: which scenes tell them apart.

python docs/scripts/power.py drive --policy pure-pursuit,lane-camera OUT.json SCENE...
python docs/scripts/power.py table OUT.json...        # the table of docs/experiments/power.md
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from alpasim_plugin import load_scenario, make_policy, make_renderer, run_rollout
from alpasim_plugin.io.atomic import write_json
from evaluators import reduce_rollout, score
from evaluators.metrics.outcomes import OUTCOMES, in_words
from scenarios.suite import expand, load_suite

SUITES = ("first", "smoke", "gate_self_test", "urban", "highway", "hard")
BLIND, NOTHING = "pure-pursuit", in_words(())


def outcome(scene: str, policy: str) -> str:
    """Drive a scene behind `clean` and name how it ends."""
    (ref,) = expand(scene)
    scenario = load_scenario(ref.path, ref.seed, ref.overrides)
    made = make_policy(policy, scenario)
    recorder = run_rollout(scenario, make_renderer("clean", scenario, threads=1), made, seed=0)
    values = reduce_rollout(score(recorder.log(), scenario.scene, preset="paper"), "paper").as_dict()
    return in_words(name for name in OUTCOMES if values.get(name, {}).get("valid") and values[name]["value"] >= 0.5)


def drive(policies: list[str], out: Path, scenes: list[str]) -> None:
    """Add outcomes to a file; what it has is kept."""
    known = json.loads(out.read_text()) if out.exists() else {}
    for scene in scenes:
        for policy in policies:
            if policy not in known.setdefault(scene, {}):
                known[scene][policy] = outcome(scene, policy)
                print(f"{scene:<28}{policy:<20}{known[scene][policy]}", flush=True)
                write_json(out, known)


def table(files: list[Path]) -> None:
    """Print a row a scene in which the blind driver fails, and a row a suite."""
    known: dict[str, dict[str, str]] = {}
    for file in files:
        for scene, ends in json.loads(file.read_text()).items():
            known.setdefault(scene, {}).update(ends)
    policies = list(dict.fromkeys(policy for ends in known.values() for policy in ends))
    print("| scene | " + " | ".join(f"`{one}`" for one in policies) + " |\n|---" + "|---" * len(policies) + "|")
    for scene, ends in known.items():
        if ends.get(BLIND, NOTHING) != NOTHING:
            print(f"| `{scene}` | " + " | ".join(ends.get(one, "not driven") for one in policies) + " |")
    print(f"\n| suite | scenes | `{BLIND}` fails in |\n|---|---|---|")
    for suite in SUITES:
        names = [scene_name(ref.path) for ref in load_suite(f"suites/{suite}")]
        print(f"| `suites/{suite}` | {len(names)} | {sum(known[name][BLIND] != NOTHING for name in names)} |")


def scene_name(path: str) -> str:
    """Return the shipped name of a scenario file."""
    return f"{Path(path).parent.name}/{Path(path).stem}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("drive", "table"))
    parser.add_argument("--policy", default=BLIND)
    parser.add_argument("out", type=Path)
    parser.add_argument("scenes", nargs="*")
    asked = parser.parse_args()
    if asked.what == "drive":
        drive(asked.policy.split(","), asked.out, asked.scenes or [scene_name(ref.path) for ref in expand("suites/all")])
    else:
        table([asked.out, *map(Path, asked.scenes)])
