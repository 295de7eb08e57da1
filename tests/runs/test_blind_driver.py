"""A driver that ignores pixels fails every shipped suite: what a suite passes has looked
(docs/experiments/verdict-error.md).
"""

from pathlib import Path

import pytest

from alpasim_plugin import load_scenario, make_policy, make_renderer, run_rollout
from evaluators import reduce_rollout, score
from scenarios.suite import expand
from tests.runs.grey_renderer import GREY

# Suite -> a scene of it that cannot be passed by following the route.
NEEDS_EYES = {
    "first": "hard/hard_brake",
    "smoke": "hard/hard_brake",
    "gate_self_test": "hard/hard_brake",
    "urban": "urban/behind_bus",
    "highway": "highway/congestion",
    "hard": "hard/stop_and_go",
}


def entry_of(suite, scene):
    """Return the entry of a suite that names a scene."""
    folder, stem = scene.split("/")
    entries = expand(f"suites/{suite}")
    return next(one for one in entries if Path(one.path).parts[-2:] == (folder, f"{stem}.yaml"))


def test_every_suite_has_a_scene_that_needs_eyes():
    for suite, scene in NEEDS_EYES.items():
        entry_of(suite, scene)


@pytest.mark.parametrize("suite", ["first", "urban", "highway", "hard"])
def test_a_driver_that_follows_the_route_and_sees_nothing_collides(suite):
    ref = entry_of(suite, NEEDS_EYES[suite])
    scenario = load_scenario(
        ref.path, ref.seed, [*ref.overrides, "cameras=[{width: 32, height: 18}]"]
    )
    recorder = run_rollout(
        scenario, make_renderer(GREY, scenario), make_policy("pure-pursuit", scenario), seed=0
    )
    values = reduce_rollout(score(recorder.log(), scenario.scene), "paper").values
    assert values["collision_at_fault"].value == 1.0


def test_every_shipped_suite_is_listed():
    shipped = {
        path.stem for path in (Path(__file__).parents[2] / "scenarios" / "suites").glob("*.yaml")
    }
    assert shipped - {"all"} == set(NEEDS_EYES)  # `all` is the union of the others
