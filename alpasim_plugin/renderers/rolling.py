"""Draw the frames of an instant: a lens along each pixel's ray, and a rolling shutter at each pixel's
time. Only the pinholes that cover a lens for a renderer that draws no lenses are drawn in bands, where
they are exposed neither by rows nor by columns.
"""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from alpasim_plugin.cameras.shutter import (
    Band,
    at_share,
    bands,
    largest_motion_px,
    motion_px,
)
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.types import F64, Frame, RenderRequest
from alpasim_plugin.gaussians.camera import PinholeCamera, Rolling
from alpasim_plugin.gaussians.lens_camera import lens_rays
from alpasim_plugin.gaussians.raster.output import RasterOutput
from alpasim_plugin.gaussians.scene.scene_graph import Camera, SceneView, posed

NEARER = 4.0  # what is so many times nearer than `shutter.NEAR_M` is still looked for in full
JUDGED_RAYS = 200  # of a lens, by which the motion in its image is bounded
Draw = Callable[[Sequence[SceneView]], Sequence[RasterOutput]]


class SplatRenderer(Renderer):
    """A renderer of Gaussians: the views of all cameras of an instant are drawn in one call."""

    has_history = False
    draws_lenses = True
    device: str

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame."""
        return self.render_batch([request])[0]

    def render_batch(self, requests: Sequence[RenderRequest]) -> list[Frame]:
        """Render the frames of an instant. What a device drew stays there."""
        outs = draw_requests(requests, self.draw)
        return [
            self.developed(request, out).frame(request.t_us, request.camera.name)
            for request, out in zip(requests, outs, strict=True)
        ]

    @abstractmethod
    def draw(self, views: Sequence[SceneView]) -> list[RasterOutput]:
        """Draw images with the road users at their boxes."""

    def developed(self, request: RenderRequest, out: RasterOutput) -> RasterOutput:
        """Return the image with the exposure of the request's camera."""
        return out


def draw_requests(requests: Sequence[RenderRequest], draw: Draw) -> list[RasterOutput]:
    """Draw the frames of requests; those without an exposure at the shutter's end.

    Where whole rows or columns are exposed at once, the rasteriser draws each Gaussian at the time of
    its pixel. Otherwise a pinhole's frame is drawn in `bands`, which are joined where they were drawn.

    Args:
        requests: What to draw.
        draw: Draws the views of all.

    Returns:
        The images; a pixel that nobody looks at is black and opaque. Depth is along the axis of
        the pose at the pixel's time, through a lens from the camera's centre.
    """
    cuts = [_cut(request) for request in requests]
    frames = iter(draw([view for cut in cuts for _, view in cut]))
    outs = []
    for request, cut in zip(requests, cuts, strict=True):
        out, *_ = parts = [next(frames) for _ in cut]
        again = partial(draw_requests, [request], draw)
        if cut[0][0] is not None:
            out = out.blank(request.camera.height, request.camera.width, parts, again)
        for (band, _), part in zip(cut, parts, strict=True):
            if band is not None:
                band.put(out.rgb, part.rgb)
                band.put(out.alpha, part.alpha)
                band.put(out.depth, part.depth)
        outs.append(out)
    return outs


def _cut(request: RenderRequest) -> list[tuple[Band | None, SceneView]]:
    """Return the bands that are drawn of a request and their views; None: the whole image."""
    if request.exposure is None:
        return [(None, (camera_at(request, request.T_world_camera[1]), request.actors))]
    if 1 in request.exposure.share.shape:
        return [(None, _rolling(request))]
    cut: list[tuple[Band | None, SceneView]] = []
    for band in bands(request):
        camera = camera_at(request, band.T_world_camera)
        assert isinstance(camera, PinholeCamera), "a lens is exposed by rows or columns"
        cut.append((band, (camera.window(band.rows, band.columns), band.actors)))
    return cut


def _rolling(request: RenderRequest) -> SceneView:
    """Return the camera of a shutter that rolls along rows or columns, and the road users, both at
    its middle.
    """
    assert request.exposure is not None, "a frame without exposure is exposed at one instant"
    share = request.exposure.share
    T_world_camera, actors = at_share(request, 0.5)
    camera = camera_at(request, T_world_camera)
    first = float(share.flat[0])
    last = float(share.flat[-1])
    step = (last - first) / max(share.size - 1, 1)
    along = (0.0, step) if share.shape[1] == 1 else (step, 0.0)
    reach_px = _motion_px(request)
    if reach_px == 0.0:
        return camera, actors
    rolling = Rolling(
        inverse(request.T_world_camera[0]),
        request.exposure.actors_start,
        (*along, first - 0.5 - 0.5 * step),
        NEARER * reach_px + 1.0,
    )
    return replace(camera, rolling=rolling), actors


def _motion_px(request: RenderRequest) -> float:
    """Return by how many pixels things in a request's image move at most while its shutter is open."""
    if request.camera.lens is None:
        return motion_px(request)
    rays = lens_rays(request.camera)
    sight = rays.ray[rays.visible]
    return largest_motion_px(request, sight[:: max(1, len(sight) // JUDGED_RAYS)], max(rays.focal))


def camera_at(request: RenderRequest, T_world_camera: F64) -> Camera:
    """Return the request's camera at a pose."""
    return posed(request.camera, T_world_camera)
