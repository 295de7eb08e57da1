"""Road users who wait for the ego, and those who act against it."""

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import se2
from alpasim_plugin.core.types import EgoState
from alpasim_plugin.world.actors import make_actors
from scenarios.load import load_scenario
from tests.examples import first_rows_of

STEP_US = 100_000


def scene(folder, actor):
    file = folder / "scene.yaml"
    file.write_text(
        "version: 1\nroad: {lanes_forward: 2, segments: [{kind: straight, length_m: 300}]}\n"
        f"ego: {{lane: 0, start_m: 10, speed_mps: 10, cruise_mps: 10}}\nactors: [{actor}]\n"
        f"timing: {{duration_us: 12000000}}\n",
        encoding="utf-8",
    )
    return load_scenario(file)


def driven(made, speed_mps):
    """Drive the ego straight ahead at a speed; return times, its front, and the actor's places."""
    actors = make_actors(made)
    begin = made.ego_log.xyz[0]
    rows = []
    for t_us in range(0, made.end_us, STEP_US):
        x = begin[0] + speed_mps * t_us * 1e-6
        pose = se2(float(x), float(begin[1]), 0.0)
        found = actors.step(t_us, EgoState(t_us, pose, speed_mps))
        forecast = actors.forecast().at(t_us)
        (place,) = found.values()
        assert np.allclose(next(iter(forecast.values())), place)
        front = x + made.vehicle.rear_axle_to_centre_m + made.vehicle.box.length_m / 2
        rows.append((t_us * 1e-6, front, *place[:2, 3]))
    return np.array(rows).T


WALKER = "{kind: crossing_pedestrian, id: p, s_m: 60, before_ego_s: 0.0%s}"


def test_a_pedestrian_who_yields_lets_the_ego_pass_and_walks_on(tmp_path):
    made = scene(tmp_path, WALKER % ", yields: true")
    plain = scene(tmp_path, WALKER % "")
    half = made.vehicle.box.width_m / 2
    for one, waits in ((made, True), (plain, False)):
        _, front, x, y = driven(one, 10.0)
        lane_y = one.ego_log.xyz[0, 1]
        beside = (front > x) & (front - one.vehicle.box.length_m < x)
        hit = beside & (np.abs(y - lane_y) < half + 0.3)
        assert hit.any() != waits
        assert y[-1] > lane_y + half
    assert plain.content_hash != made.content_hash


def test_a_pedestrian_walks_before_an_ego_that_stands(tmp_path):
    made = scene(tmp_path, WALKER % ", yields: true")
    plain = scene(tmp_path, WALKER % "")
    assert np.allclose(driven(made, 0.0), driven(plain, 0.0))


CUT_IN = (
    "{kind: cut_in, id: c, from_lane: 1, to_lane: 0, s_m: 24, speed_mps: 9, at_us: 3000000,"
    " change_us: 2000000, end_speed_mps: 5, decel_mps2: 4%s}"
)
BRAKE = "{kind: hard_brake, id: b, s_m: 24, speed_mps: 9, brake_at_us: 5000000, decel_mps2: 4%s}"


@pytest.mark.parametrize(("actor", "ego_mps"), first_rows_of([(CUT_IN, 7.0), (BRAKE, 10.0)]))
def test_an_adversary_acts_at_its_gap_before_the_ego_whatever_its_speed(tmp_path, actor, ego_mps):
    made = scene(tmp_path, actor % ", role: adversary, gap_m: 8")
    t, front, x, _ = driven(made, ego_mps)
    rear = x - made.actors[0].box.length_m / 2
    act_m = np.interp(5.0, *(scripted := driven(scene(tmp_path, actor % ""), ego_mps))[[0, 2]])
    act = int(np.searchsorted(x, act_m))
    assert rear[act] - front[act] == pytest.approx(8.0, abs=1.0)
    assert not np.allclose(x, scripted[2])
    speed = np.diff(x) / np.diff(t)
    assert speed[:act].min() > 3.7
    assert speed.max() < 13.6
    assert (np.diff(speed) / 0.1).min() > -4.5
    assert speed[-1] == pytest.approx(5.0 if actor is CUT_IN else 0.0, abs=0.3)


@pytest.mark.parametrize("actor", [WALKER % ", role: adversary", BRAKE % ", yields: true"])
def test_keys_of_other_actors_are_refused(tmp_path, actor):
    with pytest.raises(InputError):
        scene(tmp_path, actor)
