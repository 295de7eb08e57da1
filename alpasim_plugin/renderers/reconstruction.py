"""The renderer ``3dgs``: a model fitted to the logged drive and kept in the cache, or the scenario's degradation instead.

background.ply, actors/*.ply, sky.png, reconstruction.json      what `Reconstruction.save` writes
sky_views.npz       cameras of the views and, bit by bit, where they show sky
hashes.json         file name to SHA-256; written last
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from alpasim_plugin.core.types import F64, Frame, RecordedFrame, RenderRequest, Scenario
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.gaussians.raster.output import RasterOutput
from alpasim_plugin.gaussians.scene.build_actors import build_actor
from alpasim_plugin.gaussians.scene.builder import LIGHT, lit
from alpasim_plugin.gaussians.scene.log_views import SkyMask, SkyView
from alpasim_plugin.gaussians.scene.scene_graph import Level, SceneGraph, SceneNode, nodes_by_tile, tile_numbers
from alpasim_plugin.plugins.interfaces import Renderer
from alpasim_plugin.renderers.cache import cached
from alpasim_plugin.renderers.gaussian import CleanRenderer, SurrogateRenderer, backend_of, in_memory, scene_of
from alpasim_plugin.renderers.imported import ImportedRenderer
from alpasim_plugin.renderers.reconstruction_files import read_model
from alpasim_plugin.renderers.reconstruction_key import ReconstructionRecipe, recipe_of, reconstruction_key
from alpasim_plugin.renderers.recorded import built_recording
from alpasim_plugin.renderers.rolling import draw_request

KIND = "reconstructions"
TILE_M = 24.0  # the background is culled in blocks of this size


@dataclass(frozen=True, eq=False)
class Model:
    """A reconstruction ready to be rendered."""

    graph: SceneGraph
    sky: SkyMask


class ReconstructionRenderer(Renderer):
    """Render a reconstruction of the scenario's logged drive; it is fitted first if it is not in the cache.

    Attributes:
        stats: Counts of the last frame: ``visible`` Gaussians, ``nodes`` drawn and ``nodes_total``.
    """

    def __init__(self, scenario: Scenario, device: str, threads: int | None) -> None:
        self.scenario, self.threads = scenario, threads
        self.backend = backend_of(device)
        self.model = model_of(scenario, threads)
        self.stats: Mapping[str, int] = {}

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame."""

        def draw(camera: PinholeCamera, actors: Mapping[str, F64]) -> RasterOutput:
            out = self.model.graph.render(camera, actors, self.threads, self.backend)
            return replace(out, alpha=np.maximum(out.alpha, self.model.sky.share(camera)), depth=out.surface_depth())

        out = draw_request(request, draw, self.backend)
        self.stats = out.stats
        return Frame(request.t_us, request.camera.name, out.to_uint8(), out.alpha, out.depth)

    def recorded(self) -> Sequence[RecordedFrame]:
        """Return what the scenario's cameras saw along the log, at the poses that the reconstruction believes."""
        return built_recording(self.scenario, scene_of(self.scenario), self.model.graph.render, recipe_of(self.scenario))


def reconstruction_renderer(scenario: Scenario, seed: int, device: str, threads: int | None) -> Renderer:
    """Make the renderer ``3dgs``: the model of an imported drive, and otherwise what the scenario's degradation names."""
    if scenario.model is not None:
        return ImportedRenderer(scenario, device, threads)
    amount = scenario.degradation
    if amount.kind == "none" or (amount.kind == "surrogate" and amount.severity == 0):
        return CleanRenderer(scenario, seed, device, threads)
    if amount.kind == "surrogate":
        return SurrogateRenderer(scenario, seed, device, threads)
    return ReconstructionRenderer(scenario, device, threads)


def model_of(scenario: Scenario, threads: int | None = None) -> Model:
    """Return the scenario's reconstruction as a scene, read or fitted once per process.

    Raises:
        InputError: The scenario's degradation names no fit, or it has no camera to fit with.
        InfrastructureError: The cache cannot be written.
    """
    recipe = recipe_of(scenario)
    key = reconstruction_key(scenario, recipe)
    return in_memory(f"reconstruction:{key}", lambda: scene_from(scenario, *ensure(scenario, recipe, threads)))


def ensure(
    scenario: Scenario, recipe: ReconstructionRecipe, threads: int | None = None, *, again: bool = False
) -> tuple[Reconstruction, list[SkyView]]:
    """Return a reconstruction and its sky views from the cache; it is fitted first if it is not there, or if ``again``."""
    from alpasim_plugin.renderers.reconstruction_build import build  # needs torch, which a cached reconstruction does not

    key = reconstruction_key(scenario, recipe)
    what = f"reconstruction of {scenario.scene_id} ({scenario.degradation.kind})"
    return cached(KIND, key, partial(build, scenario, recipe, threads), read_model, what, again=again)


def scene_from(scenario: Scenario, model: Reconstruction, sky_views: Sequence[SkyView]) -> Model:
    """Join a reconstruction's parts; actors that it lacks are spliced in from the scene as built (paper, App. A)."""
    tile = tile_numbers(model.background.means[:, :2], TILE_M, 1_000_003)
    background = nodes_by_tile("fit", [(0.0, model.background, tile)])
    light = np.array(LIGHT[scenario.environment.sky])
    actors = [
        SceneNode(a.actor_id, "actor", (Level(0.0, model.actors[a.actor_id]),))
        if a.actor_id in model.actors
        else lit(build_actor(a, scenario.scene_id, scenario.seed), light)
        for a in scenario.actors
    ]
    return Model(SceneGraph(background, actors, model.sky), SkyMask(sky_views))
