"""Render Gaussian scenes: ``clean``, the scene as built.

A frame is drawn at the shutter's end, unless its request says when its pixels are exposed
(`renderers.rolling`).
"""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

import numpy as np

from alpasim_plugin.core.devices import require_device
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Frame, RenderRequest, Scenario
from alpasim_plugin.gaussians.raster.output import RasterOutput
from alpasim_plugin.gaussians.scene.scene_graph import SceneGraph, SceneView, with_background
from alpasim_plugin.renderers.background import read_background
from alpasim_plugin.renderers.built_road import BuiltRoad
from alpasim_plugin.renderers.reconstruction_key import reconstruction_key
from alpasim_plugin.renderers.rolling import SplatRenderer
from alpasim_plugin.streets.builder import build_scene
from alpasim_plugin.world.ground import height_at

CACHED_SCENES = 4
ALL = np.ones((1, 1), dtype=np.float32)

T = TypeVar("T")
_cache: OrderedDict[str, object] = OrderedDict()


class CleanRenderer(SplatRenderer):
    """Render the scene as built; its sky counts as opaque.

    Of frames that stay on a device the first of each camera is looked at for a missing street, of
    others every one: see `BuiltRoad`.

    Raises:
        InputError: Nothing was built: the scenario is an imported drive.
        RendererError: A frame lacks the street.
    """

    def __init__(self, scenario: Scenario, seed: int, device: str, threads: int | None) -> None:
        if scenario.model is not None:
            raise InputError(
                f"{scenario.scene_id}: a recorded drive: nothing was built, so there is no built truth to show",
                "use 3dgs; photographs are the truth of a recorded drive (simrun bench real)",
            )
        self.scenario, self.seed, self.threads = scenario, seed, threads
        self.device = require_device(device)
        self.scene = scene_of(scenario)
        background = scenario.background
        self.road = None if background and not background.keep_road else BuiltRoad(scenario)
        self._looked_at: set[str] = set()

    def render_batch(self, requests: Sequence[RenderRequest]) -> list[Frame]:
        """Render the frames of an instant, and refuse one that lacks the street."""
        frames = super().render_batch(requests)
        for request, frame in zip(requests, frames, strict=True):
            stays_there = frame.is_pending("depth") and request.camera.name in self._looked_at
            if self.road is not None and not stays_there:
                self.road.check(request, frame)
                self._looked_at.add(request.camera.name)
        return frames

    def draw(self, views: Sequence[SceneView]) -> list[RasterOutput]:
        """Draw images; what is seen through the scene counts as opaque, and has no depth."""
        outs = self.scene.render_all(views, self.threads, self.device)
        surfaces = [out.surface() for out in outs]
        if self.scenario.background is not None:
            return surfaces
        return [surface.covered(ALL) for surface in surfaces]


def scene_of(scenario: Scenario) -> SceneGraph:
    """Return the scenario's scene, built once per process."""
    return in_memory(f"scene:{reconstruction_key(scenario, None)}", partial(_build, scenario))


def clear_cache(kind: str = "") -> None:
    """Forget what was built, or what is kept under keys that begin with ``kind``."""
    for key in [key for key in _cache if key.startswith(kind)]:
        del _cache[key]


def _build(scenario: Scenario) -> SceneGraph:
    graph = build_scene(scenario, partial(height_at, scenario.ground))
    if scenario.background is None:
        return graph
    cloud, *_ = read_background(scenario.background, scenario.ego_log.xyz)
    return with_background(graph, cloud, scenario.background.T_world_file)


def in_memory(key: str, make: Callable[[], T]) -> T:
    """Return what is kept under a key in this process, made if it is not there; the least recently
    used goes first.
    """
    if key not in _cache:
        _cache[key] = make()
        while len(_cache) > 3 * CACHED_SCENES:  # a scene, its reconstruction and its recording
            _cache.popitem(last=False)
    _cache.move_to_end(key)
    return _cache[key]  # type: ignore[return-value]
