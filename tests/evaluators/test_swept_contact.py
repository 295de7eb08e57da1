"""Preset ``strict``: contact between steps over whole rollouts, its time, place, side and actor,
and the twin on hard cases.
"""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import wrap_angle, yaw_from_quat
from alpasim_plugin.core.types import Box
from evaluators import PRESETS, reduce_rollout, score
from evaluators.metrics.collision import SIDES, contact_events
from evaluators.metrics.contact import PLACE_M, find_contacts, find_swept
from evaluators.metrics.footprint import ActorTable, ego_footprints, origin_of
from tests.evaluators.eval_build import (
    CAR,
    TWO_LANES,
    car,
    rollout,
    scene,
    scored,
    track,
    values_of,
)
from tests.evaluators.reference_rules import contacts_by_step
from tests.evaluators.reference_strict import Motion, first_touch, side_at
from tests.examples import examples

STRICT = PRESETS["strict"]
HALF_L = 4.855 / 2
HALF_W = 1.88 / 2
AXLE = 1.4  # box centre ahead of the rear axle
POST = Box(0.3, 0.3, 1.0)


def flag(log, name):
    return scored(log)[name].value.tolist()


def test_a_pedestrian_who_runs_across_between_two_steps_is_hit():
    log = rollout(track([0.0, 0.1], 0.0), [car("runner", track(1.0, [1.5, -1.5]), POST)])
    assert scored(log, preset="paper")["collision_any"].value.tolist() == [0, 0]
    assert flag(log, "collision_any") == [0, 1]
    assert flag(log, "collision_lateral") == [0, 1]
    (event,) = contact_events(log)
    assert event.actor_id == "runner"
    assert event.t_s == pytest.approx(0.1 * (1.5 - HALF_W - 0.15) / 3.0, abs=1e-9)
    assert (event.x_m, event.y_m) == pytest.approx(
        (1.0 + AXLE - 0.1 * event.t_s / 0.1, HALF_W), abs=1e-5
    )


def test_time_and_place_of_a_front_contact():
    log = rollout(track([0.0, 1.0, 2.0, 3.0], 0.0), [car("a", track(7.0, 0.4, n=4))])
    values = {
        name: one.value
        for name, one in reduce_rollout(
            score(log, scene(TWO_LANES, log), STRICT), STRICT
        ).values.items()
    }
    assert values["collision_front"] == 1.0
    assert values["contact_time_s"] == pytest.approx(0.1 * (7.0 - HALF_L - 2.25), abs=1e-9)
    assert values["contact_x_m"] == pytest.approx(AXLE + HALF_L, abs=1e-5)
    # The other's front spans y = -0.5 to 1.3; shared with the ego's -0.94 to 0.94 is -0.5 to 0.94.
    assert values["contact_y_m"] == pytest.approx(0.22, abs=1e-5)


def test_contacts_come_in_order_of_time_and_the_first_gives_time_and_place():
    """The ego passes two posts at 10 m/s: one on its right, then one on its left, which the log
    names first.
    """
    posts = {"far": (8.0, 0.9), "near": (5.5, -0.8)}
    times_us = [0, 100_000, 200_000, 600_000]
    actors = [car(name, track(x, y, t_us=times_us), POST) for name, (x, y) in posts.items()]
    log = rollout(track([0.0, 1.0, 2.0, 6.0], 0.0, t_us=times_us), actors)
    near_s, far_s = (0.1 * (posts[name][0] - 0.15 - HALF_L) for name in ("near", "far"))
    events = contact_events(log)
    assert [event.actor_id for event in events] == ["near", "far"]
    assert [event.t_s for event in events] == pytest.approx([near_s, far_s], abs=1e-9)
    found = scored(log)
    assert found["contact_time_s"].value[-1] == pytest.approx(near_s, abs=1e-9)
    assert found["contact_y_m"].value[-1] == pytest.approx(-0.795, abs=1e-5)
    values = values_of(log, preset=STRICT)
    assert values["contact_time_s"].value == pytest.approx(near_s, abs=1e-9)


def test_without_contact_time_and_place_are_invalid_with_a_reason():
    log = rollout(track([0.0, 1.0], 0.0), [car("a", track(20.0, 0.0, n=2))])
    one = scored(log)["contact_time_s"]
    assert not one.valid.any()
    assert one.reason == "nothing touches the ego"
    values = values_of(log, preset=STRICT)
    assert values["contact_time_s"].value is None
    assert values["contact_time_s"].unit == "s"


