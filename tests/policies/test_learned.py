"""The learned policy: its image input, its command input, and that its plan depends on the
image.
"""

import json
from dataclasses import asdict, replace

import cv2
import numpy as np
import pytest
import torch

from alpasim_plugin.cameras.lens import resized
from alpasim_plugin.core.errors import InputError, PolicyError
from alpasim_plugin.core.files.atomic import write_safetensors
from alpasim_plugin.core.geometry import inverse, se2, transform_points
from alpasim_plugin.core.types import EgoState, Observation
from alpasim_plugin.runs.renderer import make_renderer
from alpasim_plugin.runs.rollout import run_rollout
from policies.base import make_policy
from policies.conformance import STRAIGHT, canned_scenario, observations
from policies.learned import Learned
from policies.learned_input import (
    FRONT,
    SIDES,
    level_view,
    route_command,
    view_camera,
    view_homography,
)
from policies.learned_net import (
    LearnedNet,
    load_net,
    save_net,
)
from policies.learned_views import DeviceView
from policies.painted_road import PaintedRoad, pinhole_camera
from scenarios.load import load_scenario
from tests.policies.policy_world import CAMERA, observe, scenario_with

ROAD = PaintedRoad()


# --- the view


def test_point_of_the_world_has_its_place_in_the_view_whatever_the_camera():
    point = np.array([20.0, -3.0, 0.4])
    for camera in (
        pinhole_camera(),
        pinhole_camera(hfov_deg=50.0, pitch_deg=6.0),
        pinhole_camera(width=1280, height=720),
    ):
        for turn in (-0.1, 0.0, 0.1):
            in_camera = transform_points(inverse(camera.T_rig_camera), point[None])[0]
            pixel = camera.K @ in_camera
            view = np.linalg.inv(view_homography(camera, turn)) @ pixel
            ahead = se2(0.0, 0.0, turn)[:3, :3].T @ (point - camera.T_rig_camera[:3, 3])
            wanted = [
                FRONT.width / 2 - FRONT.focal_px * ahead[1] / ahead[0],
                FRONT.horizon_row - FRONT.focal_px * ahead[2] / ahead[0],
            ]
            np.testing.assert_allclose(view[:2] / view[2], wanted, atol=1e-9)


def test_views_meet_at_their_edges_and_a_missing_camera_is_named():
    cameras = [view_camera(canned_scenario(), view) for view in (FRONT, *SIDES)]
    assert [camera.name for camera in cameras] == ["front", "left", "right"]
    far = 1e6 * np.array([np.cos(np.deg2rad(30.0)), np.sin(np.deg2rad(30.0)), 0.0])
    columns = []
    for view, camera in zip((FRONT, SIDES[0]), cameras, strict=False):
        pixel = camera.K @ transform_points(inverse(camera.T_rig_camera), far[None])[0]
        seen = np.linalg.inv(view_homography(camera, 0.0, view)) @ pixel
        assert seen[1] / seen[2] == pytest.approx(view.horizon_row, abs=1e-3)
        columns.append((seen[0] / seen[2] - view.width / 2) / view.focal_px)
    np.testing.assert_allclose(np.degrees(np.arctan(columns)), [-30.0, 30.0], atol=1e-3)
    with pytest.raises(InputError, match="right"):
        view_camera(canned_scenario(canned_scenario().cameras[:2]), SIDES[1])


# --- the command


def route_with_turn(after_m, radius_m, left, lateral_m=0.0):
    s = 80 / 19 * np.arange(20)
    arc = np.clip((s - after_m) / radius_m, 0.0, np.pi / 2)
    beyond = np.maximum(s - after_m - radius_m * np.pi / 2, 0.0)
    x = np.minimum(s, after_m) + radius_m * np.sin(arc)
    y = radius_m * (1 - np.cos(arc)) + beyond
    return np.stack([x, (y if left else -y) + lateral_m, np.zeros(20)], axis=1)


