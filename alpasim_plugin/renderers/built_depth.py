"""How far away the surfaces of a built scene are, whatever renderer shows it.

A reconstruction's depth is as blurred as its images: it lays fog before lamps and walls into the
ground. Lamps, snow and air are of the scene, so they are placed by the scene itself.
"""

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from alpasim_plugin.core.types import F32, CameraSpec, RecordedFrame, RenderRequest, Scenario
from alpasim_plugin.gaussians.raster.output import RasterOutput
from alpasim_plugin.gaussians.scene.scene_graph import SceneGraph, SceneView, posed
from alpasim_plugin.renderers.gaussian import scene_of
from alpasim_plugin.renderers.rolling import draw_requests


class BuiltDepth:
    """The depth of a scene as built; nothing is drawn before a depth is read.

    Args:
        scenario: A built scene.
        device: Where it is drawn.
        threads: Of the CPU rasteriser; None leaves their number.
    """

    def __init__(self, scenario: Scenario, device: str, threads: int | None) -> None:
        self.scenario, self.device, self.threads = scenario, device, threads

    def of_request(self, request: RenderRequest) -> F32:
        """Return the depth ``(H, W)`` of a requested frame, metres along the optical axis, through
        a lens from the camera's centre, at the time of each pixel; 0 where the scene shows no surface.
        """
        return draw_requests([request], self._draw)[0].on_host().depth

    def of_recorded(self, frame: RecordedFrame, height: int, width: int) -> F32:
        """Return the depth ``(H, W)`` at the pose of a recorded frame, as `of_request`."""
        spec = CameraSpec(frame.camera, width, height, frame.K, np.eye(4), lens=frame.lens)
        camera = posed(spec, frame.T_world_camera)
        return self._draw([(camera, frame.actors)])[0].on_host().depth

    def _draw(self, views: Sequence[SceneView]) -> list[RasterOutput]:
        """Draw the views' surfaces."""
        outs = self._scene.render_all(views, self.threads, self.device)
        return [out.surface() for out in outs]

    @cached_property
    def _scene(self) -> SceneGraph:
        """Kept, because a scene is known by its whole content, which takes as long as a drawing."""
        return scene_of(self.scenario)
