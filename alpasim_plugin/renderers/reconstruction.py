"""The renderer ``3dgs``: a model fitted to the logged drive and kept in the cache, or the
scenario's degradation instead.

background.ply, actors/*.ply, sky.png, reconstruction.json      what `Reconstruction.save` writes
sky_views.npz       cameras of the views and, bit by bit, where they show sky

An imported drive has the reconstruction that was fitted to its photographs, shown as it is. Its sky
is a layer of its own: where the model is transparent above the horizon a frame is opaque, because
it shows the sky and no hole, and its depth is 0, because the sky has none. Colours get the exposure
that the recording's camera had near by: frames look as the drive's own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from alpasim_plugin.cameras.lens import lens_camera
from alpasim_plugin.cameras.shutter import at_share
from alpasim_plugin.core.devices import require_device
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.cache import cached
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.types import (
    F32,
    F64,
    STANDING_ID,
    CameraSpec,
    Photograph,
    RecordedFrame,
    RenderRequest,
    Scenario,
)
from alpasim_plugin.gaussians.fit.lens import gain_near
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.gaussians.raster.output import RasterOutput
from alpasim_plugin.gaussians.scene.log_views import SkyMask, SkyView
from alpasim_plugin.gaussians.scene.scene_graph import (
    Level,
    SceneGraph,
    SceneNode,
    SceneView,
    nodes_by_tile,
    tile_numbers,
)
from alpasim_plugin.renderers.gaussian import CleanRenderer, in_memory, scene_of
from alpasim_plugin.renderers.reconstruction_key import (
    REFUSED_S,
    ReconstructionRecipe,
    read_model,
    recipe_of,
    reconstruction_key,
)
from alpasim_plugin.renderers.recorded import built_recording, photograph_recording
from alpasim_plugin.renderers.rolling import SplatRenderer, camera_at
from alpasim_plugin.streets.build_actors import build_actor
from alpasim_plugin.streets.builder import finished

KIND = "reconstructions"
TILE_M = 24.0  # the background is culled in blocks of this size


@dataclass(frozen=True, eq=False)
class Model:
    """A reconstruction ready to be rendered."""

    graph: SceneGraph
    sky: SkyMask


class ReconstructionRenderer(SplatRenderer):
    """Render a reconstruction of the scenario's logged drive; it is fitted first if it is not in
    the cache.

    Args:
        scenario: With the cameras that it is fitted to.
        device: Where it is drawn.
        threads: Of the CPU rasteriser; None leaves their number.
        cameras: Those of the recording, with their lenses, where lenses are drawn; None: the
            scenario's.
    """

    def __init__(
        self,
        scenario: Scenario,
        device: str,
        threads: int | None,
        cameras: Sequence[CameraSpec] | None = None,
    ) -> None:
        self.scenario = scenario
        self.threads = threads
        self.device = require_device(device)
        self.cameras = tuple(scenario.cameras)
        if cameras is not None and self.draws_lenses:
            self.cameras = tuple(cameras)
        self.recipe = recipe_of(scenario, device)
        self.model = model_of(scenario, self.recipe, threads, device)

    def draw(self, views: Sequence[SceneView]) -> list[RasterOutput]:
        """Draw images with depth where they show surfaces."""
        outs = self.model.graph.render_all(views, self.threads, self.device)
        return [out.surface() for out in outs]

    def developed(self, request: RenderRequest, out: RasterOutput) -> RasterOutput:
        """Return the image with the sky opaque where the views of the fit showed it; of a rolling
        shutter as at its middle.
        """
        T_world_camera = request.T_world_camera[1]
        if request.exposure is not None:
            T_world_camera, _ = at_share(request, 0.5)
        camera = camera_at(request, T_world_camera)
        return out.covered(self.model.sky.share(camera, request.camera.name))

    def recorded(self) -> Sequence[RecordedFrame]:
        """Return what the scenario's cameras saw along the log, at the believed poses; the drives
        of a process share what was read.
        """
        recording = replace(self.scenario, cameras=self.cameras)
        key = f"recording:{reconstruction_key(recording, self.recipe)}"
        return in_memory(
            key,
            lambda: built_recording(
                self.scenario,
                scene_of(self.scenario),
                self.model.graph.render,
                self.recipe,
                self.cameras,
            ),
        )


def reconstruction_renderer(
    scenario: Scenario,
    seed: int,
    device: str,
    threads: int | None,
    cameras: Sequence[CameraSpec] | None = None,
) -> Renderer:
    """Make the renderer ``3dgs``: the model of an imported drive, and otherwise what the scenario's
    degradation names; ``cameras`` as of `ReconstructionRenderer`.

    Raises:
        InputError: What is to be fitted is longer than `REFUSED_S`.
    """
    if scenario.model is not None:
        return ImportedRenderer(scenario, device, threads)
    if scenario.degradation.kind == "none":
        return CleanRenderer(scenario, seed, device, threads)
    log_s = float(np.ptp(scenario.ego_log.t_us)) * 1e-6
    if log_s > REFUSED_S:
        raise InputError(
            f"{scenario.scene_id}: 3dgs reconstructs at most {REFUSED_S:.0f} s, the log has {log_s:.0f} s",
            "drive a part of it, or behind clean",
        )
    return ReconstructionRenderer(scenario, device, threads, cameras)


def model_of(
    scenario: Scenario, recipe: ReconstructionRecipe, threads: int | None, device: str
) -> Model:
    """Return the scenario's reconstruction as a scene, read or fitted once per process.

    Raises:
        InputError: The scenario has no camera to fit with.
        InfrastructureError: The cache cannot be written.
    """
    key = reconstruction_key(scenario, recipe)

    def read() -> Model:
        model, sky_views = ensure(scenario, recipe, threads, device)
        return Model(_graph(model, scenario), SkyMask(sky_views))

    return in_memory(f"reconstruction:{key}", read)


def ensure(
    scenario: Scenario,
    recipe: ReconstructionRecipe,
    threads: int | None = None,
    device: str = "cpu",
) -> tuple[Reconstruction, list[SkyView]]:
    """Return a reconstruction and its sky views from the cache; it is fitted first if it is
    not there.
    """
    key = reconstruction_key(scenario, recipe)

    def make(folder: Path) -> None:
        # Needs torch, which takes a second to load and which a cached reconstruction does not need
        from alpasim_plugin.renderers.reconstruction_build import build

        build(scenario, recipe, threads, device, folder)

    name = f"reconstruction of {scenario.scene_id} ({scenario.degradation.kind})"
    return cached(KIND, key, make, read_model, name)


def _graph(model: Reconstruction, scenario: Scenario) -> SceneGraph:
    """Return a model as a scene: its background is cut into tiles, and actors that it lacks are
    spliced in as built ones (paper, App. A).
    """
    tile = tile_numbers(model.background.means[:, :2], TILE_M, 1_000_003)
    fitted = [
        SceneNode(name, "actor", (Level(0.0, cloud),)) for name, cloud in model.actors.items()
    ]
    missing = [
        finished(build_actor(actor, scenario), scenario)
        for actor in scenario.actors
        if actor.actor_id not in model.actors and not actor.actor_id.startswith(STANDING_ID)
    ]
    return SceneGraph(
        nodes_by_tile("fit", [(0.0, model.background, tile)]), [*fitted, *missing], model.sky
    )


class ImportedRenderer(SplatRenderer):
    """Render the reconstruction of an imported drive.

    Raises:
        InputError: The folder of the scenario's model holds no finished reconstruction.
    """

    def __init__(self, scenario: Scenario, device: str, threads: int | None) -> None:
        self.scenario = scenario
        self.threads = threads
        self.device = require_device(device)
        assert scenario.model is not None, "a drive without a model has no such renderer"
        folder = Path(scenario.model)
        self.graph = in_memory(
            f"imported:{reconstruction_key(scenario, None)}",
            lambda: _graph(Reconstruction.load(folder), scenario),
        )
        self.fitted = [
            photograph for photograph in scenario.recording if photograph.use == "fitted"
        ]

    def developed(self, request: RenderRequest, out: RasterOutput) -> RasterOutput:
        """Return the image with the exposure that the recording's camera had near by."""
        place = request.T_world_camera[1][:3, 3]
        return out.exposed(exposure_near(self.fitted, request.camera.name, place))

    def recorded(self) -> Sequence[RecordedFrame]:
        """Return the photographs that the model was fitted to, with the depth that the model has
        there.
        """
        return photograph_recording(
            self.scenario, lambda camera, actors: self.draw([(camera, actors)])[0].on_host().depth
        )

    def draw(self, views: Sequence[SceneView]) -> list[RasterOutput]:
        """Draw images with the sky as an opaque layer without depth."""
        graph_views = [
            (camera, {name: T for name, T in actors.items() if name in self.graph.actors})
            for camera, actors in views
        ]
        outs = self.graph.render_all(graph_views, self.threads, self.device)
        return [
            out.with_sky(camera.above_horizon())
            for out, (camera, _) in zip(outs, graph_views, strict=True)
        ]


def exposure_near(fitted: Sequence[Photograph], camera: str, place: F64) -> F32:
    """Return the gain ``(3,)`` at a place: see `gain_near`; the pinholes of a lens have its own."""
    cameras = [photograph.camera for photograph in fitted]
    return gain_near(
        camera if camera in cameras else lens_camera(camera),
        place,
        cameras,
        np.array([photograph.T_world_camera[:3, 3] for photograph in fitted]),
        np.array([photograph.exposure for photograph in fitted]),
    )
