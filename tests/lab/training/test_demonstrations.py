"""Demonstrations of the learned policy: drawn the same every time, kept once made, and enough to
learn from.
"""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.training.demonstrations import (
    DEMONSTRATIONS_FILE,
    DemonstrationRecipe,
    Demonstrations,
    common_views,
    read_demonstrations,
    write_demonstrations,
)
from alpasim_plugin.lab.training.perturbed_rollouts import (
    perturbed_rollouts,
    turning_lines,
)
from alpasim_plugin.lab.training.policy import PolicyRecipe, PolicyTask, start_from_front, train
from alpasim_plugin.lab.training.trainer import Schedule, Trainer
from policies.conformance import canned_scenario
from policies.learned import WEIGHTS
from policies.learned_input import COMMANDS
from policies.learned_net import LearnedNet, load_net
from scenarios.load import load_scenario
from tests.interrupted_folder import kill_between_renames
from tests.pretended_device import pretended_device, traffic

BARE = ("environment.buildings=0", "environment.trees_per_100m=0", "environment.poles_spacing_m=0")
QUICK = DemonstrationRecipe(drives=1, drive_s=1.6, headings=3)


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("smoke/lead_car", overrides=BARE)


@pytest.fixture(scope="module")
def root(scenario, tmp_path_factory):
    folder = tmp_path_factory.mktemp("demonstrations")
    assert write_demonstrations(scenario, folder / "train" / "lead_000", QUICK, 0)
    return folder


@pytest.fixture(scope="module")
def three(scenario, root):
    """Give demonstrations of a scene with cameras to both sides."""
    sides = canned_scenario().cameras[1:]
    wide = replace(scenario, cameras=(*scenario.cameras, *sides))
    write_demonstrations(wide, root / "three" / "lead_000", QUICK, 0)
    (demonstrations,) = read_demonstrations(root, "three")
    return demonstrations


def test_a_scene_whose_replacement_was_killed_is_still_there(scenario, root, tmp_path):
    folder = shutil.copytree(root / "train" / "lead_000", tmp_path / "train" / "lead_000")
    kill_between_renames(folder)
    assert not write_demonstrations(scenario, folder, QUICK, 0)
    kill_between_renames(folder)
    assert [one.folder for one in read_demonstrations(tmp_path, "train")] == [folder]


def test_finished_scene_is_kept_and_another_seed_makes_it_anew(scenario, root):
    folder = root / "train" / "lead_000"
    before = (folder / "frames_front.npy").stat().st_mtime_ns
    assert not write_demonstrations(scenario, folder, QUICK, 0)
    assert (folder / "frames_front.npy").stat().st_mtime_ns == before
    first = Demonstrations(folder)
    other = root / "other"
    write_demonstrations(scenario, other, QUICK, 0)
    assert_array_equal(first.frames[0], Demonstrations(other).frames[0])
    for name, array in first.arrays.items():
        assert_array_equal(array, Demonstrations(other).arrays[name])
    assert write_demonstrations(scenario, other, QUICK, 1)
    assert not np.array_equal(Demonstrations(other).arrays["yaw"], first.arrays["yaw"])


def test_sample_has_a_frame_a_state_and_a_target(root):
    (demonstrations,) = read_demonstrations(root, "train")
    a = demonstrations.arrays
    (frames,) = demonstrations.frames
    assert len(demonstrations) == len(a["frame"]) == 3 * len(frames) == 12
    assert frames.shape[1:] == (115, 348, 3)
    assert np.abs(a["yaw"]).max() <= np.deg2rad(8.5) + 1e-6
    assert (a["yaw"][::3] == 0).all()
    assert (a["before"] <= a["frame"]).all()
    assert set(a["command"].tolist()) == {COMMANDS.index("keep")}
    # A car rotated_about_camera to the left of its road is led to the right.
    turn, heading = (
        x.reshape(-1, 3) - x.reshape(-1, 3).mean(axis=1, keepdims=True)
        for x in (a["yaw"], a["headings"][:, -1])
    )
    assert np.corrcoef(turn.ravel(), heading.ravel())[0, 1] < -0.7


