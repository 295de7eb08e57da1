"""Sample scenarios from families of roads and traffic; test families differ from training families.

Training and validation share their families. In test families the road turns at junctions, loses or gains a lane, is one-way or winding,
and traffic consists of buses, trucks, cyclists and pedestrians instead of cars.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from alpasim_plugin.seeding import stream

Spec = dict[str, Any]
Rng = np.random.Generator

MARGIN_M = 60.0  # road beyond the ego's path


def draw_spec(family: str, scene_id: str, seed: int, duration_s: float) -> Spec:
    """Return a scenario specification (docs/scenario-files.md) of a family.

    Args:
        family: One of `TRAIN_FAMILIES` or `TEST_FAMILIES`.
        scene_id: Name of the scene; part of the random stream's key.
        seed: Of the sample.
        duration_s: Length of the drive, seconds, which determines the road length.

    Raises:
        KeyError: No such family.
    """
    rng = stream(scene_id, seed, f"training.scene.{family}")
    spec = FAMILIES[family](rng, duration_s + 2.0)
    spec["road"] |= {"heading_deg": round(float(rng.uniform(-180, 180)), 1)}
    spec["environment"] = spec.get("environment", {}) | _surroundings(rng)
    return {
        "version": 1, "scene_id": scene_id, "seed": seed, "tags": ["training", family],
        "timing": {"duration_us": round(duration_s * 1e6)}, **spec,
    }  # fmt: skip


def _number(rng: Rng, low: float, high: float, digits: int = 2) -> float:
    return round(float(rng.uniform(low, high)), digits)


def _pick(rng: Rng, *choices: Any) -> Any:
    return choices[int(rng.integers(len(choices)))]


def _surroundings(rng: Rng) -> Spec:
    low = _number(rng, 4, 9, 1)
    return {
        "buildings": _number(rng, 0, 1), "building_height_m": [low, low + _number(rng, 3, 20, 1)], "trees_per_100m": _number(rng, 0, 9, 1),
        "poles_spacing_m": _pick(rng, 0, 25, 30, 40), "sky": _pick(rng, "clear", "overcast", "dusk"), "texture": _number(rng, 0.5, 1.0),
    }  # fmt: skip


def _straight(length_m: float) -> Spec:
    return {"kind": "straight", "length_m": round(max(length_m, 15.0), 1)}


def _bend(curvature_per_m: float, arc_m: float, ease_m: float) -> list[Spec]:
    k = round(curvature_per_m, 5)
    return [
        {"kind": "clothoid", "length_m": ease_m, "end_curvature_per_m": k},
        {"kind": "arc", "length_m": arc_m, "curvature_per_m": k},
        {"kind": "clothoid", "length_m": ease_m, "start_curvature_per_m": k},
    ]


def _to_length(segments: list[Spec], length_m: float) -> list[Spec]:
    """Append a straight to reach the length."""
    return [*segments, _straight(length_m - sum(float(s.get("length_m", 40.0)) for s in segments))]


def _sign(rng: Rng) -> float:
    return 1.0 if rng.random() < 0.5 else -1.0


def _leader(rng: Rng, speed_mps: float, lane: int, label: str = "car") -> Spec:
    return {"kind": "idm", "id": "ahead", "label": label, "lane": lane, "s_m": _number(rng, 22, 45), "speed_mps": round(speed_mps, 2)}


def _oncoming(rng: Rng, count: int, first_m: float, speed_mps: float, *labels: str) -> list[Spec]:
    return [
        {"kind": "oncoming", "id": f"oncoming-{i}", "label": _pick(rng, *labels), "s_m": round(first_m + i * _number(rng, 35, 70), 1),
         "speed_mps": round(speed_mps, 2)} for i in range(count)
    ]  # fmt: skip


def _parked(rng: Rng, side: str, *labels: str) -> Spec:
    count = int(rng.integers(2, 7))
    return {
        "kind": "parked", "id": f"parked-{side}", "label": _pick(rng, *labels), "s_m": _number(rng, 12, 30), "side": side, "count": count,
        "spacing_m": _number(rng, 9, 16), "clearance_m": _number(rng, 0.25, 0.6),
    }  # fmt: skip


def _ego(rng: Rng, speed_mps: float, lane: int = 0) -> Spec:
    return {"lane": lane, "speed_mps": round(speed_mps, 2), "cruise_mps": round(speed_mps * _number(rng, 1.0, 1.1), 2)}


def _street(rng: Rng, time_s: float) -> Spec:
    v = _number(rng, 7, 11)
    k = _sign(rng) * _number(rng, 0.0005, 0.004, 5)
    segments = [_straight(_number(rng, 40, 80)), {"kind": "arc", "length_m": _number(rng, 50, 120), "curvature_per_m": round(k, 5)}]
    road = {"segments": _to_length(segments, v * 1.1 * time_s + MARGIN_M), "lane_width_m": _number(rng, 3.2, 3.8), "parking_m": 2.3}
    actors = [_parked(rng, "right", "car"), _parked(rng, "left", "car"), *_oncoming(rng, 2, 60, v, "car")]
    return {"road": road, "ego": _ego(rng, v), "actors": actors}


def _long_bend(rng: Rng, time_s: float) -> Spec:
    v = _number(rng, 8, 12)
    segments = [_straight(_number(rng, 35, 60)), *_bend(_sign(rng) * _number(rng, 0.006, 0.014, 5), _number(rng, 40, 80), 25.0)]
    road = {"segments": _to_length(segments, v * 1.1 * time_s + MARGIN_M), "lane_width_m": _number(rng, 3.3, 3.8)}
    return {"road": road, "ego": _ego(rng, v), "actors": [_leader(rng, v * 0.95, 0), *_oncoming(rng, 2, 70, v, "car", "motorcycle")]}


def _avenue(rng: Rng, time_s: float) -> Spec:
    v = _number(rng, 10, 14)
    lanes = int(rng.integers(2, 4))
    lane = int(rng.integers(lanes))
    segments = [_straight(60), {"kind": "arc", "length_m": 90.0, "curvature_per_m": round(_sign(rng) * _number(rng, 0.001, 0.005, 5), 5)}]
    road = {"lanes_forward": lanes, "lanes_backward": 2, "median_m": _pick(rng, 0, 2, 3), "lane_width_m": _number(rng, 3.2, 3.6)}
    beside = {"kind": "idm", "id": "beside", "lane": (lane + 1) % lanes, "s_m": _number(rng, -8, 18), "speed_mps": round(v * 0.97, 2)}
    road["segments"] = _to_length(segments, v * 1.1 * time_s + MARGIN_M)
    actors = [_leader(rng, v * 0.95, lane), beside, *_oncoming(rng, 2, 80, v, "car")]
    return {"road": road, "ego": _ego(rng, v, lane), "actors": actors}


def _motorway(rng: Rng, time_s: float) -> Spec:
    v = _number(rng, 18, 26)
    lane = int(rng.integers(3))
    road = {
        "lanes_forward": 3, "lanes_backward": 2, "lane_width_m": 3.6, "median_m": 4, "shoulder_m": 2.5,
        "segments": _to_length(
            [_straight(80), *_bend(_sign(rng) * _number(rng, 0.0008, 0.003, 5), 120, 60.0)], v * 1.1 * time_s + 100
        ),
    }  # fmt: skip
    beside = {"kind": "idm", "id": "beside", "lane": (lane + 1) % 3, "s_m": _number(rng, 5, 30), "speed_mps": round(v * 0.96, 2)}
    return {"road": road, "ego": _ego(rng, v, lane), "actors": [_leader(rng, v * 0.95, lane) | {"s_m": 55.0}, beside]}


def _junction_straight(rng: Rng, time_s: float) -> Spec:
    v = _number(rng, 7, 10)
    segments = [_straight(_number(rng, 55, 75)), {"kind": "intersection", "turn": "straight"}]
    road = {"segments": _to_length(segments, v * 1.1 * time_s + MARGIN_M), "lane_width_m": _number(rng, 3.3, 3.7)}
    waits = {"kind": "drive", "id": "waits", "lane": _pick(rng, "s1_right_b0", "s1_left_b0"), "s_m": 30, "speeds": [[0, 0]]}
    return {"road": road, "ego": _ego(rng, v), "actors": [waits, _parked(rng, "right", "car") | {"count": 2, "s_m": 8.0}]}


def _junction_turn(rng: Rng, time_s: float) -> Spec:
    v = _number(rng, 6.5, 8)
    segments = [_straight(_number(rng, 55, 70)), {"kind": "intersection", "turn": _pick(rng, "left", "right"), "corner_radius_m": 10.0}]
    road = {"segments": _to_length(segments, v * 1.1 * time_s + MARGIN_M)}
    walker = {"kind": "parked", "id": "bystander", "label": "pedestrian", "s_m": _number(rng, 15, 25), "clearance_m": 1.4}
    return {"road": road, "ego": _ego(rng, v) | {"start_m": 22.0}, "actors": [walker]}


def _lane_ends(rng: Rng, time_s: float) -> Spec:
    v = _number(rng, 17, 23)
    taper = {"kind": _pick(rng, "merge", "split"), "length_m": _number(rng, 70, 110)}
    road = {
        "lanes_forward": 3, "lanes_backward": 2, "lane_width_m": 3.6, "median_m": 4, "shoulder_m": 2.5,
        "segments": _to_length([_straight(_number(rng, 100, 160)), taper], v * 1.1 * time_s + 100),
    }  # fmt: skip
    truck = {"kind": "idm", "id": "truck", "label": "truck", "lane": 0, "s_m": _number(rng, 15, 50), "speed_mps": round(v * 0.95, 2)}
    return {"road": road, "ego": _ego(rng, v, 1), "actors": [truck]}


def _one_way(rng: Rng, time_s: float) -> Spec:
    v = _number(rng, 7.5, 9.5)
    segments = [_straight(50), {"kind": "arc", "length_m": 60.0, "curvature_per_m": round(_sign(rng) * _number(rng, 0.005, 0.011, 5), 5)}]
    road: Spec = {"lanes_forward": 2, "lanes_backward": 0, "lane_width_m": 3.3, "parking_m": 2.5}
    road["segments"] = _to_length(segments, v * 1.1 * time_s + MARGIN_M)
    cyclist = {
        "kind": "drive", "id": "cyclist", "label": "cyclist", "lane": 1, "s_m": _number(rng, 15, 30), "offset_m": -0.6, "speeds": [[0, 5]],
    }  # fmt: skip
    vans = _parked(rng, "left", "truck") | {"size_m": [5.6, 2.0, 2.5], "spacing_m": 13.0}
    return {"road": road, "ego": _ego(rng, v, 0), "actors": [cyclist, vans]}


def _winding(rng: Rng, time_s: float) -> Spec:
    v = _number(rng, 8, 10)
    k = _sign(rng) * _number(rng, 0.012, 0.02, 5)
    segments = [_straight(45), *_bend(k, 25, 25.0), *_bend(-k, 25, 25.0)]
    road = {"lane_width_m": 3.3, "shoulder_m": 0.3, "centre_paint": _pick(rng, "dashed_white", "solid_yellow", "dashed_yellow")}
    road["segments"] = _to_length(segments, v * 1.1 * time_s + MARGIN_M)
    actors = [_leader(rng, v * 0.95, 0, _pick(rng, "bus", "truck")), *_oncoming(rng, 2, 90, v, "truck", "bus")]
    return {"road": road, "ego": _ego(rng, v), "actors": actors}


def _walkers(rng: Rng, time_s: float) -> Spec:
    v = _number(rng, 7.5, 9)
    road = {"segments": _to_length([_straight(60)], v * 1.1 * time_s + MARGIN_M), "parking_m": 2.4}
    side = _pick(rng, "left", "right")
    walker = {"kind": "crossing_pedestrian", "id": "walker", "s_m": _number(rng, 45, 70), "side": side, "before_ego_s": _number(rng, 3, 5)}
    return {"road": road, "ego": _ego(rng, v), "actors": [walker, _parked(rng, "right", "truck", "bus") | {"count": 1, "s_m": 25.0}]}


TRAIN_FAMILIES: tuple[str, ...] = ("street", "long_bend", "avenue", "motorway", "junction_straight")
TEST_FAMILIES: tuple[str, ...] = ("junction_turn", "lane_ends", "one_way", "winding", "walkers")
FAMILIES: dict[str, Callable[[Rng, float], Spec]] = {
    "street": _street, "long_bend": _long_bend, "avenue": _avenue, "motorway": _motorway, "junction_straight": _junction_straight,
    "junction_turn": _junction_turn, "lane_ends": _lane_ends, "one_way": _one_way, "winding": _winding, "walkers": _walkers,
}  # fmt: skip
