"""Recognise a frame that lacks the street: the road below the drive's path is always built, so where
it projects into a view there is a surface, the road or what hides it.
"""

import numpy as np

from alpasim_plugin.core.errors import RendererError
from alpasim_plugin.core.types import F32, I64, Frame, RenderRequest, Scenario
from alpasim_plugin.gaussians.lens_camera import lens_rays
from alpasim_plugin.renderers.view import depths_of, shown_at
from alpasim_plugin.streets.site import path_of
from alpasim_plugin.world.ground import height_at

# Depths: nearer is the ego's own place, farther is thinner than a pixel.
NEAREST_M = 3.0
FARTHEST_M = 40.0
# So many points judge a view, the nearest, which a road user ahead does not hide; this share of them
# must show a surface.
JUDGES = 8
LEAST_SHARE = 0.25
ABOVE_M = 0.3  # of a camera over the road: from below, or in it, nothing of it is seen


class BuiltRoad:
    """Points of the road that is built below a scenario's path, a metre apart."""

    def __init__(self, scenario: Scenario) -> None:
        self.ground = scenario.ground
        self.points = path_of(scenario).copy()
        self.points[:, 2] = height_at(scenario.ground, self.points)

    def check(self, request: RenderRequest, frame: Frame) -> None:
        """Refuse a frame without surfaces where the road is in view.

        Args:
            request: Of any camera.
            frame: What was rendered; its depth is 0 where it shows no surface.

        Raises:
            RendererError: The road projects into the view, and the frame shows no surface there.
        """
        pixels = self._in_view(request)[:JUDGES]
        depth = frame.depth
        if len(pixels) < JUDGES or depth is None:
            return
        share = float((depth[pixels[:, 1], pixels[:, 0]] > 0).mean())
        if share < LEAST_SHARE:
            raise RendererError(
                f"camera {request.camera.name!r} at {request.t_us} us: the built road lies in the view, and the frame shows a surface at {100 * share:.0f} % of its {JUDGES} nearest points",
                "this is a fault of the renderer: report it with the scenario",
            )

    def _in_view(self, request: RenderRequest) -> I64:
        """Return the pixels ``(N, 2)``, column and row, of the points that a camera looks at, the
        nearest first.
        """
        camera = request.camera
        T_world_camera = request.T_world_camera[1]
        place = T_world_camera[:3, 3]
        if place[2] < height_at(self.ground, place[None])[0] + ABOVE_M:
            return np.zeros((0, 2), dtype=np.int64)
        local = (self.points - place) @ T_world_camera[:3, :3]
        depths = depths_of(camera, local)
        pixels, can_be_seen = shown_at(camera, local)
        is_near = can_be_seen & (depths > NEAREST_M) & (depths < FARTHEST_M)
        order = np.argsort(depths[is_near], kind="stable")
        places = np.floor(pixels[is_near][order]).astype(np.int64)
        is_inside = ((places >= 0) & (places < [camera.width, camera.height])).all(axis=1)
        pixels_in_view: I64 = places[is_inside]
        if camera.lens is not None:
            sees = lens_rays(camera).visible.reshape(camera.height, camera.width)
            pixels_in_view = pixels_in_view[sees[pixels_in_view[:, 1], pixels_in_view[:, 0]]]
        if request.exposure is not None:
            share: F32 = np.broadcast_to(request.exposure.share, (camera.height, camera.width))
            # What nobody looks at is not rendered.
            pixels_in_view = pixels_in_view[
                np.isfinite(share[pixels_in_view[:, 1], pixels_in_view[:, 0]])
            ]
        return pixels_in_view
