"""Images of a built scene as what counts as true: those of `clean`, along the recorded path and beside
it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from alpasim_plugin.core.geometry import interpolate
from alpasim_plugin.core.types import U8, CameraSpec, RenderRequest, Scenario
from alpasim_plugin.gaussians.scene.log_views import log_actors
from alpasim_plugin.lab.bench.open_loop import TrueImage


def offset_requests(scenario: Scenario, camera: CameraSpec, offset_m: float) -> list[RenderRequest]:
    """Return the requests of a camera at its rate, of an ego that drives as recorded and ``offset_m`` to
    the left of it. A rolling shutter stands still.
    """
    period_us = camera.interval_us or scenario.rates.camera_us
    shift = np.eye(4)
    shift[1, 3] = offset_m
    requests = []
    for t_us in range(scenario.start_us, scenario.recorded_until_us + 1, period_us):
        T = interpolate(scenario.ego_log, t_us) @ shift @ camera.T_rig_camera
        requests.append(RenderRequest(t_us, camera, np.stack([T, T]), log_actors(scenario, t_us)))
    return requests


def drawn_series(
    requests: Mapping[str, Sequence[RenderRequest]],
    images: Mapping[str, Sequence[U8]],
    offset_m: float,
) -> dict[str, list[TrueImage]]:
    """Return what `clean` shows for requests of `offset_requests`, by camera, as true images."""
    return {
        name: [
            TrueImage(
                request.t_us,
                "drawn",
                request.T_world_camera[1],
                request.camera.K,
                rgb,
                abs(offset_m),
            )
            for request, rgb in zip(camera_requests, images[name], strict=True)
        ]
        for name, camera_requests in requests.items()
    }
