"""Draw a frame of a rolling shutter: each of its bands from the pose, and with the road users, of
the band's instant.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from alpasim_plugin.core.shutter import bands
from alpasim_plugin.core.types import F64, RenderRequest
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.raster.output import RasterOutput

Draw = Callable[[PinholeCamera, Mapping[str, F64]], RasterOutput]


def draw_request(request: RenderRequest, draw: Draw) -> RasterOutput:
    """Draw a request's frame; with an exposure in `bands`, otherwise at the shutter's end.

    Args:
        request: What to draw.
        draw: Draws a camera's image with the road users at their boxes.

    Returns:
        The picture; a pixel that nobody looks at is black and opaque. Depth is along the axis of
        the pose at the pixel's time. ``stats`` are the largest of any band.
    """
    spec = request.camera
    if request.exposure is None:
        return draw(camera_at(request, request.T_world_camera[1]), request.actors)
    shape = (spec.height, spec.width)
    out = RasterOutput(
        np.zeros((*shape, 3), np.float32), np.ones(shape, np.float32), np.zeros(shape, np.float32)
    )
    stats: dict[str, int] = {}
    for band in bands(request):
        camera = camera_at(request, band.T_world_camera)
        part = draw(camera.window(band.rows, band.columns), band.actors)
        for whole, drawn in ((out.rgb, part.rgb), (out.alpha, part.alpha), (out.depth, part.depth)):
            band.put(whole, drawn)
        stats = {name: max(count, stats.get(name, 0)) for name, count in part.stats.items()}
    return RasterOutput(out.rgb, out.alpha, out.depth, stats)


def camera_at(request: RenderRequest, T_world_camera: F64) -> PinholeCamera:
    """Return the request's camera at a pose."""
    spec = request.camera
    return PinholeCamera.from_pose(spec.width, spec.height, spec.K, T_world_camera)
