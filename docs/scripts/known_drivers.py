"""Record which shipped scenes known drivers pass: the scale on which `simrun check-driver` places a
driver.

    python docs/scripts/known_drivers.py OUT.json [--policy
    pure-pursuit,learned,tests/runs/seeded_bugs.py:Latency] [SCENE...]

Scenes are driven as `simrun check-driver` drives them: behind `clean`, with AlpaSim's time line,
seed 0, preset `paper`. OUT.json is scenarios/suites/known_drivers.json; what it has is kept, so a
second call continues the first. A scene is passed without any outcome.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from alpasim_plugin import load_scenario, make_policy, make_renderer, run_rollout
from alpasim_plugin.core.atomic import write_json
from alpasim_plugin.core.errors import PolicyError
from evaluators import reduce_rollout, score
from evaluators.metrics.outcomes import OUTCOMES
from scenarios.suite import expand

POLICIES = ("constant-velocity", "pure-pursuit", "learned", "lane-camera")


def passes(scene: str, policy: str) -> tuple[str, bool]:
    """Drive a scene; return its id, and whether no outcome is found."""
    (ref,) = expand(scene, ("timing.timeline=alpasim",))
    scenario = load_scenario(ref.path, ref.seed, ref.overrides)
    try:
        recorder = run_rollout(
            scenario,
            make_renderer("clean", scenario, threads=1),
            make_policy(policy, scenario),
            seed=0,
        )
    except PolicyError:
        return scenario.scene_id, False
    values = reduce_rollout(
        score(recorder.log(), scenario.scene, preset="paper"), "paper"
    ).as_dict()
    return scenario.scene_id, not any(
        values.get(name, {}).get("valid") and values[name]["value"] >= 0.5 for name in OUTCOMES
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--policy", default=",".join(POLICIES))
    asked = parser.parse_intermixed_args()  # scenes may stand after an option
    known = json.loads(asked.out.read_text()) if asked.out.exists() else {"passed": {}}
    for policy in asked.policy.split(","):
        for scene in asked.scenes or [
            f"{Path(ref.path).parent.name}/{Path(ref.path).stem}" for ref in expand("suites/all")
        ]:
            name = policy.rpartition(":")[2]
            scene_id = load_scenario(scene).scene_id
            if name not in known["passed"].get(scene_id, {}):
                known["passed"].setdefault(scene_id, {})[name] = passes(scene, policy)[1]
                write_json(asked.out, known)
