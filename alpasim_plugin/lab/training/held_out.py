"""What the test of unseen families holds out of training, as predicates on a scenario
specification.

Where training has less of the same, the predicate says from where on it is held out: junctions with
two lanes an arm are in training, those with three are not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from alpasim_plugin.lab.training.scene_draws import VEHICLES, Spec

HAIRPIN_RADIUS_M = 35.0
WIDE_ARM_LANES = 3  # in one direction
ACROSS_DEG = 30.0  # between a parked vehicle and the road
CURVATURES = ("curvature_per_m", "start_curvature_per_m", "end_curvature_per_m")


def has_taper(spec: Spec) -> bool:
    """Tell whether a lane ends or opens."""
    return any(segment["kind"] in ("merge", "split") for segment in spec["road"]["segments"])


def has_narrow_gap(spec: Spec) -> bool:
    """Tell whether rows of cars squeeze the lane."""
    return any(segment["kind"] == "narrow_gap" for segment in spec["road"]["segments"])


def has_hairpin(spec: Spec) -> bool:
    """Tell whether a bend has a radius below 35 m."""
    return any(
        abs(segment.get(name, 0.0)) > 1 / HAIRPIN_RADIUS_M
        for segment in spec["road"]["segments"]
        for name in CURVATURES
    )


def has_wide_junction(spec: Spec) -> bool:
    """Tell whether an arm of a junction has three lanes or more in one direction."""
    junctions = [s for s in spec["road"]["segments"] if s["kind"] == "intersection"]
    through = max(spec["road"].get("lanes_forward", 1), spec["road"].get("lanes_backward", 1))
    return any(
        max(through, junction.get("cross_lanes", 1)) >= WIDE_ARM_LANES for junction in junctions
    )


def has_vehicle_across(spec: Spec) -> bool:
    """Tell whether a vehicle is parked across the kerb."""
    return any(
        actor["kind"] == "parked"
        and actor.get("label", "car") in VEHICLES
        and abs(actor.get("yaw_deg", 0.0)) > ACROSS_DEG
        for actor in spec["actors"]
    )


def has_other_object(spec: Spec) -> bool:
    """Tell whether there is an object of class ``other``."""
    return any(actor.get("label") == "other" for actor in spec["actors"])


HELD_OUT: Mapping[str, Callable[[Spec], bool]] = {
    "taper": has_taper,
    "narrow gap": has_narrow_gap,
    "hairpin": has_hairpin,
    "junction with three lanes an arm": has_wide_junction,
    "vehicle across the kerb": has_vehicle_across,
    "object of class other": has_other_object,
}


def held_out_parts(spec: Spec) -> list[str]:
    """Return what a specification has of the parts that are held out.

    Example:
        >>> straight = {"kind": "straight", "length_m": 80.0}
        >>> held_out_parts({"road": {"segments": [straight, {"kind": "merge"}]}, "actors": []})
        ['taper']
    """
    return [name for name, is_in in HELD_OUT.items() if is_in(spec)]
