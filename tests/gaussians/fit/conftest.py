"""A small posed scene: a wall of coloured Gaussians, a floor, and an actor that crosses in front of
them.
"""

from dataclasses import dataclass

import numpy as np
import pytest

from alpasim_plugin.core.geometry import se3
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import Box
from alpasim_plugin.gaussians import GaussianCloud, PinholeCamera
from alpasim_plugin.gaussians.fit.start import Start, start_from_depth
from alpasim_plugin.gaussians.fit.views import PosedView, seen_from
from alpasim_plugin.gaussians.scene.scene_graph import Level, SceneGraph, SceneNode
from alpasim_plugin.gaussians.scene.sky import make_sky
from alpasim_plugin.gaussians.sh import dc_from_rgb

WIDTH = 48
HEIGHT = 32
FAR = np.array([4.0e5, -2.0e5, 100.0])  # a scene that lies where float32 has steps of 3 cm
BOX = Box(4.0, 2.0, 1.6)


@dataclass(frozen=True, eq=False)
class Posed:
    """A scene with views of it; world z is up, the cameras look along world x and slide along y."""

    scene: SceneGraph
    views: list[PosedView]
    start: Start


def patch(centre, spread, count, rng, size):
    """Return opaque round Gaussians of random colours around a centre."""
    means = np.asarray(centre) + rng.uniform(-1, 1, (count, 3)) * np.asarray(spread)
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    sh = dc_from_rgb(rng.uniform(0.1, 0.9, (count, 3)))[:, None, :]
    return GaussianCloud(means, quats, np.full((count, 3), size), np.full(count, 0.95), sh)


def at(x, y, z):
    """Return a place of the scene in the world."""
    return FAR + np.array([x, y, z])


def camera_at(y_m):
    """Return a camera that looks along world x from 1.5 m above the ground."""
    T = np.eye(4)
    T[:3, :3] = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])  # columns: right, down, forward
    T[:3, 3] = at(0, y_m, 1.5)
    K = np.array([[40.0, 0, WIDTH / 2], [0, 40.0, HEIGHT / 2], [0, 0, 1]])
    return PinholeCamera.from_pose(WIDTH, HEIGHT, K, T)


def actor_pose(i):
    """Return where the actor is in view i: it crosses and turns."""
    yaw = 0.1 * i
    return se3(at(7.0, -2.0 + 0.5 * i, 0.8), [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])


@pytest.fixture(scope="session")
def posed():
    """Give eight views of the scene."""
    rng = stream("fit-tests", 0, "scene")
    wall = patch(at(12, 0, 2), [0.3, 6, 2.2], 250, rng, 0.5)
    floor = patch(at(8, 0, 0), [4, 5, 0.05], 200, rng, 0.4)
    actor = patch([0, 0, 0], [1.6, 0.8, 0.6], 40, rng, 0.3)
    background = SceneNode(
        "all", "background", (Level(0.0, GaussianCloud.concatenate([wall, floor])),)
    )
    scene = SceneGraph(
        [background],
        [SceneNode("car", "actor", (Level(0.0, actor),))],
        make_sky("clear", stream("fit-tests", 0, "sky")),
    )
    views = [
        seen_from(camera_at(0.4 * i - 1.4), scene, {"car": actor_pose(i)}, f"view-{i}", 1)
        for i in range(8)
    ]
    return Posed(scene, views, start_from_depth(views, {"car": BOX}, 300, "fit-tests", 0, 60))
