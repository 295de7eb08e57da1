"""Render Gaussian scenes: ``clean``, the scene as built, and the surrogate of a bad reconstruction
of it.

A frame is drawn at the shutter's end, unless its request says when its pixels are exposed
(`renderers.rolling`). Runs of this project do not say so, and no policy here uses more than the
pose at the frame's time; a request of AlpaSim does.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import interpolate, inverse
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.types import F64, Frame, RecordedFrame, RenderRequest, Scenario
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.fit.views import scaled_camera
from alpasim_plugin.gaussians.raster.output import RasterOutput
from alpasim_plugin.gaussians.raster.rasterize import Backend
from alpasim_plugin.gaussians.scene.builder import build_scene, with_background
from alpasim_plugin.gaussians.scene.degrade import GHOST, Surrogate, log_actors, log_times
from alpasim_plugin.gaussians.scene.log_views import LogView, SkyMask
from alpasim_plugin.gaussians.scene.scene_graph import SceneGraph, SceneNode
from alpasim_plugin.renderers.background import read_background
from alpasim_plugin.renderers.recorded import built_recording
from alpasim_plugin.renderers.rolling import draw_request
from alpasim_plugin.world.ground import height_at

CACHED_SCENES = 4
LOG_VIEW_WIDTH = 160
LOG_VIEW_SPACING_M = 2.5
LOG_VIEWS = 60
SOFT_CELL_PX = 4.5  # a bad reconstruction has fewer, larger Gaussians

T = TypeVar("T")
_cache: OrderedDict[str, object] = OrderedDict()


class CleanRenderer(Renderer):
    """Render the scene as built.

    Attributes:
        stats: Counts of the last frame: ``visible`` Gaussians, ``nodes`` drawn and ``nodes_total``.

    Raises:
        InputError: Nothing was built: the scenario is an imported drive.
    """

    def __init__(self, scenario: Scenario, seed: int, device: str, threads: int | None) -> None:
        if scenario.model is not None:
            raise InputError(
                f"{scenario.scene_id}: a recorded drive: nothing was built, so there is no built truth to show",
                "use 3dgs; photographs are the truth of a recorded drive (simrun bench real)",
            )
        self.scenario, self.seed, self.threads = scenario, seed, threads
        self.backend = backend_of(device)
        self.scene = scene_of(scenario)
        self.stats: Mapping[str, int] = {}

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame."""
        complete = self.scenario.background is None

        def draw(camera: PinholeCamera, actors: Mapping[str, F64]) -> RasterOutput:
            return self.scene.render(
                camera, actors, self.threads, self.backend, sky_in_alpha=complete
            )

        return self._frame(request, draw_request(request, draw, self.backend))

    def _frame(self, request: RenderRequest, out: RasterOutput) -> Frame:
        self.stats = out.stats
        return Frame(
            request.t_us, request.camera.name, out.to_uint8(), out.alpha, out.surface_depth()
        )


class SurrogateRenderer(CleanRenderer):
    """Render the scene as a bad reconstruction of the logged drive would show it."""

    def __init__(self, scenario: Scenario, seed: int, device: str, threads: int | None) -> None:
        super().__init__(scenario, seed, device, threads)
        self.surrogate, self.sky, self.ghosts, self._graphs = reconstruction_of(
            scenario, self.scene
        )

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame; how bad it is follows the rig's lateral distance from the logged
        path.
        """
        w = self.surrogate.weight(request.T_world_camera[1] @ inverse(request.camera.T_rig_camera))
        graph = self._graph(w)
        gain = self.surrogate.gain(request.t_us, self.seed, w)

        def draw(camera: PinholeCamera, actors: Mapping[str, F64]) -> RasterOutput:
            poses: dict[str, F64] = {}
            for actor_id, pose in actors.items():
                poses[actor_id] = self.surrogate.pose(actor_id, pose, request.t_us, self.seed, w)
                if actor_id + GHOST in graph.actors:
                    poses[actor_id + GHOST] = self.surrogate.ghost_pose(
                        actor_id, pose, request.t_us, self.seed, w
                    )
            out = graph.render(camera, poses, self.threads, self.backend)
            return replace(
                out,
                rgb=np.clip(out.rgb * gain, 0.0, 1.0),
                alpha=np.maximum(out.alpha, self.sky.share(camera)),
            )

        return self._frame(request, draw_request(request, draw, self.backend))

    def recorded(self) -> Sequence[RecordedFrame]:
        """Return the scene as built, as its cameras saw it along the log; depth is the built
        scene's too.
        """
        return built_recording(self.scenario, self.scene, self.scene.render, None)

    def _graph(self, w: float) -> SceneGraph:
        if w not in self._graphs:
            self._graphs[w] = self.scene.changed(
                partial(self._change, w), self.ghosts, SOFT_CELL_PX
            )
        return self._graphs[w]

    # A bound method of the first renderer stays in the shared graphs; it uses only the surrogate,
    # which is shared as well.
    def _change(self, w: float, node: SceneNode, level: int) -> GaussianCloud:
        change = self.surrogate.actor if node.kind == "actor" else self.surrogate.background
        return change(node, level, node.levels[level].cloud, w)


def backend_of(device: str) -> Backend:
    """Return the rasteriser that serves a device.

    Raises:
        InputError: Neither ``cpu`` nor ``cuda``.
    """
    if device not in ("cpu", "cuda"):
        raise InputError(f"device {device!r}: no such device", "use cpu or cuda")
    return "cpu" if device == "cpu" else "gsplat"


def scene_of(scenario: Scenario) -> SceneGraph:
    """Return the scenario's scene, built once per process."""
    return in_memory(f"scene:{scene_key(scenario)}", partial(_build, scenario))


