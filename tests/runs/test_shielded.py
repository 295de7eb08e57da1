"""What a part of the user's receives it cannot change for others."""

import numpy as np
import pytest

from alpasim_plugin.core.parts import build, resolve
from alpasim_plugin.core.types import shielded
from policies.simple import ConstantVelocity
from scenarios.load import load_scenario

SCENE = load_scenario("smoke/lead_car", overrides=("timing.duration_us=600000",))


class Mover(ConstantVelocity):
    """Moves whatever the scenario holds."""

    def __init__(self, scenario):
        self.scenario = scenario


def arrays(value, found):
    if isinstance(value, np.ndarray):
        found.append(value)
    elif isinstance(value, tuple | list):
        for item in value:
            arrays(item, found)
    elif isinstance(value, dict):
        for item in value.values():
            arrays(item, found)
    elif hasattr(value, "__dataclass_fields__"):
        arrays(list(vars(value).values()), found)
    return found


def test_a_policy_cannot_write_what_its_scenario_holds():
    policy = build(resolve("policy", f"{__name__}:Mover"), scenario=SCENE)
    held = arrays(policy.scenario, [])
    assert len(held) > 20
    assert not any(array.flags.writeable for array in held)
    policy.scenario.lane_map.lanes.clear()
    assert SCENE.lane_map.lanes
    with pytest.raises(ValueError, match="read-only"):
        policy.scenario.ego_log.xyz[:] = 0.0
    assert np.array_equal(shielded(SCENE).ego_log.xyz, SCENE.ego_log.xyz)
