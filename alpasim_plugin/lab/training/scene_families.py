"""Families of roads and traffic that training, validation and the test of known families draw
from.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from alpasim_plugin.lab.training.scene_draws import (
    VEHICLES,
    Rng,
    Spec,
    arc,
    bend,
    beside,
    bystanders,
    crossing,
    ego,
    leader,
    number,
    oncoming,
    parked,
    path_m,
    pick,
    sign,
    straight,
    to_length,
    walker_along,
)

Family = Callable[[Rng, float], Spec]
MARK_TYPES = ("double_yellow", "solid_yellow", "dashed_yellow", "dashed_white", "solid_white")


def _street(rng: Rng, time_s: float) -> Spec:
    v = number(rng, 7, 11)
    k = sign(rng) * number(rng, 0.0005, 0.006, 5)
    road: Spec = {
        "lane_width_m": number(rng, 3.0, 3.9),
        "parking_m": number(rng, 2.2, 2.8),
        "centre_paint": pick(rng, *MARK_TYPES),
    }
    road["segments"] = to_length(
        [straight(number(rng, 30, 80)), arc(number(rng, 40, 120), k)], path_m(v, time_s)
    )
    actors = [
        parked(rng, "right"),
        parked(rng, "left"),
        *oncoming(rng, int(rng.integers(0, 4)), number(rng, 45, 80), v, path_m(v, time_s)),
    ]
    return {"road": road, "ego": ego(rng, v), "actors": actors}


def _long_bend(rng: Rng, time_s: float) -> Spec:
    v = number(rng, 8, 12)
    segments = [
        straight(number(rng, 25, 60)),
        *bend(sign(rng) * number(rng, 0.005, 0.014, 5), number(rng, 30, 90), 25.0),
    ]
    road = {
        "segments": to_length(segments, path_m(v, time_s)),
        "lane_width_m": number(rng, 3.2, 3.9),
        "centre_paint": pick(rng, *MARK_TYPES),
    }
    actors = [
        leader(rng, v * 0.95, 0),
        *oncoming(rng, 2, number(rng, 50, 80), v, path_m(v, time_s)),
    ]
    return {"road": road, "ego": ego(rng, v), "actors": actors}


def _avenue(rng: Rng, time_s: float) -> Spec:
    v = number(rng, 9, 14)
    lanes = int(rng.integers(2, 4))
    lane = int(rng.integers(lanes))
    segments = [
        straight(number(rng, 30, 70)),
        arc(number(rng, 60, 120), sign(rng) * number(rng, 0.001, 0.006, 5)),
    ]
    road = {
        "lanes_forward": lanes,
        "lanes_backward": int(rng.integers(1, 4)),
        "median_m": pick(rng, 0, 0, 1.5, 3, 4),
        "lane_width_m": number(rng, 3.1, 3.6),
        "segments": to_length(segments, path_m(v, time_s)),
    }
    near = [leader(rng, v * 0.95, lane), beside(rng, v * 0.97, (lane + 1) % lanes)]
    actors = [*near, *oncoming(rng, 2, number(rng, 60, 90), v, path_m(v, time_s))]
    return {"road": road, "ego": ego(rng, v, lane), "actors": actors}


def _motorway(rng: Rng, time_s: float) -> Spec:
    v = number(rng, 18, 28)
    lanes = int(rng.integers(2, 5))
    lane = int(rng.integers(lanes))
    curve = bend(sign(rng) * number(rng, 0.0006, 0.003, 5), number(rng, 80, 150), 60.0)
    road = {
        "lanes_forward": lanes,
        "lanes_backward": int(rng.integers(2, 4)),
        "lane_width_m": number(rng, 3.5, 3.75),
        "median_m": number(rng, 3, 8, 1),
        "shoulder_m": number(rng, 1.5, 3.0, 1),
        "speed_limit_mps": pick(rng, 27.8, 33.3, 36.1),
        "segments": to_length([straight(number(rng, 50, 110)), *curve], path_m(v, time_s, 100)),
    }
    ahead = leader(rng, v * 0.95, lane, pick(rng, "car", "car", "truck", "bus", "motorcycle")) | {
        "s_m": number(rng, 40, 60)
    }
    return {
        "road": road,
        "ego": ego(rng, v, lane),
        "actors": [ahead, beside(rng, v * 0.96, (lane + 1) % lanes)],
    }


def _junction_straight(rng: Rng, time_s: float) -> Spec:
    v = number(rng, 7, 11)
    junction = {
        "kind": "intersection",
        "turn": "straight",
        "arms": pick(rng, ["left", "straight", "right"], ["straight", "right"]),
    }
    segments = [
        straight(number(rng, 40, 65)),
        junction | {"cross_lanes": int(rng.integers(1, 3)), "crosswalks": bool(rng.random() < 0.7)},
    ]
    road = {
        "segments": to_length(segments, path_m(v, time_s)),
        "lane_width_m": number(rng, 3.1, 3.8),
    }
    kind = pick(rng, *VEHICLES)
    waits = {
        "kind": "drive",
        "id": "waits",
        "label": kind,
        "lane": "s1_right_b0",
        "s_m": number(rng, 26, 31),
        "speeds": [[0, 0]],
    }
    return {
        "road": road,
        "ego": ego(rng, v),
        "actors": [waits, parked(rng, "right") | {"count": 2, "s_m": 8.0}, bystanders(rng, "left")],
    }


def _junction_turn(rng: Rng, time_s: float) -> Spec:
    v = number(rng, 6, 8)
    turn = pick(rng, "left", "right")
    junction = {
        "kind": "intersection",
        "turn": turn,
        "corner_radius_m": number(rng, 8, 14, 1),
        "crosswalks": bool(rng.random() < 0.7),
    }
    road = {
        "segments": to_length([straight(number(rng, 40, 58)), junction], path_m(v, time_s)),
        "lane_width_m": number(rng, 3.2, 3.8),
    }
    return {
        "road": road,
        "ego": ego(rng, v) | {"start_m": 22.0},
        "actors": [bystanders(rng, "right"), bystanders(rng, "left")],
    }


def _one_way(rng: Rng, time_s: float) -> Spec:
    v = number(rng, 7, 10)
    k = sign(rng) * number(rng, 0.002, 0.011, 5)
    lanes = int(rng.integers(1, 4))
    road: Spec = {
        "lanes_forward": lanes,
        "lanes_backward": 0,
        "lane_width_m": number(rng, 3.1, 3.7),
        "parking_m": number(rng, 2.2, 2.7),
    }
    road["segments"] = to_length(
        [straight(number(rng, 30, 55)), arc(number(rng, 40, 80), k)], path_m(v, time_s)
    )
    actors = [parked(rng, "left"), parked(rng, "right"), bystanders(rng, "right")]
    if lanes > 1:
        cyclist = {
            "kind": "drive",
            "id": "cyclist",
            "label": "cyclist",
            "lane": 1,
            "s_m": number(rng, 15, 30),
            "offset_m": -0.6,
        }
        actors.append(cyclist | {"speeds": [[0, number(rng, 4, 6)]]})
    return {"road": road, "ego": ego(rng, v, 0), "actors": actors}


def _winding(rng: Rng, time_s: float) -> Spec:
    v = number(rng, 7, 10)
    k = sign(rng) * number(rng, 0.010, 0.02, 5)
    k_back = -k * number(rng, 0.5, 1.0)
    segments = [
        straight(number(rng, 20, 45)),
        *bend(k, number(rng, 15, 30), 25.0),
        *bend(k_back, number(rng, 15, 30), 25.0),
    ]
    road = {
        "lane_width_m": number(rng, 3.1, 3.5),
        "shoulder_m": number(rng, 0.2, 0.8),
        "centre_paint": pick(rng, *MARK_TYPES),
    }
    road["segments"] = to_length(segments, path_m(v, time_s))
    actors = [
        leader(rng, v * 0.95, 0),
        *oncoming(rng, 2, number(rng, 60, 90), v, path_m(v, time_s)),
    ]
    return {"road": road, "ego": ego(rng, v), "actors": actors}


def _walkers(rng: Rng, time_s: float) -> Spec:
    v = number(rng, 7, 9)
    width = number(rng, 3.1, 3.6)
    parking = number(rng, 2.2, 2.6)
    road = {
        "segments": to_length([straight(60)], path_m(v, time_s)),
        "parking_m": parking,
        "lane_width_m": width,
    }
    actors = [
        crossing(rng),
        bystanders(rng, "left"),
        walker_along(rng, width, parking + number(rng, 0.8, 2.0)),
    ]
    return {
        "road": road,
        "ego": ego(rng, v),
        "actors": [*actors, parked(rng, "right") | {"count": 1, "s_m": 25.0}],
    }


def _big_vehicles(rng: Rng, time_s: float) -> Spec:
    v = number(rng, 8, 13)
    road: Spec = {
        "lanes_forward": 2,
        "lanes_backward": int(rng.integers(1, 3)),
        "lane_width_m": number(rng, 3.3, 3.8),
    }
    segments = [
        straight(number(rng, 25, 60)),
        arc(number(rng, 50, 110), sign(rng) * number(rng, 0.001, 0.007, 5)),
    ]
    road["segments"] = to_length(segments, path_m(v, time_s))
    stands = parked(rng, "right", "stands", {"bus": 0.5, "truck": 0.5}) | {
        "count": int(rng.integers(1, 3))
    }
    big = [leader(rng, v * 0.93, 0, pick(rng, "bus", "truck")), stands]
    comes = [
        a | {"label": pick(rng, "bus", "truck", "car")}
        for a in oncoming(rng, 3, number(rng, 40, 70), v, path_m(v, time_s))
    ]
    return {"road": road, "ego": ego(rng, v, 0), "actors": [*big, *comes]}


def _cyclists(rng: Rng, time_s: float) -> Spec:
    v = number(rng, 5.5, 8)
    width = number(rng, 3.3, 4.2)
    road = {
        "lane_width_m": width,
        "shoulder_m": number(rng, 0.4, 1.6),
        "centre_paint": pick(rng, *MARK_TYPES),
    }
    road["segments"] = to_length(
        [straight(number(rng, 30, 60)), arc(80, sign(rng) * number(rng, 0.001, 0.009, 5))],
        path_m(v, time_s),
    )
    actors = [leader(rng, v, 0, "cyclist")]
    for i in range(int(rng.integers(1, 4))):
        offset = -round(width / 2 - 0.5, 2)
        position = {
            "s_m": round(number(rng, 30, 45) + 25 * i, 1),
            "offset_m": offset,
            "speed_mps": number(rng, 3.5, 6),
        }
        actors.append(
            {"kind": "oncoming", "id": f"comes-{i}", "label": pick(rng, "cyclist", "motorcycle")}
            | position
        )
    return {
        "road": road,
        "ego": ego(rng, v),
        "actors": [*actors, bystanders(rng, pick(rng, "left", "right"))],
    }


def _composed(rng: Rng, time_s: float) -> Spec:
    """Return any road: straights, bends both ways and junctions in any order, with any of the
    traffic.
    """
    v = number(rng, 6.5, 8.5)
    lanes = int(rng.integers(1, 3))
    wanted_m = path_m(v, time_s)
    segments = [straight(number(rng, 30, 50))]
    length_m = 0.0
    junctions = 0
    while length_m < wanted_m:
        kind = pick(rng, "bend", "bend", "arc", "junction")
        if kind == "bend":
            part = bend(
                sign(rng) * number(rng, 0.006, 0.018, 5), number(rng, 10, 40), number(rng, 18, 30)
            )
        elif kind == "arc" or junctions == 2:
            part = [arc(number(rng, 30, 70), sign(rng) * number(rng, 0.0005, 0.004, 5))]
        else:
            junctions += 1
            turn = pick(rng, "straight", "left", "right") if lanes == 1 else "straight"
            paint = {
                "crosswalks": bool(rng.random() < 0.6),
                "guide_lines": bool(rng.random() < 0.5),
            }
            part = [
                {"kind": "intersection", "turn": turn, "corner_radius_m": number(rng, 7, 12, 1)}
                | paint
            ]
        segments += [*part, straight(number(rng, 20, 45))]
        length_m = float(np.sum([s.get("length_m", 30.0) for s in segments]))
    road = {
        "segments": segments,
        "lanes_forward": lanes,
        "lanes_backward": lanes,
        "lane_width_m": number(rng, 3.1, 3.8),
        "centre_paint": pick(rng, *MARK_TYPES),
        "shoulder_m": number(rng, 0.2, 1.2),
    }
    actors = [bystanders(rng, "right"), bystanders(rng, "left")]
    return {
        "road": road,
        "ego": ego(rng, v, 0) | {"start_m": 10.0},
        "actors": [*actors, leader(rng, v, 0)],
    }


KNOWN_FAMILIES: Mapping[str, Family] = {
    "street": _street,
    "long_bend": _long_bend,
    "avenue": _avenue,
    "motorway": _motorway,
    "junction_straight": _junction_straight,
    "junction_turn": _junction_turn,
    "one_way": _one_way,
    "winding": _winding,
    "walkers": _walkers,
    "big_vehicles": _big_vehicles,
    "cyclists": _cyclists,
    "composed": _composed,
}