def reconstruction_of(
    scenario: Scenario, scene: SceneGraph
) -> tuple[Surrogate, SkyMask, list[SceneNode], dict[float, SceneGraph]]:
    """Return the surrogate, its sky, the ghosts of moving actors, and graphs by weight as they are
    made, shared by a process.
    """
    key = f"surrogate:{scene_key(scenario)}:{scenario.degradation!r}"
    moving = [a.actor_id for a in scenario.actors if not a.is_static]
    ghosts = [SceneNode(i + GHOST, "actor", scene.actors[i].levels[1:]) for i in moving]

    def make() -> tuple[Surrogate, SkyMask, list[SceneNode], dict[float, SceneGraph]]:
        views = log_views(scenario, scene)
        return Surrogate(scenario, views), SkyMask(views), ghosts, {}

    return in_memory(key, make)


def log_views(scenario: Scenario, scene: SceneGraph) -> list[LogView]:
    """Render small depth images from the scenario's cameras along the log: what a reconstruction
    could have learned from.
    """
    cameras = scenario.cameras
    times = log_times(scenario, LOG_VIEW_SPACING_M, max(1, LOG_VIEWS // max(1, len(cameras))))
    views = []
    for t_us in times:
        T_world_rig = interpolate(scenario.ego_log, t_us)
        for spec in cameras:
            camera = scaled_camera(spec, T_world_rig @ spec.T_rig_camera, LOG_VIEW_WIDTH)
            out = scene.render(camera, log_actors(scenario, t_us))
            views.append(LogView(camera, out.depth, out.alpha))
    return views


def scene_key(scenario: Scenario) -> str:
    """Return what a scene's look depends on, as a digest: the source's content, the seed and what
    is built.
    """
    digest = hashlib.blake2b(digest_size=16)
    for part in (
        scenario.scene_id,
        scenario.seed,
        scenario.content_hash,
        scenario.environment,
        scenario.background,
        scenario.vehicle.box,
    ):
        digest.update(repr(part).encode())
    digest.update(
        repr(
            [
                (c.name, c.width, c.height, c.K.tolist(), c.T_rig_camera.tolist())
                for c in scenario.cameras
            ]
        ).encode()
    )
    digest.update(scenario.ego_log.xyz.tobytes())
    for actor in scenario.actors:
        digest.update(
            f"{actor.actor_id}{actor.label}{actor.box}{actor.is_static}".encode()
            + actor.track.xyz.tobytes()
        )
    if not scenario.content_hash:
        for lane in scenario.lane_map.lanes.values():
            digest.update(lane.lane_id.encode() + lane.centre.tobytes())
    return digest.hexdigest()


def clear_cache(kind: str = "") -> None:
    """Forget what was built, or what is kept under keys that begin with ``kind``."""
    for key in [key for key in _cache if key.startswith(kind)]:
        del _cache[key]


def _build(scenario: Scenario) -> SceneGraph:
    graph = build_scene(scenario, partial(height_at, scenario.ground))
    if scenario.background is None:
        return graph
    cloud, _ = read_background(scenario.background, scenario.ego_log.xyz)
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
