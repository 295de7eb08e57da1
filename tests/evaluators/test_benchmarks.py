"""Scores of other benchmarks in small worlds, whose numbers follow from their definitions by
hand.
"""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.types import LoggedPlan
from evaluators import PRESETS, reduce_rollout, score
from tests.evaluators.eval_build import TWO_LANES, car, lane, road_map, rollout, scene, track
from tests.evaluators.motions import CRUISE, N, braking


def values(log, preset, where=TWO_LANES, **more):
    one = replace(scene(where, log), **more)
    found = reduce_rollout(score(log, one, preset), preset).values
    return {name: value.value if value.valid else value.reason for name, value in found.items()}


def values_per_step(log, name):
    return next(one.value for one in score(log, scene(TWO_LANES, log)) if one.name == name)


LIMITED = road_map(
    *(replace(one, speed_limit_mps=7.0) for one in TWO_LANES.lanes.values()),
    edges=TWO_LANES.road_edges,
)


def test_nuplan_of_a_clean_drive_is_known_only_where_the_speed_limits_are():
    log = rollout(track(CRUISE, 0.0))
    free = values(log, "nuplan")
    assert free["nuplan_score"] == "not measured: the speed limits of the lanes"
    assert (free["nuplan_score_least"], free["nuplan_score_most"]) == (0.75, 1.0)
    limited = values(log, "nuplan", LIMITED)
    assert limited["nuplan_speed_limit"] == pytest.approx(1 - 1 / 2.23)
    assert limited["nuplan_score"] == pytest.approx((5 + 5 + 4 * (1 - 1 / 2.23) + 2) / 16)


def test_nuplan_of_a_hard_stop_loses_progress_and_comfort_but_nothing_else():
    found = values(braking(), "nuplan", LIMITED)
    assert (
        found["nuplan_no_at_fault_collision"]
        == found["nuplan_driving_direction"]
        == found["nuplan_drivable_area"]
        == 1.0
    )
    assert found["nuplan_comfort"] == 0.0
    assert found["nuplan_progress"] == pytest.approx((8 * 2.5 + 6.4) / 63.2, abs=0.01)
    assert found["nuplan_making_progress"] == 1.0


def test_a_multiplier_of_zero_decides_whatever_else_is_missing():
    log = rollout(track(CRUISE, 0.0), [car("stands", track(np.full(N, 40.0), 0.0))])
    assert values(log, "nuplan")["nuplan_score"] == 0.0
    assert values(log, "navsim")["navsim_pdms"] == values(log, "navsim")["navsim_epdms"] == 0.0


def test_an_object_costs_a_half_and_an_actor_that_runs_into_the_ego_nothing():
    cone = replace(car("cone", track(np.full(N, 40.0), 0.0)), label="other")
    assert (
        values(rollout(track(CRUISE, 0.0), [cone]), "nuplan")["nuplan_no_at_fault_collision"] == 0.5
    )
    chaser = car("chaser", track(np.linspace(-12.0, 70.0, N), 0.0))
    assert (
        values(rollout(track(CRUISE, 0.0), [chaser]), "nuplan")["nuplan_no_at_fault_collision"]
        == 1.0
    )


def cut(road, x, connected=True):
    """The same lanes, each cut in two at some place along it."""
    parts = []
    for one in road.lanes.values():
        halves = [
            lane(name, one.centre[0, 1], x0=x0, x1=x1)
            for name, x0, x1 in ((f"{one.lane_id} a", -50.0, x), (f"{one.lane_id} b", x, 200.0))
        ]
        ahead = (halves[1].lane_id,) if connected else ()
        parts += [replace(halves[0], successors=ahead), halves[1]]
    return road_map(*parts, edges=road.road_edges)


