"""The renderer ``3dgs`` of an imported drive: the reconstruction that was fitted to its photographs, shown as it is.

The sky is a layer of its own: where the model is transparent above the horizon a frame is opaque, because it shows the sky and no hole, and
its depth is 0, because the sky has none. Colours get the exposure that the recording's camera had near by: frames look as the drive's own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F32, F64, STANDING_ID, Bool, Frame, Photograph, RecordedFrame, RenderRequest, Scenario
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.fit.balance import gain_between
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.gaussians.raster.output import RasterOutput
from alpasim_plugin.gaussians.scene.build_actors import build_actor
from alpasim_plugin.gaussians.scene.scene_graph import Level, SceneGraph, SceneNode, nodes_by_tile, tile_numbers
from alpasim_plugin.plugins.interfaces import Renderer
from alpasim_plugin.renderers.gaussian import backend_of, in_memory, scene_key
from alpasim_plugin.renderers.recorded import photograph_recording
from alpasim_plugin.renderers.rolling import camera_at, draw_request

TILE_M = 24.0  # the background is culled in blocks of this size
OPAQUE = 0.5


class ImportedRenderer(Renderer):
    """Render the reconstruction of an imported drive.

    Attributes:
        stats: Counts of the last frame: ``visible`` Gaussians, ``nodes`` drawn and ``nodes_total``.

    Raises:
        InputError: The scenario names no model, or its folder holds no finished reconstruction.
    """

    def __init__(self, scenario: Scenario, device: str, threads: int | None) -> None:
        self.scenario, self.threads = scenario, threads
        self.backend = backend_of(device)
        self.graph = graph_of(scenario)
        self.exposures = Exposures.of(scenario.recording)
        self.stats: Mapping[str, int] = {}

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame."""
        out = draw_request(request, self._drawn, self.backend)
        place = camera_at(request, request.T_world_camera[1]).centre_world
        rgb = np.clip(out.rgb * self.exposures.near(request.camera.name, place), 0.0, 1.0)
        shown = replace(out, rgb=np.asarray(rgb, np.float32))
        self.stats = out.stats
        return Frame(request.t_us, request.camera.name, shown.to_uint8(), out.alpha, out.depth)

    def recorded(self) -> Sequence[RecordedFrame]:
        """Return the photographs that the model was fitted to, with the depth that the model has there."""
        return photograph_recording(self.scenario, lambda camera, actors: self._drawn(camera, actors).depth)

    def _drawn(self, camera: PinholeCamera, actors: Mapping[str, F64]) -> RasterOutput:
        """Render with the sky as an opaque layer without depth."""
        known = {name: T for name, T in actors.items() if name in self.graph.actors}
        out = self.graph.render(camera, known, self.threads, self.backend)
        sky = (out.alpha < OPAQUE) & above_horizon(camera)
        return replace(out, alpha=np.where(sky, np.float32(1), out.alpha), depth=np.where(sky, np.float32(0), out.depth))


def graph_of(scenario: Scenario) -> SceneGraph:
    """Return the model of an imported drive as a scene, read once per process; road users that it lacks are drawn as built ones are."""
    if scenario.model is None:
        raise InputError(
            "showing an imported drive", scenario.scene_id, "no model", "import the drive again: simrun import drive FOLDER -o OUT"
        )
    folder = Path(scenario.model)

    def read() -> SceneGraph:
        model = Reconstruction.load(folder)
        background = nodes_by_tile("fit", [(0.0, model.background, tile_numbers(model.background.means[:, :2], TILE_M, 1_000_003))])
        actors = [
            SceneNode(a.actor_id, "actor", (Level(0.0, model.actors[a.actor_id]),))
            if a.actor_id in model.actors
            else build_actor(a, scenario.scene_id, scenario.seed)
            for a in scenario.actors
            if not a.actor_id.startswith(STANDING_ID)
        ]
        return SceneGraph(background, actors, model.sky)

    return in_memory(f"imported:{scene_key(scenario)}:{folder}", read)


def above_horizon(camera: PinholeCamera) -> Bool:
    """Return which pixels ``(H, W)`` look up, towards +z of the world."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    up = camera.T_camera_world[:3, 2]
    return np.asarray((u - camera.cx) / camera.fx * up[0] + (v - camera.cy) / camera.fy * up[1] + up[2] > 0)


@dataclass(frozen=True, eq=False)
class Exposures:
    """The gains of the photographs that a model was fitted to, by place.

    Attributes:
        cameras: ``N`` names.
        centres: ``(N, 3)`` metres, world.
        gains: ``(N, 3)`` of red, green and blue.
    """

    cameras: tuple[str, ...]
    centres: F64
    gains: F64

    @classmethod
    def of(cls, recording: Sequence[Photograph]) -> Exposures:
        """Take those of the fitted photographs: others were not explained by the fit."""
        fitted = [one for one in recording if one.use == "fitted"]
        centres = np.array([one.T_world_camera[:3, 3] for one in fitted]).reshape(-1, 3)
        return cls(tuple(one.camera for one in fitted), centres, np.array([one.exposure for one in fitted]).reshape(-1, 3))

    def near(self, camera: str, place: F64) -> F32:
        """Return the gain ``(3,)`` at a place: of the two nearest photographs of that camera, or of all where it took none."""
        mine = np.array([name == camera for name in self.cameras], dtype=bool)
        rows = np.flatnonzero(mine) if mine.any() else np.arange(len(self.cameras))
        return gain_between(self.centres[rows], self.gains[rows], place)
