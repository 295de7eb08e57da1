"""`run --repeat`: a rollout of each policy is driven twice and the two logs are compared."""

import pytest

from alpasim_plugin.log.run_folder.manifests import read_run_json
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.repeat import repeat_line
from alpasim_plugin.runs.run import execute_run
from scenarios.suite import expand
from tests.runs.short_runs import Announced

BARE = ("environment.buildings=0", "environment.trees_per_100m=0", "environment.poles_spacing_m=0")
SHORT = "timing.duration_us=800000"
LONGER = "timing.duration_us=1200000"
FORGETFUL = "tests.runs.broken_policies:RemembersEarlierRollouts"


def plan_of(policies, *overrides):
    refs = [
        *expand("smoke/lead_car", (LONGER, *BARE, *overrides)),
        *expand("smoke/straight", (SHORT, *BARE, *overrides)),
    ]
    return make_plan(refs, ("clean",), policies.split(","), (0,), RunOptions(images="none"))


def repeated(plan, root):
    result = execute_run(plan, root, 1, ["simrun"], Announced(), repeat=True, report=False)
    found = read_run_json(root).repeat
    assert result.summary.repeat == found
    assert not list(root.glob("*repeat*"))
    return found


@pytest.mark.parametrize(
    "policy", ["constant-velocity", pytest.param("lane-camera", marks=pytest.mark.slow)]
)
def test_the_shortest_rollout_is_repeatable(tmp_path, policy):
    found = repeated(plan_of(policy), tmp_path)
    assert found.repeatable
    assert found.cell.scene == "smoke-straight"
    assert len(set(found.digests)) == 1


def test_a_policy_that_remembers_is_not_repeatable(tmp_path):
    found = repeated(plan_of(f"constant-velocity,{FORGETFUL}"), tmp_path)
    assert found.cell.policy == FORGETFUL
    assert found.repeatable is False
    assert found.first_difference.component == "plans"
    assert "NOT" in repeat_line(found)


def test_measured_latency_is_not_repeated(tmp_path):
    found = repeated(plan_of("constant-velocity", "latency.kind=measured"), tmp_path)
    assert found.repeatable is None
