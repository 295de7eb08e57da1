"""nuPlan's metrics against the test vectors of its devkit, and in small worlds."""

import json
from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
import shapely

from evaluators.metrics import nuplan
from evaluators.metrics.presets import PRESETS
from evaluators.metrics.scored import ScoredRollout
from evaluators.metrics.states import EgoStates, Tracks, savitzky_golay, states_of
from tests.data_sets import shared_folder
from tests.evaluators.eval_build import TWO_LANES, VEHICLE, rollout, scene, scored, track

FIXTURES = shared_folder() / "nuplan-devkit-fixtures"
OF_PLANS = (
    "planner_expert_average_l2_error_within_bound",
    "planner_miss_rate_within_bound",
)  # they compare plans; the files hold drives
FILES = sorted(path for path in FIXTURES.glob("*/*.json") if path.parent.name not in OF_PLANS)
WIDTH_M, FRONT_M, REAR_M = 2.297, 4.049, 1.127  # of the devkit's vehicle, from its rear axle
SERIES = {f"ego_{name}": name for name in ("jerk", "lon_jerk", "lat_jerk", "yaw_rate")} | {
    "ego_acceleration": "accel",
    "ego_lon_acceleration": "lon_accel",
    "ego_lat_acceleration": "lat_accel",
    "ego_yaw_acceleration": "yaw_accel",
}


def states(rows):
    pose, velocity, accel = (
        np.array([row[key] for row in rows], dtype=float)
        for key in ("pose", "velocity", "acceleration")
    )
    t_us = np.array([row["time_us"] for row in rows])
    size = (FRONT_M + REAR_M, WIDTH_M)
    ahead_m = (FRONT_M - REAR_M) / 2
    return EgoStates(t_us, pose[:, :2], pose[:, 2], velocity, accel, accel, size, ahead_m)


def tracks(worlds):
    kinds = {
        "bicycles": "vru",
        "pedestrians": "vru",
        "vehicles": "vehicle",
        "genericobjects": "object",
    }
    ids = sorted(
        {(kind, one["id"]) for world in worlds for kind in kinds for one in world.get(kind, [])}
    )
    shape = (len(ids), len(worlds))
    there = np.zeros(shape, dtype=bool)
    xy = np.zeros((*shape, 2))
    yaw = np.zeros(shape)
    velocity = np.zeros((*shape, 2))
    size = np.ones((len(ids), 2))
    for t, world in enumerate(worlds):
        for kind in kinds:
            for one in world.get(kind, []):
                a = ids.index((kind, one["id"]))
                box = one["box"]
                there[a, t], xy[a, t], yaw[a, t], size[a] = (
                    True,
                    box["pose"][:2],
                    box["pose"][2],
                    box["size"][::-1],
                )
                velocity[a, t] = one["speed"] * np.array([np.cos(yaw[a, t]), np.sin(yaw[a, t])])
    return Tracks(
        tuple(f"{kind} {one}" for kind, one in ids),
        tuple(kinds[kind] for kind, _ in ids),
        there,
        xy,
        yaw,
        size,
        velocity,
    )


def devkit_statistics(values):
    """Greatest, least and mean, and the 90th percentile of the magnitudes, to two digits, as the
    devkit reports a series.
    """
    reduced = {"MAX": np.max(values), "MIN": np.min(values), "MEAN": np.mean(values)}
    reduced["P90"] = np.percentile(np.abs(values), 90, method="inverted_cdf")
    return {name: round(float(value), 2) for name, value in reduced.items()}


