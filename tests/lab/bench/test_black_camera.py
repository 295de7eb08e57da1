"""Three cameras in the loop: who comes from a side is let pass, unless that side's camera is
black.
"""

import pytest
import yaml

from alpasim_plugin import make_renderer, run_rollout
from alpasim_plugin.lab.bench.black_camera import BlackLeft, BlackRight
from evaluators import contact_events
from policies.learned import LearnedThree
from scenarios.load import load_scenario

SCENE = """
version: 1
timing: {duration_us: 6500000}
road:
  heading_deg: 0
  segments:
  - {kind: straight, length_m: 48}
  - {kind: intersection, arm_length_m: 90.0}
  - {kind: straight, length_m: 60}
ego: {speed_mps: 7.5, cruise_mps: 7.5}
environment: {buildings: 0, trees_per_100m: 0, poles_spacing_m: 0}
cameras:
- {name: front}
- {name: left, hfov_deg: 85, y_m: 0.5, yaw_deg: 60}
- {name: right, hfov_deg: 85, y_m: -0.5, yaw_deg: -60}
"""
SPEED_MPS = 13.0
HEADWAY_S = 1.2


def row_of_cars(side):
    """Return a scene in which four cars cross from a side while the ego would."""
    down, x_m, first_s = (-1, 58.5, 4.4) if side == "left" else (1, 62.0, 4.6)
    spec = yaml.safe_load(SCENE)
    spec["actors"] = []
    for i in range(4):
        arrives_s = first_s + i * HEADWAY_S
        points = [[t, x_m, down * SPEED_MPS * (t - arrives_s), down * 1.5708] for t in (0.0, 20.0)]
        spec["actors"].append({"kind": "logged", "id": f"crosses-{i}", "points": points})
    return spec


@pytest.mark.slow
@pytest.mark.parametrize("side", ["left", "right"])
def test_a_row_of_cars_is_let_pass_unless_the_camera_on_its_side_is_black(side, tmp_path):
    path = tmp_path / f"from_the_{side}.yaml"
    path.write_text(yaml.safe_dump(row_of_cars(side)))
    scenario = load_scenario(path)

    def contacts(policy):
        renderer = make_renderer("clean", scenario, seed=0)
        log = run_rollout(scenario, renderer, policy(scenario, temperature=0.0)).log()
        return [event.actor_id for event in contact_events(log)]

    black, other = (BlackLeft, BlackRight) if side == "left" else (BlackRight, BlackLeft)
    assert contacts(LearnedThree) == []
    assert contacts(other) == []
    assert contacts(black) != []