def test_a_seam_between_connected_lanes_is_not_several_lanes():
    """A car drives into the ego's side while the ego crosses the end of its lane."""
    hit = car("hits", track(CRUISE, np.maximum(9.0 - 0.2 * np.arange(N), 1.0)))
    log = rollout(track(CRUISE, 0.0), [hit])
    seam = float(CRUISE[np.argmax(values_per_step(log, "collision_lateral") > 0)])
    gap = replace(PRESETS["nuplan"], seam_m=0.0)
    for where, wanted in (
        (TWO_LANES, 1.0),
        (cut(TWO_LANES, seam), 1.0),
        (cut(TWO_LANES, seam, connected=False), 0.0),
    ):
        for preset in (PRESETS["nuplan"], gap):
            assert values(log, preset, where)["nuplan_no_at_fault_collision"] == wanted


def test_strict_blames_the_ego_by_nuplans_rules_and_paper_by_the_side_alone():
    """Who is hit at its side while it keeps its lane is not at fault; who changes lanes is."""
    t = np.arange(N)
    hit = car("hits", track(CRUISE + 1.0, np.maximum(9.0 - 0.2 * t, 1.0)))
    for y, guilty in ((0.0, 0.0), (1.0, 1.0)):
        log = rollout(track(CRUISE, y), [hit])
        strict, paper = (values(log, preset) for preset in ("strict", "paper"))
        assert (strict["collision_lateral"], strict["collision_at_fault"]) == (1.0, guilty)
        assert paper["collision_at_fault"] == 1.0
        assert strict["offroad_or_collision_at_fault"] == guilty
    stands = rollout(track(np.full(N, 20.0), 1.0), [car("hits", track(CRUISE, 1.0))])
    assert values(stands, "strict")["collision_at_fault"] == 0.0
    parked = rollout(track(CRUISE, 0.0), [car("stands", track(np.full(N, 30.0), 0.0))])
    assert values(parked, "strict")["collision_at_fault"] == 1.0


def test_driving_against_the_lane_costs_the_direction_and_a_short_way_back_does_not():
    against = rollout(track(CRUISE[::-1], 0.0, yaw=np.pi))
    assert values(against, "nuplan")["nuplan_driving_direction"] == 0.0
    back = rollout(
        track(np.append(CRUISE[:-10], CRUISE[-11] - 0.15 * np.arange(10)), 0.0),
        log=track(CRUISE, 0.0),
    )
    assert values(back, "nuplan")["nuplan_driving_direction"] == 1.0


def test_leaving_the_road_by_20_cm_is_within_nuplans_area_and_not_within_navsims():
    y = np.full(N, -1.75 + 0.9 - 0.2)  # half the car is 0.9 m
    log = rollout(track(CRUISE, y), box=replace(car("a", track(0.0, 0.0)).box, width_m=1.8))
    assert (values(log, "nuplan")["nuplan_drivable_area"], values(log, "navsim")["navsim_dac"]) == (
        1.0,
        0.0,
    )


def test_navsim_names_what_is_missing_and_keeps_the_middle_of_the_lane():
    log = rollout(track(CRUISE, np.where(np.arange(N) < 30, 0.6, 0.0)))
    found = values(log, "navsim")
    assert found["navsim_lk"] == 0.0
    assert (
        values(rollout(track(CRUISE, np.where(np.arange(N) < 15, 0.6, 0.0))), "navsim")["navsim_lk"]
        == 1.0
    )
    assert "traffic lights" in found["navsim_epdms"]
    assert found["navsim_pdms"] == pytest.approx(
        (5 + 5) / 12
    )  # it reads no traffic lights; the jump to the side is no comfort


@pytest.mark.parametrize(
    ("driven_m", "recorded_m", "ep"),
    [
        (63.2, 63.2, 1.0),
        (31.6, 63.2, 0.5),
        (63.2, 47.4, 1.0),
        (2.0, 4.9, 1.0),
        (2.0, 5.1, 2.0 / 5.1),
        (-3.0, 40.0, 0.0),
    ],
)
def test_navsims_progress_is_the_share_of_the_greater_of_the_egos_and_the_recordings(
    driven_m, recorded_m, ep
):
    log = rollout(
        track(np.linspace(10.0, 10.0 + driven_m, N), 0.0),
        log=track(np.linspace(10.0, 10.0 + recorded_m, N), 0.0),
    )
    found = values(log, "navsim")
    assert found["navsim_ep"] == pytest.approx(ep, abs=1e-6)
    assert [found[f"navsim_{name}"] for name in ("nc", "dac", "ttc", "hc")] == [1.0] * 4
    assert found["navsim_pdms"] == pytest.approx((5 * ep + 5 + 2) / 12, abs=1e-6)