def found_statistics(name, scene):
    """The values that the devkit lists for a metric, in its order, as far as our definitions give
    them.
    """
    ego = states([scene["ego"], *scene.get("ego_future_states", [])])
    others = tracks([scene["world"], *scene.get("world_future_states", [])])
    hits = nuplan.collisions(ego, others)
    guilty = [one for one in hits if one.at_fault]
    if name in SERIES:
        of = devkit_statistics(nuplan.motion(ego)[SERIES[name]])
        return [of[kind] for kind, _ in scene["expected"]["statistics"] if kind != "BOOLEAN"]
    if name == "ego_mean_speed":
        return [devkit_statistics(ego.speed)["MEAN"]]
    if name == "ego_expert_l2_error":
        expert = states(scene["expert_ego_states"])
        of = devkit_statistics(np.hypot(*(ego.rear_xy - expert.rear_xy).T))
        return [of["MAX"], of["MEAN"], of["P90"]]
    if name == "no_ego_at_fault_collision":
        counts = [sum(one.kind == kind for one in guilty) for kind in ("vru", "vehicle", "object")]
        of = devkit_statistics(np.array([one.delta_v_mps for one in guilty])) if guilty else {}
        return [
            not guilty,
            len(guilty),
            *counts,
            *(of[kind] for kind in ("MAX", "MIN", "MEAN") if of),
        ]
    if name == "time_to_collision_within_bound":
        given = scene["metric_parameters"]
        least = nuplan.time_to_collision(
            ego, others, hits, None, given["time_step_size"], given["time_horizon"]
        ).min()
        return [round(least, 2), bool(least > given["least_min_ttc"])]
    raise AssertionError(f"no definition of ours is held to {name}")


@pytest.mark.skipif(not FILES, reason=f"the data set {FIXTURES} is absent")
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_the_devkits_test_vectors_give_its_series_to_all_printed_digits_and_its_statistics_nearly(
    path,
):
    scene = json.loads(path.read_text())
    name = path.parent.name
    expected = scene["expected"]
    got = found_statistics(name, scene)
    wanted = [
        value for kind, value in expected["statistics"] if name not in SERIES or kind != "BOOLEAN"
    ]
    # Two of the statistics printed there differ from ours by one unit of the second digit: 0.62 for
    # 0.63 and 0.71 for 0.72.
    assert got == pytest.approx(wanted, abs=0.015)
    if name in SERIES:
        values = nuplan.motion(states([scene["ego"], *scene["ego_future_states"]]))[SERIES[name]]
        assert np.round(values, 2).tolist() == expected["time_series"]["values"]


def test_when_boxes_touch_is_what_a_search_in_small_steps_finds():
    rng = np.random.default_rng(5)
    n = 200
    ego = EgoStates(
        np.arange(n) * 100_000,
        rng.uniform(-9, 9, (n, 2)),
        rng.uniform(-4, 4, n),
        np.column_stack([rng.uniform(0, 12, n), np.zeros(n)]),
        np.zeros((n, 2)),
        np.zeros((n, 2)),
        (5.0, 2.0),
        1.4,
    )
    shape = (1, n)
    velocity = rng.uniform(-9, 9, (*shape, 2)) * (rng.random((*shape, 1)) < 0.7)  # some stand
    others = Tracks(
        ("a",),
        ("vehicle",),
        np.ones(shape, dtype=bool),
        rng.uniform(-20, 20, (*shape, 2)),
        rng.uniform(-4, 4, shape),
        np.array([[4.0, 1.8]]),
        velocity,
    )
    everyone = np.zeros(n, dtype=np.int64)
    steps = np.arange(n)
    first_s, last_s = nuplan.touching_s(ego, others, everyone, steps)
    for after_s in np.arange(0.0, 4.0, 0.05):
        own = ego.boxes(ego.centre + after_s * ego.speed[:, None] * ego.heading, ego.yaw).shapes()
        hit = shapely.intersects(
            own,
            replace(others, xy=others.xy + after_s * others.velocity)
            .boxes(everyone, steps)
            .shapes(),
        )
        assert hit.tolist() == ((first_s <= after_s) & (after_s <= last_s)).tolist()


@pytest.mark.parametrize(("window", "order", "times"), [(8, 2, 0), (15, 2, 1), (5, 3, 2)])
@pytest.mark.parametrize("longer", [0, 1, 30])
def test_the_filter_is_scipys(window, order, times, longer):
    values = np.random.default_rng(longer).normal(size=window + longer).cumsum()
    want = scipy.signal.savgol_filter(values, window, order, times)
    np.testing.assert_allclose(savitzky_golay(values, window, order, times), want, atol=1e-12)