def test_scene_with_side_cameras_has_three_views_and_the_network_begins_as_the_front_one(
    three, root
):
    assert [view.name for view in three.views] == ["front", "left", "right"]
    assert len({len(frames) for frames in three.frames}) == 1
    with pytest.raises(InputError):
        common_views([three, *read_demonstrations(root, "train")])
    net = LearnedNet(0, three.views)
    front = load_net(WEIGHTS)
    start_from_front(net, front)
    batch = PolicyTask(net, [three], PolicyRecipe(batch=4)).batch(0)
    with torch.inference_mode():
        heading = net(batch.images, batch.state, batch.command).heading
        wanted = front(batch.images[:1], batch.state, batch.command).heading
    torch.testing.assert_close(heading, wanted, atol=1e-5, rtol=1e-5)


def test_several_cameras_are_trained_in_stages_and_a_run_that_was_stopped_ends_alike(
    three, tmp_path
):
    def trained(folder, report=None):
        net = LearnedNet(0, three.views)
        start_from_front(net, load_net(WEIGHTS))
        stages = train(net, [three], folder, 6, PolicyRecipe(batch=2), report)
        return net.state_dict(), [trainer for _, trainer in stages]

    def stop(step, numbers):
        if step == 5:
            assert (tmp_path / "stopped" / "sides").exists()
            raise KeyboardInterrupt

    whole, trainers = trained(tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path / "stopped", stop)
    again, _ = trained(tmp_path / "stopped")
    for name, weights in whole.items():
        assert torch.equal(weights, again[name])
    assert {one.folder.name: one.step for one in trainers} == {"front": 4, "sides": 1, "whole": 1}
    first = trainers[0].average
    assert not torch.equal(first["see.0.weight"], load_net(WEIGHTS).see[0].weight)
    assert torch.equal(first["see.0.weight"], whole["see.0.weight"])


def test_missing_and_damaged_demonstrations_are_named(root, tmp_path):
    with pytest.raises(InputError):
        read_demonstrations(root, "val")
    broken = tmp_path / "train" / "a"
    broken.mkdir(parents=True)
    (broken / DEMONSTRATIONS_FILE).write_text(
        (root / "train" / "lead_000" / DEMONSTRATIONS_FILE).read_text()
    )
    np.save(broken / "frames_front.npy", np.zeros((2, 3)))
    (damaged,) = read_demonstrations(tmp_path, "train")
    for part in ("frames", "arrays"):
        with pytest.raises(InputError):
            getattr(damaged, part)


def test_every_turn_of_a_junction_has_a_rollout():
    scenario = load_scenario("urban/junction_straight", overrides=BARE)
    lines = turning_lines(scenario)
    bends = sorted(round(float(np.degrees(path.yaw[-1] - path.yaw[0]))) for path, _ in lines)
    assert bends == [-90, 90]
    for path, begins_m in lines:
        before = path.yaw[path.s < begins_m - 0.5]
        assert np.ptp(before) < 0.02
    drives = list(perturbed_rollouts(scenario, 3, 3.0, 0))
    turned_by = [np.degrees(d.line.path.yaw[-1] - d.line.path.yaw[0]) for d in drives]
    assert sorted(np.round(turned_by)) == [-90, 0, 90]


def test_sigma_sends_no_gradient_into_the_plan(root):
    """The likelihood term must train sigma alone."""

    def gradients(sigma):
        net = LearnedNet(0)
        torch.nn.init.normal_(net.out.weight, std=0.02, generator=torch.Generator().manual_seed(0))
        torch.nn.init.constant_(net.out.bias[-2:], sigma)
        task = PolicyTask(net, read_demonstrations(root, "train"), PolicyRecipe(batch=4))
        task.loss(task.batch(0), 0)[0].backward()
        return net.out.weight.grad[:-2], net.out.weight.grad[-2:]

    (plan, sigma), (plan_again, other_sigma) = gradients(0.0), gradients(1.5)
    assert torch.equal(plan, plan_again)
    assert not torch.allclose(sigma, other_sigma)


def test_an_update_on_a_device_waits_once(root, tmp_path, monkeypatch):
    def update(device):
        net = LearnedNet(0).to(device)
        task = PolicyTask(net, read_demonstrations(root, "train"), PolicyRecipe(batch=4))
        trainer = Trainer(net, tmp_path / device, Schedule(1), task.batch, task.loss, {})
        traffic.reset()
        return trainer._update()["loss"]

    wanted = update("cpu")
    with pretended_device(monkeypatch):
        assert update("cuda") == pytest.approx(wanted, rel=1e-4)
        assert sum(traffic.waits.values()) == 1