def test_a_side_swipe_that_reaches_the_bumper_by_the_next_step_is_lateral():
    # The other comes from the left and slides forward along the ego; at the step it overlaps the
    # front side as well.
    log = rollout(track(0.0, 0.0, n=2), [car("a", track([0.0, 3.0], [2.5, 1.5]))])
    assert scored(log, preset="paper")["collision_front"].value.tolist() == [0, 1]
    assert flag(log, "collision_lateral") == [0, 1]
    assert flag(log, "collision_front") == [0, 0]


def test_every_touching_actor_has_its_own_side_and_keeps_it():
    ahead = car("ahead", track([6.0, 4.0, 4.0], 0.0))
    behind = car("behind", track([-6, -4.5, -4.5], 0.0))
    beside = car("beside", track(0.0, [3, 1.7, 1.7]))
    log = rollout(track(0.0, 0.0, n=3), [ahead, behind, beside])
    events = {one.actor_id: one for one in contact_events(log)}
    assert {name: one.side for name, one in events.items()} == {
        "ahead": "front",
        "behind": "rear",
        "beside": "lateral",
    }
    for side in ("front", "rear", "lateral"):
        assert flag(log, f"collision_{side}") == [0, 1, 1]
    # Times differ; the row tells the earliest.
    times = sorted(one.t_s for one in events.values())
    assert scored(log)["contact_time_s"].value[1:].tolist() == pytest.approx([times[0]] * 2)


@pytest.mark.parametrize(("degrees", "side"), [(40, "front"), (50, "lateral")])
def test_a_corner_contact_goes_by_the_direction_of_the_blow(degrees, side):
    """A wall whose face meets the ego's front left corner, seen from ahead or from the side of the
    diagonal.
    """
    at = math.radians(
        90 + degrees
    )  # heading of the wall's long face, at right angles to the normal
    normal = np.array([math.sin(at), -math.cos(at)])
    corner = np.array([HALF_L, HALF_W])
    centres = [corner + normal * (0.5 + gap) for gap in (1.0, -0.2)]
    wall = car(
        "wall", track([c[0] for c in centres], [c[1] for c in centres], yaw=at), Box(6.0, 1.0, 1.0)
    )
    (event,) = contact_events(rollout(track(0.0, 0.0, n=2), [wall]))
    assert event.side == side
    assert (event.x_m, event.y_m) == pytest.approx((HALF_L + AXLE, HALF_W), abs=1e-5)


def test_a_long_bus_beside_the_ego_is_lateral_although_it_reaches_both_bumpers():
    log = rollout(track(0.0, 0.0, n=2), [car("bus", track(0.0, [2.5, 1.5]), Box(12.0, 2.5, 3.0))])
    assert scored(log, preset="paper")["collision_front"].value.tolist() == [0, 1]
    assert [one.side for one in contact_events(log)] == ["lateral"]


def test_contact_from_the_first_pose_begins_at_zero_and_is_classified_as_overlap():
    log = rollout(
        track([0.0, 0.1], 0.0),
        [car("ahead", track([4.0, 4.1], 0.0)), car("behind", track([-4.0, -3.9], 0.0))],
    )
    assert [(one.actor_id, one.t_s, one.side) for one in contact_events(log)] == [
        ("ahead", 0.0, "front"),
        ("behind", 0.0, "rear"),
    ]
    assert flag(log, "collision_at_fault") == [1, 1]


def test_an_actor_that_touches_twice_has_two_beginnings():
    log = rollout(track(0.0, 0.0, n=5), [car("a", track(0.0, [3.0, 1.7, 3.0, 1.7, 3.0]))])
    assert len(contact_events(log)) == 2
    # The third row holds the end of the first contact: it still touches when the row's interval
    # begins.
    assert flag(log, "collision_any") == [0, 1, 0, 1, 0]


def test_an_actor_counts_from_its_first_logged_time_even_between_steps():
    appears = track([0.0, 0.0], 0.0, t_us=[150_000, 160_000])
    log = rollout(track(0.0, 0.0, n=4), [car("ghost", appears)])
    assert flag(log, "collision_any") == [0, 0, 1, 0]
    assert contact_events(log)[0].t_s == pytest.approx(0.15)
    assert flag(
        rollout(track(0.0, 0.0, n=4), [car("seen once", track(0.0, 0.0, t_us=[150_000]))]),
        "collision_any",
    ) == [0, 0, 1, 0]


def test_an_actor_that_vanishes_before_it_arrives_does_not_touch():
    log = rollout(track(0.0, 0.0, n=4), [car("a", track([10.0, 6.0], 0.0, t_us=[0, 100_000]))])
    assert flag(log, "collision_any") == [0, 0, 0, 0]