def plans(log, length_m, n=3):
    """Straight plans of 2 s at three times, each as long as given."""
    rig = rollout(log.ego).ego_log
    out = []
    for k in (5, 20, 35)[:n]:
        ahead = track(
            np.linspace(0.0, length_m, 21) + rig.xyz[k, 0],
            0.0,
            t_us=log.ego.t_us[k] + 100_000 * np.arange(21),
        )
        out.append(LoggedPlan(int(log.ego.t_us[k]), int(log.ego.t_us[k]), ahead))
    return replace(log, plans=tuple(out))


def test_what_a_scene_does_not_know_is_not_measured_and_never_zero():
    log = rollout(track(CRUISE, 0.0))
    bare = values(log, "nuplan", replace(TWO_LANES, lanes={}, road_edges=()))
    assert bare["nuplan_drivable_area"] == bare["nuplan_driving_direction"] == "not measured: a map"
    assert values(replace(log, force_gt_us=10**9), "nuplan")["nuplan_score"].startswith(
        "the policy never took over"
    )


def replanned(speeds_mps, log=None):
    """Straight plans of 4.5 s every 0.5 s, each at a speed of its own from where the ego is."""
    log = log or rollout(track(CRUISE, 0.0))
    out = []
    for k, speed in zip(range(0, N - 1, 5), speeds_mps, strict=False):
        ahead = track(
            CRUISE[k] + speed * 0.1 * np.arange(46),
            0.0,
            t_us=log.ego.t_us[k] + 100_000 * np.arange(46),
        )
        out.append(LoggedPlan(int(log.ego.t_us[k]), int(log.ego.t_us[k]), ahead))
    return replace(log, plans=tuple(out))


def test_extended_comfort_is_the_share_of_plans_that_move_as_the_one_half_a_second_before():
    assert values(replanned([8.0] * 8), "navsim")["navsim_ec"] == 1.0
    brakes = []
    for k, one in enumerate(replanned([8.0] * 8).plans):  # every third one would brake with 3 m/s2
        slower = one.trajectory.xyz.copy()
        slower[:, 0] -= 1.5 * (0.1 * np.arange(46)) ** 2 * (k % 3 == 2)
        brakes.append(replace(one, trajectory=replace(one.trajectory, xyz=slower)))
    log = replace(rollout(track(CRUISE, 0.0)), plans=tuple(brakes))
    assert values(log, "navsim")["navsim_ec"] == pytest.approx(
        3 / 7
    )  # of 7 pairs those after a change are not alike
    swerve = [
        replace(
            one,
            trajectory=replace(
                one.trajectory, quat=track(0.0, 0.0, n=46, yaw=0.2 * k * 0.1 * np.arange(46)).quat
            ),
        )
        for k, one in enumerate(replanned([8.0] * 8).plans)
    ]
    assert (
        values(replace(log, plans=tuple(swerve)), "navsim")["navsim_ec"] == 0.0
    )  # each turns 0.2 rad/s faster


def test_plans_that_are_too_short_or_too_coarse_have_no_extended_comfort():
    short = plans(rollout(track(CRUISE, 0.0)), 16.0)
    assert "two plans 0.5 s apart" in values(short, "navsim")["navsim_ec"]
    one = replace(short, plans=replanned([8.0]).plans)
    assert "two plans 0.5 s apart" in values(one, "navsim")["navsim_ec"]
    fine = [(p, p.trajectory) for p in replanned([8.0] * 8).plans]
    every = [
        replace(
            p, trajectory=replace(one, t_us=one.t_us[::5], xyz=one.xyz[::5], quat=one.quat[::5])
        )
        for p, one in fine
    ]
    assert (
        "two plans 0.5 s apart" in values(replace(short, plans=tuple(every)), "navsim")["navsim_ec"]
    )