@pytest.mark.parametrize("left", [True, False])
def test_turn_is_announced_and_then_due(left):
    word = "left" if left else "right"
    assert route_command(route_with_turn(25.0, 10.0, left)) == f"{word}-ahead"
    assert route_command(route_with_turn(3.0, 10.0, left)) == f"{word}-now"
    assert route_command(route_with_turn(60.0, 10.0, left)) == "keep"


@pytest.mark.parametrize("radius_m", [1e6, 200.0, 50.0])
def test_bend_of_the_road_itself_is_no_turn(radius_m):
    assert route_command(route_with_turn(10.0, radius_m, left=True)) == "keep"


def test_route_that_is_over_or_absent_gives_keep():
    route = route_with_turn(3.0, 10.0, True)
    route[3:] = np.nan
    assert route_command(route) == "keep"
    assert route_command(np.full((20, 3), np.nan)) == "keep"


# --- the network


def test_weights_survive_the_disk_and_foreign_ones_are_refused(tmp_path):
    net = LearnedNet(3, (FRONT, *SIDES))
    path = tmp_path / "net.safetensors"
    save_net(net, path, {})
    assert load_net(path).views == (FRONT, *SIDES)
    for name, value in load_net(path).state_dict().items():
        torch.testing.assert_close(value, net.state_dict()[name], atol=1e-3, rtol=1e-3)
    with pytest.raises(InputError, match="no such file"):
        Learned(scenario_with(), weights=tmp_path / "absent")
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(InputError, match="not safetensors"):
        Learned(scenario_with(), weights=path)
    del net.word
    save_net(net, path, {})
    with pytest.raises(InputError, match=r"first word\.weight"):
        Learned(scenario_with(), weights=path)
    for views in ('[{"name": "front"}]', "[]", json.dumps([asdict(FRONT) | {"width": 10**9}])):
        write_safetensors(path, LearnedNet().state_dict(), {"views": views})
        with pytest.raises(InputError, match="views"):
            Learned(scenario_with(), weights=path)


# --- the policy


def drive(policy, seed=0):
    policy.reset(seed, policy_route())
    return [np.column_stack([p.xy, p.yaw]) for p in (policy.act(o) for o in seen())]


def seen():
    return list(observations(STRAIGHT, {CAMERA.name: CAMERA}))


def policy_route():
    return scenario_with().route


def test_seeds_drive_differently_and_a_seed_alike():
    policy = Learned(scenario_with())
    first = drive(policy, 1)
    again = drive(policy, 1)
    other = drive(policy, 2)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    apart = max(np.abs(a - b).max() for a, b in zip(first, other, strict=True))
    assert 0.01 < apart < 8.0
    lateral = max(np.abs(a[:, 1] - b[:, 1]).max() for a, b in zip(first, other, strict=True))
    assert lateral < 2.5


@pytest.mark.slow
def test_temperature_zero_is_the_mean_for_every_seed():
    policy = make_policy("learned-mean", scenario_with())
    assert isinstance(policy, Learned)
    for a, b in zip(drive(policy, 1), drive(policy, 2), strict=True):
        np.testing.assert_array_equal(a, b)
    warm = Learned(scenario_with(), temperature=1.0)
    many = np.mean([drive(warm, seed)[-1] for seed in range(10)], axis=0)
    np.testing.assert_allclose(many[:, :2], drive(policy)[-1][:, :2], atol=1.2)
    for bad in (-1.0, float("nan")):
        with pytest.raises(InputError, match="temperature"):
            Learned(scenario_with(), temperature=bad)


def test_number_of_threads_does_not_change_a_bit():
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = drive(Learned(scenario_with()))
        torch.set_num_threads(2)
        two = drive(Learned(scenario_with()))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)


def test_plan_follows_the_pixels_and_not_the_route():
    policy = Learned(scenario_with(), temperature=0.0)
    observation = seen()[0]
    plan = policy.act(observation)
    beside = Observation(
        **{**observation.__dict__, "route_rig": observation.route_rig + np.array([0.0, 0.9, 0.0])}
    )
    policy.reset(0, policy_route())
    np.testing.assert_array_equal(plan.xy, policy.act(beside).xy)
    shifted = observe(
        np.roll(observation.frames[CAMERA.name].rgb, 16, axis=1),
        EgoState(observation.t_us, np.eye(4), 10.0),
    )
    policy.reset(0, policy_route())
    assert policy.act(shifted).xy[20, 1] < plan.xy[20, 1] - 0.3