def test_an_actor_logged_finer_than_the_ego_follows_its_own_poses():
    # Straight from first to last pose it would miss; by its poses in between it comes and goes.
    dash = track(0.0, [4.0, 1.7, 4.0], t_us=[0, 50_000, 100_000])
    log = rollout(track(0.0, 0.0, n=2), [car("a", dash)])
    assert flag(log, "collision_any") == [0, 1]
    assert contact_events(log)[0].t_s == pytest.approx(0.05 * (4.0 - HALF_W - 0.9) / 2.3, abs=1e-9)


def test_headings_turn_the_shorter_way_across_180_degrees():
    turning = track(0.0, 3.0, yaw=[math.radians(175), math.radians(-175)])
    log = rollout(track(0.0, 0.0, n=2), [car("a", turning, Box(8.0, 1.0, 1.0))])
    assert flag(log, "collision_any") == [0, 0]


def test_the_ego_turns_the_shorter_way_across_180_degrees():
    turning = track(0.0, 0.0, yaw=[math.radians(175), math.radians(-175)])
    long_ego = Box(8.0, 1.0, 1.0)
    beside = [car("left", track(0.0, 3.0, n=2)), car("right", track(0.0, -3.0, n=2))]
    assert flag(rollout(turning, beside, box=long_ego), "collision_any") == [0, 0]


def test_a_contact_before_the_handover_belongs_to_the_forced_rows():
    runner = car("runner", track(0.0, [3.0, -3.0, -3.0]), POST)
    log = rollout(track(0.0, 0.0, n=3), [runner], warmup_us=100_000)
    assert flag(log, "collision_any") == [1, 0, 0]
    assert values_of(log, preset=STRICT)["collision_any"].value == 0.0
    late = rollout(
        track(0.0, 0.0, n=3), [car("runner", track(0.0, [3.0, 3.0, -3.0]), POST)], warmup_us=100_000
    )
    assert values_of(late, preset=STRICT)["collision_any"].value == 1.0


def test_one_step_and_no_actors():
    assert flag(rollout(track(0.0, 0.0)), "collision_any") == [0]
    assert flag(
        rollout(track(0.0, 0.0), [car("same", track(0.0, 0.0), Box(4.855, 1.88, 1.6))]),
        "collision_lateral",
    ) == [1]
    assert contact_events(rollout(track([0.0, 1.0], 0.0))) == ()


