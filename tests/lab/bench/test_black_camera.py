"""Three cameras in the loop: who comes from a side is let pass, unless that side's camera is
black.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml

from alpasim_plugin import make_renderer, run_rollout
from alpasim_plugin.core.geometry import trajectory_from_poses
from alpasim_plugin.core.types import EgoState, Frame, Observation
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


def test_the_policy_is_handed_a_black_image_of_its_camera_alone(tmp_path, monkeypatch):
    """Images that lie on a device beside the frames are black as well."""
    path = tmp_path / "scene.yaml"
    path.write_text(yaml.safe_dump(row_of_cars("left")))
    scenario = load_scenario(path)
    observations = []
    monkeypatch.setattr(
        LearnedThree, "act", lambda policy, observation: observations.append(observation)
    )
    policy = BlackLeft(scenario, temperature=0.0)
    names = [sensor.camera for sensor in policy.sensors]
    grey = np.full((4, 6, 3), 90, dtype=np.uint8)
    state = EgoState(0, np.eye(4), 5.0)
    observation = Observation(
        0,
        {name: Frame(0, name, grey) for name in names},
        {camera.name: camera for camera in scenario.cameras},
        state,
        trajectory_from_poses([0], state.T_world_rig[None]),
        np.full((20, 3), np.nan),
    )
    policy.act(observation)
    policy.act(replace(observation, images={name: torch.tensor(grey) for name in names}))
    for received in observations:
        levels = {name: int(received.image(name).max()) for name in names}
        assert levels == {name: 0 if name == "left" else 90 for name in names}


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
