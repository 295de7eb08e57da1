"""Families for a policy with cameras to the sides: someone comes from where the front camera does
not look, and the expert lets them pass.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Literal

from alpasim_plugin.lab.training.scene_draws import (
    SPACING_M,
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
BARE: Spec = {"buildings": 0.0, "trees_per_100m": 0.0, "poles_spacing_m": 0}
OPEN: Spec = {"buildings": 0.2, "trees_per_100m": 2.0}  # the side roads can be seen

Side = Literal["left", "right"]


def _junction(rng: Rng, time_s: float, turn: str, sides: tuple[Side, ...]) -> Spec:
    """Return a junction that the ego crosses, or turns at, while others come from a side.

    They are faster than the ego, so that the front camera shows them too late. Of ten, a row of
    vehicles meets the ego in five if it does not slow down, one passes well before or after it in
    two, one waits at the line in one, and nobody comes in two. In three of ten, one of the harmless
    kinds is on the other side as well.
    """
    across = turn == "straight"
    v = number(rng, 6, 9) if across else number(rng, 6, 8)
    u = number(rng, 10, 15) if across else number(rng, 8, 11)
    before_m = number(rng, 42, 58)
    corner_m = number(rng, 7, 11, 1)
    width_m = number(rng, 3.2, 3.8)
    shoulder_m = 0.5
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
    around = BARE if rng.random() < 0.8 else OPEN
    side = pick(rng, *sides)
    other_side: Side = "right" if side == "left" else "left"
    actors: list[Spec] = []
    for name, from_side, share in (
        ("crosses", side, rng.random()),
        ("crosses-other", other_side, 0.5 + rng.random()),
    ):
        down = -1.0 if from_side == "left" else 1.0  # direction of travel along y
        x = round(before_m + corner_m + shoulder_m + width_m + 0.5 * down * width_m, 2)
        meets_s = (x - START_M - FRONT_M) / (v if across else 0.85 * v)
        kind = label(rng, CROSSING)
        headway_s = SPACING_M[kind] / u + number(rng, 0.5, 1.1)
        first_s = number(rng, -1.8, -0.3)
        alone_s = pick(rng, -1, 1) * number(rng, 4, 6)
        places: list[tuple[float, float]] = []  # along y at 0 and 20 s, in the direction of travel
        if share < 0.7:
            late_s = [first_s + i * headway_s for i in range(4)] if share < 0.5 else [alone_s]
            places = [
                (u * (0 - meets_s - delay_s), u * (20 - meets_s - delay_s)) for delay_s in late_s
            ]
        elif share < 0.8:
            places = [(-(corner_m + width_m + 4.0),) * 2]
        for i, (begins_m, ends_m) in enumerate(places):
            points = [
                [t, x, round(down * y, 2), round(down * 1.5708, 4)]
                for t, y in ((0, begins_m), (20, ends_m))
            ]
            actors.append({"kind": "logged", "id": f"{name}-{i}", "label": kind, "points": points})
    return {"road": road, "ego": ego(rng, v), "actors": actors, "environment": dict(around)}


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
    **{
        name: KNOWN_FAMILIES[name]
        for name in ("street", "long_bend", "junction_turn", "avenue", "motorway")
    },
}
