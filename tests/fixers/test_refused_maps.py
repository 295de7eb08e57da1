"""Maps and road users that cannot be drawn are refused."""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Actor, Trajectory
from alpasim_plugin.fixers.semantic_map.prepare import actor_boxes, prepare_map
from tests.fixers.views import CAR, EMPTY, at, line

NAN_LINE = line((0, 0, 0), (1, np.nan, 0))
NAN_POSE = at()
NAN_POSE[0, 3] = np.nan
TRACK = Trajectory(np.array([0]), np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]))
KNOWN = (Actor("a", "car", CAR, TRACK), Actor("b", "bus", CAR, TRACK))


@pytest.mark.parametrize(
    "call",
    [
        lambda: prepare_map(replace(EMPTY, road_edges=(NAN_LINE,))),
        lambda: prepare_map(replace(EMPTY, crosswalks=(NAN_LINE,))),
        lambda: prepare_map(replace(EMPTY, poles=(np.zeros((2, 2)),))),
        lambda: prepare_map(replace(EMPTY, signs=((NAN_POSE, CAR),))),
        lambda: prepare_map(replace(EMPTY, crosswalks=(line((0, 0, 0), (1, 0, 0)),))),
        lambda: actor_boxes({"x": np.eye(4)}, KNOWN),
    ],
)
def test_what_cannot_be_drawn_is_refused(call):
    with pytest.raises(InputError):
        call()


def test_actor_boxes_join_poses_with_sizes():
    (one,) = actor_boxes({"b": np.eye(4)}, KNOWN)
    assert (one.label, one.box) == ("bus", CAR)
