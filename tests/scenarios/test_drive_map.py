"""The map of an imported drive: everything that a map holds is laid onto the drive's ground, written
and read again.
"""

import json
from dataclasses import fields, is_dataclass

import numpy as np
import pytest

from alpasim_plugin.core.geometry import se2
from alpasim_plugin.core.types import Box, Lane, LaneMap, Marking, Signal
from alpasim_plugin.drives.placing import laid_map
from alpasim_plugin.world.ground import flat
from scenarios.drive import _map_document, _map_of

ROAD_M = 5.0


def line(y_m, z_m=ROAD_M):
    return np.array([[0.0, y_m, z_m], [20.0, y_m, z_m]])


def light(**rest):
    stop = np.array([[15.0, 0.0, ROAD_M], [15.0, 3.5, ROAD_M]])
    return Signal(stop, 0.5, (("red", 30), ("green", 20)), 5, "light", ("a",), **rest)


@pytest.fixture
def whole_map():
    """Give a map in which no field is empty, on a road 5 m high."""
    lane = Lane("a", line(0.0), line(1.75), line(-1.75), successors=("b",))
    return LaneMap(
        {"a": lane},
        road_edges=(line(-2.0),),
        drivable_areas=(line(2.0),),
        crosswalks=(line(1.0),),
        stop_lines=(line(0.5),),
        markings=(Marking(line(1.75), "dashed_white"),),
        poles=(np.array([[10.0, 4.0, ROAD_M], [10.0, 4.0, ROAD_M + 3]]),),
        signs=((se2(12.0, 4.0, 0.3, ROAD_M + 2), Box(0.05, 0.6, 0.6)),),
        signals=(light(head=np.array([15.0, 4.0, ROAD_M + 4])),),
        give_way=(light(),),
    )


def content(value):
    if isinstance(value, np.ndarray):
        return value.tolist()
    if is_dataclass(value):
        return {field.name: content(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {name: content(part) for name, part in value.items()}
    if isinstance(value, tuple):
        return [content(part) for part in value]
    return value


def test_every_field_of_a_map_is_read_as_it_was_written(whole_map):
    assert all(content(getattr(whole_map, field.name)) for field in fields(LaneMap))
    read = _map_of(json.loads(json.dumps(_map_document(whole_map))))
    for field in fields(LaneMap):
        assert content(getattr(read, field.name)) == content(getattr(whole_map, field.name))
    unknown = _map_of(json.loads(json.dumps(_map_document(LaneMap(whole_map.lanes)))))
    assert unknown.signals is None


def test_lines_lie_on_the_ground_and_what_stands_keeps_its_height_above_it(whole_map):
    laid = laid_map(whole_map, flat(-1.0))
    for lines in (laid.road_edges, laid.drivable_areas, laid.crosswalks, laid.stop_lines):
        assert np.all(lines[0][:, 2] == -1.0)
    assert np.all(laid.markings[0].xyz[:, 2] == -1.0)
    assert laid.poles[0][:, 2] == pytest.approx([-1.0, 2.0])
    assert laid.signs[0][0][2, 3] == pytest.approx(1.0)
    assert laid.signals[0].head[2] == pytest.approx(3.0)
    assert np.all(laid.signals[0].stop[:, 2] == -1.0)
