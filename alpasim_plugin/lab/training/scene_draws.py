"""Draws that scene families share: numbers, road segments, road users."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

Spec = dict[str, Any]
Rng = np.random.Generator

MARGIN_M = 60.0  # road beyond the ego's path
VEHICLES: Mapping[str, float] = {
    "car": 0.55,
    "truck": 0.16,
    "bus": 0.12,
    "motorcycle": 0.08,
    "cyclist": 0.09,
}
PARKED: Mapping[str, float] = {"car": 0.75, "truck": 0.15, "bus": 0.04, "motorcycle": 0.06}
# In a row
SPACING_M: Mapping[str, float] = {
    "car": 7.0,
    "truck": 10.5,
    "bus": 15.0,
    "motorcycle": 5.0,
    "cyclist": 4.0,
    "pedestrian": 3.0,
}


def number(rng: Rng, low: float, high: float, digits: int = 2) -> float:
    """Draw a uniform number, rounded."""
    return round(float(rng.uniform(low, high)), digits)


def log_number(rng: Rng, low: float, high: float, digits: int = 3) -> float:
    """Draw a number whose logarithm is uniform, rounded."""
    return round(float(np.exp(rng.uniform(np.log(low), np.log(high)))), digits)


def pick(rng: Rng, *choices: Any) -> Any:
    """Draw one of several values with equal chance."""
    return choices[int(rng.integers(len(choices)))]


def label(rng: Rng, weights: Mapping[str, float]) -> str:
    """Draw a class of road user."""
    names = list(weights)
    shares = np.array(list(weights.values()))
    return str(names[int(rng.choice(len(names), p=shares / shares.sum()))])


def sign(rng: Rng) -> float:
    """Draw a side: 1 left, -1 right."""
    return 1.0 if rng.random() < 0.5 else -1.0


def straight(length_m: float) -> Spec:
    """Return a straight of at least 15 m."""
    return {"kind": "straight", "length_m": round(max(length_m, 15.0), 1)}


def arc(length_m: float, curvature_per_m: float) -> Spec:
    """Return a circular bend."""
    return {
        "kind": "arc",
        "length_m": round(length_m, 1),
        "curvature_per_m": round(curvature_per_m, 5),
    }


def bend(curvature_per_m: float, arc_m: float, ease_m: float) -> list[Spec]:
    """Return a bend between two clothoids."""
    k = round(curvature_per_m, 5)
    return [
        {"kind": "clothoid", "length_m": round(ease_m, 1), "end_curvature_per_m": k},
        arc(arc_m, k),
        {"kind": "clothoid", "length_m": round(ease_m, 1), "start_curvature_per_m": k},
    ]


def to_length(segments: list[Spec], length_m: float) -> list[Spec]:
    """Append a straight to reach a length."""
    return [*segments, straight(length_m - sum(float(s.get("length_m", 40.0)) for s in segments))]


def path_m(speed_mps: float, time_s: float, margin_m: float = MARGIN_M) -> float:
    """Return the length of road that a drive needs."""
    return speed_mps * 1.1 * time_s + margin_m


def ego(rng: Rng, speed_mps: float, lane: int = 0) -> Spec:
    """Return the expert's section."""
    return {
        "lane": lane,
        "speed_mps": round(speed_mps, 2),
        "cruise_mps": round(speed_mps * number(rng, 1.0, 1.1), 2),
    }


def leader(rng: Rng, speed_mps: float, lane: int, kind: str | None = None) -> Spec:
    """Return a reactive vehicle ahead of the ego; cyclists are slower."""
    chosen = kind or label(rng, VEHICLES)
    speed = min(speed_mps, number(rng, 4.5, 6.5)) if chosen == "cyclist" else speed_mps
    return {
        "kind": "idm",
        "id": "ahead",
        "label": chosen,
        "lane": lane,
        "s_m": number(rng, 20, 45),
        "speed_mps": round(speed, 2),
    }


def beside(rng: Rng, speed_mps: float, lane: int) -> Spec:
    """Return a reactive vehicle in a neighbouring lane."""
    kind = label(rng, {name: VEHICLES[name] for name in ("car", "truck", "bus", "motorcycle")})
    s_m = number(rng, 4, 30) if sign(rng) > 0 else number(rng, -22, -12)
    return {
        "kind": "idm",
        "id": f"beside-{lane}",
        "label": kind,
        "lane": lane,
        "s_m": s_m,
        "speed_mps": round(speed_mps, 2),
    }


def oncoming(rng: Rng, count: int, first_m: float, speed_mps: float, road_m: float) -> list[Spec]:
    """Return at most ``count`` vehicles that come the other way, far enough apart for every class
    and not beyond the road.
    """
    out = []
    s_m = first_m
    for i in range(count):
        if s_m > road_m - 15.0:
            break
        kind = label(rng, VEHICLES)
        out.append(
            {
                "kind": "oncoming",
                "id": f"oncoming-{i}",
                "label": kind,
                "s_m": round(s_m, 1),
                "speed_mps": round(speed_mps, 2),
            }
        )
        s_m += number(rng, 25, 70)
    return out


def parked(rng: Rng, side: str, name: str = "parked", kinds: Mapping[str, float] = PARKED) -> Spec:
    """Return a row of standing vehicles of one class."""
    kind = label(rng, kinds)
    return {
        "kind": "parked",
        "id": f"{name}-{side}",
        "label": kind,
        "s_m": number(rng, 10, 45),
        "side": side,
        "count": int(rng.integers(1, 7)),
        "spacing_m": round(SPACING_M[kind] + number(rng, 0, 8), 2),
        "clearance_m": number(rng, 0.25, 0.6),
    }


def bystanders(rng: Rng, side: str) -> Spec:
    """Return people who stand on the pavement."""
    return {
        "kind": "parked",
        "id": f"people-{side}",
        "label": "pedestrian",
        "s_m": number(rng, 8, 60),
        "side": side,
        "count": int(rng.integers(1, 6)),
        "spacing_m": number(rng, 1.0, 9.0),
        "clearance_m": number(rng, 0.9, 2.6),
        "yaw_deg": number(rng, -180, 180, 0),
    }


def walker_along(rng: Rng, lane_width_m: float, beside_m: float, name: str = "along") -> Spec:
    """Return a person who walks along the right pavement, ``beside_m`` from the lane's edge."""
    return {
        "kind": "drive",
        "id": name,
        "label": "pedestrian",
        "lane": 0,
        "s_m": number(rng, 12, 40),
        "offset_m": -round(lane_width_m / 2 + beside_m, 2),
        "speeds": [[0, number(rng, 0.8, 1.8)]],
    }


def crossing(rng: Rng, kind: str = "pedestrian") -> Spec:
    """Return a road user who crosses well before the ego."""
    speed = number(rng, 1.0, 1.8) if kind == "pedestrian" else number(rng, 3, 5)
    return {
        "kind": "crossing_pedestrian",
        "id": "crosses",
        "label": kind,
        "s_m": number(rng, 40, 75),
        "side": pick(rng, "left", "right"),
        "before_ego_s": number(rng, 3, 5.5),
        "speed_mps": speed,
    }