def test_a_rollout_longer_than_a_stretch_of_the_tree_misses_nobody():
    n = 70
    posts = [
        car(f"p{k}", track(float(k) + 0.5, [0.0, 3.0] * (n // 2)), POST) for k in range(0, n, 7)
    ]
    log = rollout(track(np.arange(n, dtype=float), 0.0), posts)
    assert {one.actor_id for one in contact_events(log)} == {one.actor_id for one in posts}


def test_rounded_corners_are_refused():
    with pytest.raises(InputError, match="roundness"):
        replace(STRICT, roundness=0.5)


# --- twin


def twin_rows(log):
    """Actors that touch in each row, by brute force: exact at steps, decimals between."""
    at_steps = contacts_by_step(log, STRICT)
    rows = [set(one.sides) for one in at_steps]
    sides = {}
    for i in range(len(log.ego) - 1):
        for actor in log.actors.values():
            if actor.actor_id in at_steps[i].sides:
                continue
            for a, b in pieces(log, actor, i):
                tau = first_touch(a, b, samples=24)
                if tau is not None:
                    rows[i + 1].add(actor.actor_id)
                    sides[i + 1, actor.actor_id] = side_at(a, b, tau, PLACE_M)
                    break
    out = []
    last = {}
    for i, names in enumerate(rows):
        for name in names:
            before = i > 0 and name in at_steps[i - 1].sides
            last[name] = sides.get((i, name)) or (
                last[name] if before else overlap_side(log, log.actors[name], i)
            )
        out.append({name: last[name] for name in names})
    return out


def overlap_side(log, actor, i):
    t = log.ego.t_us[i]
    ego_size = (log.ego_box.length_m, log.ego_box.width_m)
    size = (actor.box.length_m, actor.box.width_m)
    return side_at(
        moved(log.ego, t, t, ego_size, log), moved(actor.track, t, t, size, log), 0.0, PLACE_M
    )


def pieces(log, actor, i):
    t = log.ego.t_us
    first = max(t[i], actor.track.t_us[0])
    last = min(t[i + 1], actor.track.t_us[-1])
    if first >= last:
        return
    inside = actor.track.t_us[(actor.track.t_us > first) & (actor.track.t_us < last)]
    knots = [first, *inside, last]
    ego_size = (log.ego_box.length_m, log.ego_box.width_m)
    for t0, t1 in pairwise(knots):
        yield (
            moved(log.ego, t0, t1, ego_size, log),
            moved(actor.track, t0, t1, (actor.box.length_m, actor.box.width_m), log),
        )


def moved(poses, t0, t1, size, log):
    def at(t):
        k = min(int(np.searchsorted(poses.t_us, t, side="right")) - 1, max(len(poses) - 2, 0))
        m = min(k + 1, len(poses) - 1)
        f = (t - poses.t_us[k]) / max(poses.t_us[m] - poses.t_us[k], 1)
        yaw = yaw_from_quat(poses.quat)
        xy = poses.xyz[:, :2] - np.round(log.ego.xyz[0, :2])
        return xy[k] * (1 - f) + xy[m] * f, yaw[k] + f * wrap_angle(yaw[m] - yaw[k])

    (a, yaw0), (b, yaw1) = at(t0), at(t1)
    return Motion(tuple(a), tuple(b - a), float(yaw0), float(yaw1 - yaw0), size)


def fast_rows(log):
    origin = origin_of(log.ego, STRICT)
    ego = ego_footprints(log, STRICT, origin)
    actors = ActorTable(log, STRICT, origin)
    contacts, _ = find_contacts(ego, actors, log.ego.t_us)
    swept = find_swept(ego, actors, log.ego.t_us, contacts, -1)
    out = [{} for _ in range(len(log.ego))]
    for step, actor, side in zip(swept.step, swept.actor, swept.side, strict=True):
        out[step][actors.ids[actor]] = SIDES[int(side)]
    return out


ANGLES = st.sampled_from([0.0, math.pi, -math.pi, math.pi / 2, 3.1, -3.1, 0.3])
OFFSETS = st.sampled_from([(0.0, 0.0), (691_608.3, 5_334_760.7), (-8_000.25, 1e5)])


@st.composite
def worlds(draw):
    """Few steps, a turning or standing ego anywhere on earth, actors that come, go, touch, stand
    and are logged on their own times.
    """
    n = draw(st.integers(1, 4))
    x0, y0 = draw(OFFSETS)
    number = st.one_of(st.integers(-6, 6).map(float), st.floats(-7, 7))
    standing = draw(st.booleans())
    ego_yaw = [draw(ANGLES) + k * draw(st.sampled_from([0.0, 0.2])) for k in range(n)]
    ego_x = [x0 + (0.0 if standing else 1.3 * k) for k in range(n)]
    actors = []
    for a in range(draw(st.integers(0, 2))):
        start = draw(st.integers(-1, n)) * 100_000 + draw(st.sampled_from([0, 50_000]))
        m = draw(st.integers(1, 4))
        period = draw(st.sampled_from([100_000, 70_000]))
        xs, ys = ([base + draw(number) for _ in range(m)] for base in (x0, y0))
        if draw(st.booleans()):  # edges on one line, corner on corner
            xs = [x0 + HALF_L + 2.25] * m
            ys = [y0 + draw(st.sampled_from([0.0, HALF_W + 0.9]))] * m
        box = draw(st.sampled_from([CAR, POST, Box(4.855, 1.88, 1.6), Box(12.0, 1e-3, 1.0)]))
        yaws = [draw(ANGLES) for _ in range(m)]
        actors.append(
            car(f"a{a}", track(xs, ys, yaw=yaws, t_us=start + period * np.arange(m)), box)
        )
    return rollout(track(ego_x, y0, yaw=ego_yaw), actors)


@settings(max_examples=examples(40), deadline=None, derandomize=True)
@given(worlds())
def test_random_worlds_agree_with_the_twin(log):
    fast = fast_rows(log)
    slow = twin_rows(log)
    for row, (got, want) in enumerate(zip(fast, slow, strict=True)):
        for name in set(got) | set(want):
            if got.get(name) != want.get(name):
                assert on_the_edge(log, row, name), (row, name, got, want)


def on_the_edge(log, row, name):
    """Tell whether the answer flips within a nanometre of size, or, for the side, within the
    tolerance of the place.
    """
    answers = set()
    for grow in (-2.5e-9, 2.5e-9, -3 * PLACE_M, 3 * PLACE_M):
        box = replace(
            log.ego_box, length_m=log.ego_box.length_m + grow, width_m=log.ego_box.width_m + grow
        )
        answers.add(fast_rows(replace(log, ego_box=box))[row].get(name))
    return len(answers) > 1
