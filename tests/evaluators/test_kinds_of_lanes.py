"""Shoulders, parking strips, bicycle and bus lanes are road, but no lanes for cars."""

from dataclasses import replace

import numpy as np
import pytest

from tests.evaluators.eval_build import lane, road_map, rollout, scored, track, values_of
from tests.evaluators.motions import CRUISE, N

KINDS = ("shoulder", "parking", "bike", "bus")


def beside(kind):
    """A lane for cars, and one of a kind to the right of it."""
    edges = [np.array([[-50.0, y, 0.0], [200.0, y, 0.0]]) for y in (-1.75, 5.25)]
    return road_map(lane("beside", 0.0, kind=kind), lane("cars", 3.5), edges=edges)


@pytest.mark.parametrize("kind", [*KINDS, "vehicle"])
def test_a_whole_drive_on_a_lane_that_is_not_for_cars_is_told(kind):
    log = rollout(track(CRUISE, 0.0))
    share = values_of(log, beside(kind))["no_car_lane_share"]
    assert share.valid
    assert share.value == (kind in KINDS)
    assert values_of(log, beside(kind))["offroad"].value == 0.0
    assert values_of(rollout(track(CRUISE, 3.5)), beside(kind))["no_car_lane_share"].value == 0.0


def test_half_a_drive_on_a_shoulder_is_half_of_its_steps():
    y = np.where(np.arange(N) < N // 2, 0.0, 3.5)
    log = rollout(track(CRUISE, y))
    flags = scored(log, beside("shoulder"))["no_car_lane_share"].value
    assert flags.tolist() == [1.0] * (N // 2) + [0.0] * (N // 2)
    assert values_of(log, beside("shoulder"))["no_car_lane_share"].value == pytest.approx(0.5)


def test_where_a_lane_for_cars_lies_over_a_shoulder_the_ego_is_in_it():
    lanes = road_map(lane("shoulder", 0.0, kind="shoulder"), lane("exit", 0.5))
    log = rollout(track(CRUISE, 0.0))
    assert values_of(log, lanes)["no_car_lane_share"].value == 0.0


def test_a_shoulder_on_a_bridge_is_not_that_of_the_road_below():
    high = lane("shoulder", 0.0, kind="shoulder")
    up = np.array([0.0, 0.0, 7.0])
    raised = replace(high, centre=high.centre + up, left=high.left + up, right=high.right + up)
    log = rollout(track(CRUISE, 0.0))
    assert values_of(log, road_map(raised, lane("road", 0.0)))["no_car_lane_share"].value == 0.0
    above = rollout(track(CRUISE, 0.0, z=7.0))
    assert values_of(above, road_map(raised, lane("road", 0.0)))["no_car_lane_share"].value == 1.0


@pytest.mark.parametrize(
    ("preset", "name", "value"),
    [
        ("paper", "offroad", 0.0),
        ("alpasim", "offroad", 0.0),
        ("nuplan", "nuplan_drivable_area", 1.0),
        ("navsim", "navsim_dac", 1.0),
    ],
)
def test_other_presets_keep_the_definition_of_their_source(preset, name, value):
    values = values_of(rollout(track(CRUISE, 0.0)), beside("shoulder"), preset)
    assert values[name].value == value
    assert "no_car_lane_share" not in values
