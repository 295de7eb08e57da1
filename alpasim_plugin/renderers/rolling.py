"""Draw a frame of a rolling shutter: each of its bands from the pose, and with the road users, of
the band's instant.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

from alpasim_plugin.core.devices import implementation
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.shutter import at_share, bands, motion_px
from alpasim_plugin.core.types import F64, Frame, RenderRequest
from alpasim_plugin.gaussians.camera import PinholeCamera, Rolling
from alpasim_plugin.gaussians.raster.output import RasterOutput

NEARER = 4.0  # what is so many times nearer than `shutter.NEAR_M` is still looked for in full
Draw = Callable[[PinholeCamera, Mapping[str, F64]], RasterOutput]


def draw_frame(request: RenderRequest, draw: Draw, device: str) -> Frame:
    """Return the frame of a request; see `draw_request`. What a device drew stays there."""
    return draw_request(request, draw, device).frame(request.t_us, request.camera.name)


def draw_request(request: RenderRequest, draw: Draw, device: str) -> RasterOutput:
    """Draw a request's frame; without an exposure at the shutter's end.

    Where whole rows or columns are exposed at once, the CPU rasteriser draws each Gaussian at the
    time of its pixel. Otherwise the frame is drawn in `bands`, which are joined where they were
    drawn.

    Args:
        request: What to draw.
        draw: Draws a camera's image with the road users at their boxes.
        device: That of ``draw``.

    Returns:
        The image; a pixel that nobody looks at is black and opaque. Depth is along the axis of
        the pose at the pixel's time.
    """
    spec = request.camera
    if request.exposure is None:
        return draw(camera_at(request, request.T_world_camera[1]), request.actors)
    if implementation(device, 1 in request.exposure.share.shape, False):
        return draw(*_rolling(request))
    exposed = bands(request)
    parts = [
        draw(camera_at(request, band.T_world_camera).window(band.rows, band.columns), band.actors)
        for band in exposed
    ]
    again = partial(draw_request, request, draw, device)
    out = parts[0].blank(spec.height, spec.width, parts, again)
    for band, part in zip(exposed, parts, strict=True):
        for whole, drawn in ((out.rgb, part.rgb), (out.alpha, part.alpha), (out.depth, part.depth)):
            band.put(whole, drawn)
    return out


def _rolling(request: RenderRequest) -> tuple[PinholeCamera, Mapping[str, F64]]:
    """Return the camera of a shutter that rolls along rows or columns, and the road users, both at
    its middle.
    """
    assert request.exposure is not None, "a frame without exposure is exposed at one instant"
    share = request.exposure.share
    T_world_camera, actors = at_share(request, 0.5)
    camera = camera_at(request, T_world_camera)
    first, last = float(share.flat[0]), float(share.flat[-1])
    step = (last - first) / max(share.size - 1, 1)
    along = (0.0, step) if share.shape[1] == 1 else (step, 0.0)
    reach_px = motion_px(request)
    if reach_px == 0.0:
        return camera, actors
    rolling = Rolling(
        inverse(request.T_world_camera[0]),
        request.exposure.actors_start,
        (*along, first - 0.5 - 0.5 * step),
        NEARER * reach_px + 1.0,
    )
    return replace(camera, rolling=rolling), actors


def camera_at(request: RenderRequest, T_world_camera: F64) -> PinholeCamera:
    """Return the request's camera at a pose."""
    spec = request.camera
    return PinholeCamera.from_pose(spec.width, spec.height, spec.K, T_world_camera)