def slalom(rate, period_s):
    """Return a log whose rear axle drives 12 m/s, with a yaw rate that swings up to ``rate``."""
    t = 0.1 * np.arange(120)
    pulse = 2 * np.pi / period_s
    fine = np.arange(0.0, t[-1] + 0.1, 1e-3)
    yaw_fine = rate / pulse * (1 - np.cos(pulse * fine))
    xy_fine = 12.0 * np.cumsum(np.column_stack([np.cos(yaw_fine), np.sin(yaw_fine)]), axis=0) * 1e-3
    yaw = np.interp(t, fine, yaw_fine)
    rear = np.column_stack([np.interp(t, fine, column) for column in xy_fine.T])
    ahead_m = VEHICLE.rear_axle_to_centre_m
    centre = rear + ahead_m * np.column_stack([np.cos(yaw), np.sin(yaw)])
    turning = rate * np.sin(pulse * t)
    swing = ahead_m * np.column_stack([-(turning**2), rate * pulse * np.cos(pulse * t)])
    return rollout(track(*centre.T, yaw)), np.column_stack([0 * t, 12.0 * turning]) + swing


def test_the_acceleration_of_the_centre_holds_what_turning_adds():
    log, wanted = slalom(0.4, 4.0)
    ego, _ = states_of(log, PRESETS["nuplan"], log.ego, np.zeros(3))
    assert np.abs(ego.centre_accel - wanted)[3:-3].max() < 0.1
    assert np.abs(ego.accel - wanted)[3:-3, 1].max() > 0.8


def test_comfort_is_nuplans_at_the_centre_and_navsims_at_the_rear_axle():
    """Only at the centre the sideways acceleration is beyond 4.89 m/s2."""
    log, _ = slalom(0.408, 5.0)
    drive = ScoredRollout(log, scene(TWO_LANES, log), PRESETS["nuplan"], log.ego)
    peaks = [
        np.abs(nuplan.motion(drive.ego, place)["lat_accel"]).max()
        for place in ("rear_axle", "centre")
    ]
    bound = nuplan.COMFORT["lat_accel"][1]
    assert peaks[0] < bound < peaks[1]
    assert (drive.comfort("rear_axle"), drive.comfort("centre")) == (1.0, 0.0)
    protocols = {"nuplan": ("nuplan_comfort", 0.0), "navsim": ("navsim_hc", 1.0)}
    for preset, (metric, wanted) in protocols.items():
        assert scored(log, preset=preset)[metric].value[-1] == wanted


def test_a_collision_is_the_first_contact_with_each_road_user_in_order_of_time():
    n = 30
    x = np.arange(n, dtype=float)
    still = np.zeros((n, 2))
    velocity = np.column_stack([np.full(n, 10.0), np.zeros(n)])
    t_us = 100_000 * np.arange(n)
    rear_xy = np.column_stack([x, 0 * x])
    ego = EgoStates(t_us, rear_xy, 0 * x, velocity, still, still, (5.0, 2.0), 1.5)
    places = [(20.0, "object"), (10.0, "object"), (15.0, "vehicle")]
    users = Tracks(
        ids=("far", "near", "middle"),
        kinds=tuple(kind for _, kind in places),
        is_present=np.ones((3, n), dtype=bool),
        xy=np.array([np.tile([place, 0.0], (n, 1)) for place, _ in places]),
        yaw=np.zeros((3, n)),
        size=np.ones((3, 2)),
        velocity=np.zeros((3, n, 2)),
    )
    hits = nuplan.collisions(ego, users)
    # The nose is 4 m ahead of the rear axle, the side that it meets half a metre before the place.
    assert [(hit.actor, hit.step) for hit in hits] == [(1, 6), (2, 11), (0, 16)]
    assert all(hit.type == "stopped_track" and hit.at_fault for hit in hits)
    assert nuplan.collision_score(hits) == 0.0
    assert nuplan.collision_score(hits[:1]) == 0.5
    assert nuplan.collision_score([hits[0], hits[2]]) == 0.0
    assert nuplan.collision_score([]) == 1.0