def test_frames_of_one_camera_reach_no_other_view(tmp_path):
    """A black camera, and one whose every second frame is late, change their own history alone."""
    scenario = canned_scenario()
    net = LearnedNet(3, (FRONT, *SIDES))
    torch.nn.init.normal_(net.out.weight, std=0.1, generator=torch.Generator().manual_seed(0))
    save_net(net, tmp_path / "three.safetensors", {})
    cameras = {camera.name: camera for camera in scenario.cameras}
    observations_seen = list(observations(STRAIGHT, cameras))
    policy = Learned(scenario, weights=tmp_path / "three.safetensors")
    assert [sensor.camera for sensor in policy.sensors] == ["front", "left", "right"]

    def histories(change):
        policy.reset(0, scenario.route)
        for step, observation in enumerate(observations_seen):
            frames = {name: change(name, step) or f for name, f in observation.frames.items()}
            plan = policy.act(replace(observation, frames=frames))
        return plan, [list(history) for history in policy.histories]

    def black(name, step):
        frame = observations_seen[step].frames[name]
        return replace(frame, rgb=0 * frame.rgb) if name == "left" else None

    def late(name, step):
        return observations_seen[step - 1].frames[name] if name == "right" and step % 2 else None

    plan, untouched = histories(lambda name, step: None)
    for change, changed in ((black, 1), (late, 2)):
        other, seen = histories(change)
        assert not np.array_equal(other.xy, plan.xy)
        for view, (a, b) in enumerate(zip(untouched, seen, strict=True)):
            same = len(a) == len(b) and all(
                t == u and np.array_equal(x, y) for (t, x), (u, y) in zip(a, b, strict=True)
            )
            assert same == (view != changed)


def test_wrong_frame_is_refused():
    policy = Learned(scenario_with())
    with pytest.raises(PolicyError, match=r"\(10, 10\)"):
        policy.act(observe(np.zeros((10, 10, 3), dtype=np.uint8), EgoState(0, np.eye(4), 5.0)))


def test_command_says_nothing_about_the_place_in_the_lane():
    for after_m in (3.0, 25.0):
        words = {
            route_command(route_with_turn(after_m, 12.0, True, lateral_m))
            for lateral_m in (-1.5, -0.3, 0.0, 1.5)
        }
        assert len(words) == 1


def test_the_policy_cuts_the_views_that_it_was_trained_on():
    image = seen()[3].frames[CAMERA.name].rgb
    for shown in (image, cv2.resize(image, (1280, 720))):
        camera = resized(CAMERA, *shown.shape[1::-1])
        found = DeviceView(camera, FRONT, torch.device("cpu"))(torch.tensor(shown))
        levels = np.abs(found.permute(1, 2, 0).numpy() - level_view(shown, camera))
        assert levels.max() <= 2
        assert (levels > 1).mean() < 2e-3


def test_a_policy_of_a_device_fetches_no_image_and_drives_as_on_the_host(monkeypatch):
    pretended = pytest.importorskip("tests.pretended_device")
    scenario = load_scenario(
        "smoke/curve", 0, ["timing.duration_us=500000", "timing.warmup_us=100000"]
    )
    egos = []
    down = []
    with pretended.pretended_device(monkeypatch, computes=False) as traffic:
        for device in (True, False):
            policy = Learned(scenario)
            policy.sensors = [replace(one, device=device) for one in policy.sensors]
            renderer = make_renderer("clean", scenario, 0, "cuda:0")
            traffic.reset()
            egos.append(run_rollout(scenario, renderer, policy).log(images=False).ego.xyz)
            down.append(traffic.bytes_down)
    np.testing.assert_allclose(*egos, atol=1e-3)
    assert down[0] - down[1] == 19 * 4 * 5  # what the network says, at each query
