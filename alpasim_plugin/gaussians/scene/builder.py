"""Build a scene graph of Gaussians from a map, tracks and an environment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64, Scenario
from alpasim_plugin.gaussians.cloud import GaussianCloud, placed_cloud
from alpasim_plugin.gaussians.scene.build_actors import build_actors
from alpasim_plugin.gaussians.scene.build_facades import build_facades
from alpasim_plugin.gaussians.scene.build_road import build_road
from alpasim_plugin.gaussians.scene.build_street import build_street
from alpasim_plugin.gaussians.scene.paint import paint_strokes
from alpasim_plugin.gaussians.scene.scene_graph import (
    SceneGraph,
    SceneNode,
    nodes_by_tile,
    tile_numbers,
)
from alpasim_plugin.gaussians.scene.site import HeightAt, make_site
from alpasim_plugin.gaussians.scene.sky import make_sky
from alpasim_plugin.gaussians.sh import dc_from_rgb

FILE_TILE_M = 16.0
LIGHT = {
    "clear": (1.0, 1.0, 1.0),
    "overcast": (0.86, 0.88, 0.91),
    "dusk": (0.74, 0.63, 0.62),
}  # on everything but the sky, by sky


def build_scene(scenario: Scenario, height_at: HeightAt) -> SceneGraph:
    """Build the scene of a scenario; the same scenario gives bit-identical Gaussians.

    Args:
        scenario: Map, tracks, environment and seed. Where it names a background file this function
            draws actors and sky only, and the road if the background keeps it; give the file's
            Gaussians to `with_background`.
        height_at: Ground height under ``(N, 2+)`` world points, ``(N,)`` metres.
    """
    sky = make_sky(scenario.environment.sky, stream(scenario.scene_id, scenario.seed, "scene/sky"))
    light = np.array(LIGHT[scenario.environment.sky])
    actors = [lit(node, light) for node in build_actors(scenario)]
    if scenario.background is not None and not scenario.background.keep_road:
        return SceneGraph([], actors, sky)
    site = make_site(scenario, height_at)
    nodes = build_road(site, paint_strokes(site))
    if scenario.background is not None:
        return SceneGraph([lit(node, light) for node in nodes], actors, sky)
    facades, houses = build_facades(site)
    return SceneGraph(
        [lit(node, light) for node in (*nodes, *facades, *build_street(site, houses))], actors, sky
    )


def with_background(graph: SceneGraph, cloud: GaussianCloud, T_world_file: F64) -> SceneGraph:
    """Return the scene with a Gaussian model as its background, cut into blocks that are culled one
    by one.

    Args:
        graph: Actors and sky, and a road that is drawn with the model.
        cloud: The model in its file's frame.
        T_world_file: ``(4, 4)`` rotation, translation and one scale for all axes.
    """
    placed = placed_cloud(cloud, T_world_file)
    nodes = nodes_by_tile(
        "file", [(0.0, placed, tile_numbers(placed.means[:, :2], FILE_TILE_M, 1_000_003))]
    )
    return SceneGraph(
        [*graph.background, *nodes],
        list(graph.actors.values()),
        graph.sky,
    )


def lit(node: SceneNode, light: F64) -> SceneNode:
    """Return the node with all colours multiplied by ``light (3,)``."""
    if np.all(light == 1.0):
        return node
    levels = []
    for level in node.levels:
        sh = level.cloud.sh * light
        sh[:, 0] += dc_from_rgb(0.5 * light)  # colour is 0.5 + C0 dc: the half is lit as well
        levels.append(replace(level, cloud=replace(level.cloud, sh=sh.astype(np.float32))))
    return replace(node, levels=tuple(levels))
