"""What the log's cameras saw: who was there, and where there was sky.

A transparent pixel of a reconstruction is open sky or a hole; alpha alone cannot tell them apart.
Pipelines on recorded drives fill the sky from segmented log images (OneFixer, App. A). Here the log
views' own alpha is that segmentation. The sky is far away, so a view of it is carried to another
camera by rotation alone; within half the views' spacing the skyline moves by less than a pixel of
the small views beyond some 20 m.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from alpasim_plugin.core.geometry import interpolate, intrinsics, inverse
from alpasim_plugin.core.types import F32, F64, Actor, Scenario
from alpasim_plugin.gaussians.camera import PinholeCamera


def log_actors(scenario: Scenario, t_us: int) -> dict[str, F64]:
    """Return the recorded poses of the scenario's actors present at a time."""
    return actors_at(scenario.actors, t_us)


def actors_at(actors: Iterable[Actor], t_us: int) -> dict[str, F64]:
    """Return the poses ``(4, 4)`` of the actors present at a time, by id."""
    return {
        a.actor_id: interpolate(a.track, t_us)
        for a in actors
        if a.track.t_us[0] <= t_us <= a.track.t_us[-1]
    }


@dataclass(frozen=True, eq=False)
class SkyView:
    """Where one logged camera saw sky: ``sky (H, W)`` float32, 1 where it did."""

    camera: PinholeCamera
    sky: F32


class SkyMask:
    """Sky mask from the nearest log view of a similar direction.

    Args:
        views: Of cameras that may look in different directions; without any, nothing is sky.
    """

    def __init__(self, views: Sequence[SkyView]) -> None:
        self._views = tuple(views)
        T = np.array([inverse(view.camera.T_camera_world) for view in views]).reshape(-1, 4, 4)
        self._axes, self._eyes = T[:, :3, 2], T[:, :3, 3]  # (V, 3) world

    def share(self, camera: PinholeCamera) -> F32:
        """Return how much of every pixel ``(H, W)`` is sky, 0 to 1; beyond the view's border its
        outermost pixels go on.
        """
        if not self._views:
            return np.zeros((camera.height, camera.width), np.float32)
        T = inverse(camera.T_camera_world)
        R = T[:3, :3]
        eye = T[:3, 3]
        turned_away = self._axes @ R[:, 2] < 0.5
        nearest = int(np.argmin(np.linalg.norm(self._eyes - eye, axis=1) + 1e6 * turned_away))
        view = self._views[nearest]
        # The warp counts from pixel centres, cameras from the corner.
        half = intrinsics(1.0, 1.0, 0.5, 0.5)
        to_view = (
            np.linalg.inv(half)
            @ view.camera.K
            @ view.camera.T_camera_world[:3, :3]
            @ R
            @ np.linalg.inv(camera.K)
            @ half
        )
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpPerspective(
            view.sky,
            to_view,
            (camera.width, camera.height),
            flags=flags,
            borderMode=cv2.BORDER_REPLICATE,
        )
