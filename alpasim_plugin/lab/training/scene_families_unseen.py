"""Families of roads and traffic that only the test of unseen families draws from.

Each scene has one of the parts that `held_out` holds out of the fixers' training: tapers (a lane
that ends or opens), rows of cars that squeeze the lane, hairpins (radius below 35 m), junctions with
three lanes an arm, cars parked across the kerb, and objects of class ``other``. Its other parts may
be in training too, junctions with up to two lanes an arm among them.
"""

from __future__ import annotations

from collections.abc import Mapping

from alpasim_plugin.lab.training.scene_draws import (
    Rng,
    Spec,
    arc,
    bend,
    bystanders,
    crossing,
    ego,
    leader,
    number,
    oncoming,
    path_m,
    pick,
    sign,
    straight,
    to_length,
)
from alpasim_plugin.lab.training.scene_families import Family


def _tapers(rng: Rng, time_s: float) -> Spec:
    v = number(rng, 17, 23)
    taper = {"kind": pick(rng, "merge", "split"), "length_m": number(rng, 70, 110)}
    road = {
        "lanes_forward": 3,
        "lanes_backward": 2,
        "lane_width_m": 3.6,
        "median_m": 4,
        "shoulder_m": 2.5,
        "segments": to_length([straight(number(rng, 100, 160)), taper], path_m(v, time_s, 100)),
    }
    truck = {
        "kind": "idm",
        "id": "truck",
        "label": "truck",
        "lane": 0,
        "s_m": number(rng, 15, 50),
        "speed_mps": round(v * 0.95, 2),
    }
    return {"road": road, "ego": ego(rng, v, 1), "actors": [truck]}


def _squeezed(rng: Rng, time_s: float) -> Spec:
    v = number(rng, 5.5, 7.5)
    gap = {
        "kind": "narrow_gap",
        "length_m": number(rng, 45, 60),
        "gap_m": number(rng, 3.1, 3.6),
        "cars_left": 3,
        "cars_right": 3,
    }
    segments = [
        straight(number(rng, 45, 60)),
        gap,
        straight(25),
        dict(gap),
        arc(50, sign(rng) * number(rng, 0.002, 0.006, 5)),
    ]
    road = {
        "segments": to_length(segments, path_m(v, time_s)),
        "lane_width_m": number(rng, 3.3, 3.8),
    }
    return {"road": road, "ego": ego(rng, v), "actors": [bystanders(rng, "right")]}


def _hairpins(rng: Rng, time_s: float) -> Spec:
    v = number(rng, 5.5, 7)
    k = sign(rng) * number(rng, 0.030, 0.042, 5)
    segments = [
        straight(number(rng, 25, 40)),
        *bend(k, number(rng, 35, 50), 18.0),
        straight(20),
        *bend(-k, number(rng, 35, 50), 18.0),
    ]
    road = {
        "lane_width_m": number(rng, 3.4, 3.8),
        "shoulder_m": 0.4,
        "segments": to_length(segments, path_m(v, time_s)),
    }
    return {
        "road": road,
        "ego": ego(rng, v),
        "actors": oncoming(rng, 2, number(rng, 60, 90), v, path_m(v, time_s)),
    }


def _wide_junctions(rng: Rng, time_s: float) -> Spec:
    v = number(rng, 7, 9)
    junction = {
        "kind": "intersection",
        "cross_lanes": 3,
        "corner_radius_m": number(rng, 9, 14, 1),
        "arm_length_m": 55.0,
    }
    segments = [
        straight(number(rng, 50, 65)),
        junction | {"turn": "straight"},
        straight(number(rng, 45, 60)),
    ]
    segments += [junction | {"turn": pick(rng, "left", "straight")}]
    road = {
        "lanes_forward": 3,
        "lanes_backward": 3,
        "lane_width_m": 3.3,
        "segments": to_length(segments, path_m(v, time_s)),
    }
    return {
        "road": road,
        "ego": ego(rng, v, 0) | {"start_m": 15.0},
        "actors": [leader(rng, v, 1, "car"), bystanders(rng, "right")],
    }


def _parked_across(rng: Rng, time_s: float) -> Spec:
    v = number(rng, 6.5, 8.5)
    actors: list[Spec] = []
    for side in ("right", "left"):
        row = {
            "kind": "parked",
            "id": f"across-{side}",
            "side": side,
            "s_m": number(rng, 10, 20),
            "count": int(rng.integers(8, 16)),
        }
        actors.append(
            row
            | {
                "spacing_m": number(rng, 2.9, 4.2),
                "clearance_m": 1.9,
                "yaw_deg": pick(rng, 90, -90, 60),
            }
        )
    road = {
        "parking_m": 5.5,
        "lane_width_m": number(rng, 3.3, 3.8),
        "segments": to_length([straight(80)], path_m(v, time_s)),
    }
    return {
        "road": road,
        "ego": ego(rng, v),
        "actors": [*actors, crossing(rng, "cyclist") | {"s_m": number(rng, 85, 110)}],
    }


def _roadworks(rng: Rng, time_s: float) -> Spec:
    v = number(rng, 7, 9)
    actors: list[Spec] = []
    for i, s_m in enumerate((20.0, 75.0, 130.0)):
        size = [number(rng, 0.4, 2.5), number(rng, 0.4, 1.4), number(rng, 0.7, 2.2)]
        row = {
            "kind": "parked",
            "id": f"barrier-{i}",
            "label": "other",
            "size_m": size,
            "s_m": s_m,
            "side": pick(rng, "left", "right"),
        }
        actors.append(
            row
            | {
                "count": int(rng.integers(4, 10)),
                "spacing_m": number(rng, 3.5, 5),
                "clearance_m": number(rng, 0.3, 0.7),
            }
        )
    k = sign(rng) * number(rng, 0.002, 0.008, 5)
    road: Spec = {"shoulder_m": 2.0, "lane_width_m": number(rng, 3.3, 3.8), "centre_paint": "none"}
    road["segments"] = to_length([straight(number(rng, 40, 70)), arc(90, k)], path_m(v, time_s))
    return {
        "road": road,
        "ego": ego(rng, v),
        "actors": [*actors, leader(rng, v * 0.95, 0, pick(rng, "truck", "car"))],
    }


UNSEEN_FAMILIES: Mapping[str, Family] = {
    "tapers": _tapers,
    "squeezed": _squeezed,
    "hairpins": _hairpins,
    "wide_junctions": _wide_junctions,
    "parked_across": _parked_across,
    "roadworks": _roadworks,
}
