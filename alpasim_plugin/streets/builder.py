"""Build a scene graph of Gaussians from a map, tracks and an environment."""

from collections.abc import Sequence
from dataclasses import replace
from threading import Lock

import numpy as np

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.gaussians.scene.scene_graph import (
    Camera,
    Level,
    NodeSet,
    SceneGraph,
    SceneNode,
)
from alpasim_plugin.gaussians.scene.sky import Sky, make_sky
from alpasim_plugin.gaussians.sh import dc_from_rgb
from alpasim_plugin.streets.build_actors import build_actors
from alpasim_plugin.streets.build_facades import build_facades
from alpasim_plugin.streets.build_road import build_road
from alpasim_plugin.streets.build_street import build_street
from alpasim_plugin.streets.markings import marking_strokes
from alpasim_plugin.streets.site import HeightAt, make_site, path_of, section_of
from alpasim_plugin.world.ground import BUILT_WHOLE_M, SIGHT_M

# On everything but the sky, by sky
LIGHT = {
    "clear": (1.0, 1.0, 1.0),
    "overcast": (0.86, 0.88, 0.91),
    "dusk": (0.74, 0.63, 0.62),
}


def build_scene(scenario: Scenario, height_at: HeightAt) -> SceneGraph:
    """Build the scene of a scenario; the same scenario gives bit-identical Gaussians.

    Args:
        scenario: Map, tracks, environment and seed. Where it names a background file this function
            draws actors and sky only, and the road if the background keeps it; give the file's
            Gaussians to `with_background`.
        height_at: Ground height under ``(N, 2+)`` world points, ``(N,)`` metres.
    """
    sky = make_sky(scenario.environment.sky, stream(scenario.scene_id, scenario.seed, "scene/sky"))
    actors = [finished(node, scenario) for node in build_actors(scenario)]
    if scenario.background is not None and not scenario.background.keep_road:
        return SceneGraph([], actors, sky)
    if scenario.background is not None:
        site = make_site(scenario, height_at)
        nodes = build_road(site, marking_strokes(site))
        return SceneGraph([finished(node, scenario) for node in nodes], actors, sky)
    if len(path_of(scenario)) > BUILT_WHOLE_M:
        return LongScene(scenario, height_at, actors, sky)
    return SceneGraph(build_surroundings(scenario, height_at), actors, sky)


def build_surroundings(
    scenario: Scenario, height_at: HeightAt, section: int | None = None
) -> list[SceneNode]:
    """Build everything that does not move, or a section of it: see `make_site`."""
    site = make_site(scenario, height_at, section)
    road = build_road(site, marking_strokes(site))
    facades, houses = build_facades(site)
    return [finished(node, scenario) for node in (*road, *facades, *build_street(site, houses))]


class LongScene(SceneGraph):
    """A scene that is built in sections along the path, as a camera comes near to them; those out of
    its sight are freed.

    What a camera sees depends on where it stands, not on where cameras stood before.
    """

    def __init__(
        self, scenario: Scenario, height_at: HeightAt, actors: Sequence[SceneNode], sky: Sky
    ) -> None:
        super().__init__([], actors, sky)
        self._scenario = scenario
        self._height_at = height_at
        self._path = path_of(scenario)
        self._sections: dict[int, list[SceneNode]] = {}
        self._sets: dict[tuple[int, ...], NodeSet] = {}
        self._lock = Lock()  # a server draws views of several drives at once

    @property
    def background(self) -> tuple[SceneNode, ...]:
        """Return the nodes of the sections that are held now."""
        return tuple(node for nodes in self._sections.values() for node in nodes)

    def backgrounds(self, cameras: Sequence[Camera]) -> Sequence[NodeSet]:
        """Build the sections that cameras may see, free the others, and return those of each."""
        near = [self._near(camera) for camera in cameras]
        needed = sorted(set().union(*near))
        with self._lock:
            if needed != list(self._sections):
                self._sections = {
                    i: self._sections[i] if i in self._sections else self._built(i) for i in needed
                }
                self._sets = {}
            return [self._set_of(sections) for sections in near]

    def _near(self, camera: Camera) -> tuple[int, ...]:
        """Return the sections within sight of a camera; at least the nearest."""
        away_m = np.linalg.norm(self._path[:, :2] - camera.centre_world[:2], axis=1)
        points = np.flatnonzero(away_m <= max(SIGHT_M, float(away_m.min())))
        return tuple(np.unique(section_of(points)).tolist())

    def _set_of(self, sections: tuple[int, ...]) -> NodeSet:
        if sections not in self._sets:
            self._sets[sections] = NodeSet.of(node for i in sections for node in self._sections[i])
        return self._sets[sections]

    def _built(self, section: int) -> list[SceneNode]:
        """Build a section; its nodes get names of their own."""
        nodes = build_surroundings(self._scenario, self._height_at, section)
        return [replace(node, name=f"{section}/{node.name}") for node in nodes]


def finished(node: SceneNode, scenario: Scenario) -> SceneNode:
    """Return a built node in the light of a scenario's sky."""
    light = np.array(LIGHT[scenario.environment.sky])
    if np.all(light == 1.0):
        return replace(node, is_built=True)
    levels = []
    for level in node.levels:
        sh = level.cloud.sh * light
        sh[:, 0] += dc_from_rgb(0.5 * light)  # colour is 0.5 + C0 dc: the half is lit as well
        levels.append(Level(level.cell_m, replace(level.cloud, sh=sh.astype(np.float32))))
    return replace(node, levels=tuple(levels), is_built=True)
