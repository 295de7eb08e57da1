"""Maps, poses, cameras and road users that cannot be drawn are refused by name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Actor, Box, FTheta, Trajectory
from alpasim_plugin.fixers.semantic_map.draw import draw_map
from alpasim_plugin.fixers.semantic_map.prepare import ActorBox, LaneLine, actor_boxes, prepare_map
from tests.fixers.views import CAR, EMPTY, FISH, PIN, at, fixed_lines, line


def refused(call, *parts):
    with pytest.raises(InputError) as caught:
        call()
    for part in parts:
        assert part in str(caught.value)


def test_nan_in_the_map_names_the_layer_and_the_point():
    bad = line((0, 0, 0), (1, np.nan, 0))
    refused(
        lambda: prepare_map(replace(EMPTY, road_edges=(bad,))),
        "preparing the semantic map",
        "road_boundary",
        "point 1",
        "nan",
    )
    refused(lambda: prepare_map(replace(EMPTY, crosswalks=(bad,))), "crosswalk", "point 1")
    refused(lambda: prepare_map(EMPTY, fixed_lines(LaneLine(bad))), "lane line", "point 1")
    refused(lambda: prepare_map(replace(EMPTY, poles=(np.zeros((2, 2)),))), "pole", "shape (2, 2)")


def test_poses_that_are_none():
    pose = at()
    pose[0, 3] = np.nan
    scene = prepare_map(EMPTY)
    refused(
        lambda: draw_map(scene, PIN, pose), "drawing the semantic map, camera pose", "not finite"
    )
    refused(lambda: draw_map(scene, PIN, np.eye(3)), "shape (3, 3)")
    refused(
        lambda: draw_map(scene, PIN, at(), (ActorBox(np.eye(4) * 2, CAR, "car"),)),
        "actor box (car)",
        "no rotation",
    )
    refused(
        lambda: draw_map(scene, PIN, at(), (ActorBox(np.eye(4), Box(1, -1, 1), "car"),)),
        "actor box (car)",
        "finite sizes",
    )
    refused(lambda: prepare_map(replace(EMPTY, signs=((pose, CAR),))), "sign", "not finite")


def test_areas_and_cameras_that_are_none():
    refused(
        lambda: prepare_map(replace(EMPTY, crosswalks=(line((0, 0, 0), (1, 0, 0)),))),
        "crosswalk",
        "an outline of 2 points",
    )
    scene = prepare_map(EMPTY)
    refused(
        lambda: draw_map(scene, replace(PIN, K=np.diag([-1.0, 1, 1])), at()),
        "camera pin",
        "positive focal lengths",
    )
    refused(lambda: draw_map(scene, replace(PIN, width=0), at()), "camera pin", "0 x 144 pixels")
    refused(
        lambda: draw_map(scene, replace(FISH, lens=FTheta((0.0,), (0.0, 1.0), 0.0)), at()),
        "camera fish",
        "largest angle",
    )
    folding = FTheta((0.0, 0.01), (0.0, 100.0, -80.0), 1.2)
    refused(
        lambda: draw_map(scene, replace(FISH, lens=folding), at()), "camera fish", "does not grow"
    )


def test_actor_boxes_join_poses_with_sizes():
    track = Trajectory(np.array([0]), np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]))
    known = (Actor("a", "car", CAR, track), Actor("b", "bus", CAR, track))
    (one,) = actor_boxes({"b": np.eye(4)}, known)
    assert (one.label, one.box) == ("bus", CAR)
    refused(lambda: actor_boxes({"x": np.eye(4)}, known), "actor x", "a pose without a box")
