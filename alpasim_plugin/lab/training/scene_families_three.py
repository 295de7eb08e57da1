"""Families for a policy with cameras to the sides: someone comes from where the front camera does
not look, and the expert lets them pass.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Literal

from alpasim_plugin.lab.training.scene_draws import (
    Rng,
    Spec,
    ego,
    label,
    number,
    path_m,
    pick,
    straight,
    to_length,
)
from alpasim_plugin.lab.training.scene_families import KNOWN_FAMILIES, Family

CROSSING: Mapping[str, float] = {"car": 0.65, "truck": 0.15, "bus": 0.1, "motorcycle": 0.1}
START_M = 20.0  # of the ego's rear axle
FRONT_M = 4.0  # from there to its front
OPEN: Spec = {"buildings": 0.1, "trees_per_100m": 1.0}  # so that the side roads can be seen

Side = Literal["left", "right"]


def _junction(rng: Rng, time_s: float, turn: str, sides: tuple[Side, ...]) -> Spec:
    """Return a junction that the ego crosses, or turns at, while someone comes from a side.

    Of ten, about seven would meet the ego if it did not slow down, one passes well before or after
    it, one waits at the line, and one has no such car.
    """
    v = number(rng, 7, 10) if turn == "straight" else number(rng, 6, 8)
    before_m, corner_m = number(rng, 42, 62), number(rng, 7, 11, 1)
    width_m, shoulder_m = number(rng, 3.2, 3.8), 0.5
    junction = {
        "kind": "intersection",
        "turn": turn,
        "corner_radius_m": corner_m,
        "arm_length_m": 90.0,
        "crosswalks": bool(rng.random() < 0.7),
    }
    road = {
        "heading_deg": 0.0,
        "shoulder_m": shoulder_m,
        "lane_width_m": width_m,
        "segments": to_length([straight(before_m), junction], path_m(v, time_s)),
    }
    side = pick(rng, *sides)
    down = -1.0 if side == "left" else 1.0  # direction of travel along y
    middle_m = before_m + corner_m + shoulder_m + width_m  # of the road that crosses
    x = round(middle_m + 0.5 * down * width_m, 2)
    meets_s = (x - START_M - FRONT_M) / (v if turn == "straight" else 0.85 * v)
    u = number(rng, 6, 11)
    share = rng.random()
    late_s = number(rng, -1.2, 1.2) if share < 0.7 else pick(rng, -1, 1) * number(rng, 3, 5)
    kind = label(rng, CROSSING)
    waits = -down * (corner_m + width_m + 4.0)
    away_m = (
        [waits, waits]
        if 0.8 < share < 0.9
        else [down * u * (t - meets_s - late_s) for t in (0.0, 20.0)]
    )
    points = [
        [t, x, round(y, 2), round(down * 1.5708, 4)] for t, y in zip((0, 20), away_m, strict=True)
    ]
    crosses = {"kind": "logged", "id": "crosses", "label": kind, "points": points}
    return {
        "road": road,
        "ego": ego(rng, v),
        "actors": [crosses] if share < 0.9 else [],
        "environment": dict(OPEN),
    }


def _merge(rng: Rng, time_s: float) -> Spec:
    """Return a lane that ends while someone drives abreast in the lane to its left."""
    v = number(rng, 8, 13)
    taper = {"kind": "merge", "length_m": number(rng, 45, 70)}
    road = {
        "lanes_forward": 2,
        "lane_width_m": number(rng, 3.2, 3.7),
        "segments": to_length([straight(number(rng, 50, 75)), taper], path_m(v, time_s, 90)),
    }
    beside = {
        "kind": "drive",
        "id": "beside",
        "label": label(rng, CROSSING),
        "lane": 0,
        "s_m": number(rng, -1, 9),
        "speeds": [[0, round(v * number(rng, 0.95, 1.08), 2)]],
    }
    return {"road": road, "ego": ego(rng, v, 1), "actors": [beside] if rng.random() < 0.8 else []}


SIDE_FAMILIES: Mapping[str, Family] = {
    "cross_left": partial(_junction, turn="straight", sides=("left",)),
    "cross_right": partial(_junction, turn="straight", sides=("right",)),
    "turn_right": partial(_junction, turn="right", sides=("left",)),
    "turn_left": partial(_junction, turn="left", sides=("left", "right")),
    "merge": _merge,
}
THREE_FAMILIES: Mapping[str, Family] = {
    **SIDE_FAMILIES,
    **{name: KNOWN_FAMILIES[name] for name in ("street", "long_bend", "junction_turn", "avenue")},
}
