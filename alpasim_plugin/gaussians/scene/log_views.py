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

from alpasim_plugin.core.geometry import interpolate, intrinsics
from alpasim_plugin.core.types import F32, F64, Actor, Bool, Scenario
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.lens_camera import LensCamera


def log_actors(scenario: Scenario, t_us: int) -> dict[str, F64]:
    """Return the recorded poses of the scenario's actors present at a time."""
    return actors_at(scenario.actors, t_us)


def actors_at(actors: Iterable[Actor], t_us: int) -> dict[str, F64]:
    """Return the poses ``(4, 4)`` of the actors present at a time, by id."""
    return {
        actor.actor_id: interpolate(actor.track, t_us)
        for actor in actors
        if actor.track.t_us[0] <= t_us <= actor.track.t_us[-1]
    }


@dataclass(frozen=True, eq=False)
class SkyView:
    """Where one logged camera saw sky: ``sky (H, W)`` float32, 1 where it did; and its name."""

    camera: PinholeCamera
    sky: F32
    name: str = ""


# Of a view that others are asked to complete: the share of the image that it must show. How many
# views answer, and how many directions along each side of the image say what a view shows.
LEAST_COVER = 0.5
MOST_VIEWS = 8
DIRECTIONS = 9


class SkyMask:
    """Sky mask from what the log's views saw of the directions of a camera.

    The nearest view of the same camera comes first, then those of others; a view answers for the
    directions that it saw, and the next that saw any of what is left for those. A direction that
    none saw is no sky.

    Args:
        views: Of cameras that may look in different directions; without any, nothing is sky.
    """

    def __init__(self, views: Sequence[SkyView]) -> None:
        self._views = tuple(views)
        T = np.array([view.camera.T_camera_world for view in views]).reshape(-1, 4, 4)
        self._R = T[:, :3, :3]  # (V, 3, 3) world to view
        self._eyes = -np.einsum("vji,vj->vi", self._R, T[:, :3, 3])  # (V, 3) world
        self._K = np.array([view.camera.K for view in views]).reshape(-1, 3, 3)
        sizes = [[view.camera.width, view.camera.height] for view in views]
        self._sizes = np.array(sizes, dtype=np.float64).reshape(-1, 2)
        self._names = np.array([view.name for view in views])

    def share(self, camera: PinholeCamera | LensCamera, name: str = "") -> F32:
        """Return how much of every pixel ``(H, W)`` is sky, 0 to 1.

        Args:
            camera: From where.
            name: Of the camera among those of the views; without it all count alike.
        """
        share = np.zeros((camera.height, camera.width), dtype=np.float32)
        is_open = np.ones(share.shape, dtype=np.bool_)
        for i in self._in_order(camera, name)[:MOST_VIEWS]:
            sky, is_seen = _carried(self._views[i], camera)
            np.copyto(share, sky, where=is_open & is_seen)
            is_open &= ~is_seen
            if not is_open.any():
                break
        return share

    def _in_order(self, camera: PinholeCamera | LensCamera, name: str) -> list[int]:
        """Return the numbers of the views that show any of an image, the first to be asked first:
        those that show directions which the ones before them do not, then the others.

        Both are in one order: views that show enough of the image, of its own camera and near; then
        those that show more. Without the first rule the own camera's many views of the same
        directions would leave no room for the one camera that saw the rest.
        """
        shows = self._shown_directions(camera)
        cover = shows.mean(axis=1)
        away_m = np.linalg.norm(self._eyes - camera.centre_world, axis=1)
        is_other = (
            self._names != name if name in self._names else np.zeros(len(cover), dtype=np.bool_)
        )
        lacking = np.where(cover < LEAST_COVER, 1 - cover, 0.0)
        order = [int(i) for i in np.lexsort((away_m, is_other, lacking)) if cover[i] > 0]
        is_open = np.ones(shows.shape[1], dtype=np.bool_)
        completing = []
        for i in order:
            if (shows[i] & is_open).any():
                completing.append(i)
                is_open &= ~shows[i]
        return [*completing, *(i for i in order if i not in completing)]

    def _shown_directions(self, camera: PinholeCamera | LensCamera) -> Bool:
        """Return which of an image's directions lie in each view, ``(V, N)``."""
        if isinstance(camera, LensCamera):
            directions = camera.rays()[camera.visible]
            stride = max(1, len(directions) // DIRECTIONS**2)
            rays = camera.T_camera_world[:3, :3].T @ directions[::stride].T
        else:
            x, y = np.meshgrid(
                np.linspace(0, camera.width, DIRECTIONS), np.linspace(0, camera.height, DIRECTIONS)
            )
            pixels = np.stack([x.ravel(), y.ravel(), np.ones(x.size)])  # (3, N)
            rays = camera.T_camera_world[:3, :3].T @ np.linalg.inv(camera.K) @ pixels
        projected = self._K @ (self._R @ rays)  # (V, 3, N)
        depth = projected[:, 2]
        places = projected[:, :2] / np.where(depth > 0, depth, 1.0)[:, None]
        # A camera turned by rounding alone sees its own border.
        inside = (places > -1e-6) & (places < self._sizes[..., None] + 1e-6)
        return np.asarray(inside.all(axis=1) & (depth > 0), dtype=np.bool_)


def _carried(view: SkyView, camera: PinholeCamera | LensCamera) -> tuple[F32, Bool]:
    """Return where a view's sky lies in another camera's image ``(H, W)``, and which of its pixels
    the view saw.
    """
    if isinstance(camera, LensCamera):
        return _carried_into_lens(view, camera)
    # The warp counts from pixel centres, cameras from the corner.
    half = intrinsics(1.0, 1.0, 0.5, 0.5)
    to_view = (
        np.linalg.inv(half)
        @ view.camera.K
        @ view.camera.T_camera_world[:3, :3]
        @ camera.T_camera_world[:3, :3].T
        @ np.linalg.inv(camera.K)
        @ half
    )
    size = (camera.width, camera.height)
    interpolated = cv2.warpPerspective(
        view.sky,
        to_view,
        size,
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    inside = cv2.warpPerspective(
        np.ones(view.sky.shape, dtype=np.uint8),
        to_view,
        size,
        flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
    )
    is_seen: Bool = inside.view(np.bool_)
    # What lies behind the view is not seen; depth is linear, so corners tell whether any does.
    columns = np.arange(camera.width)
    rows = np.arange(camera.height)[:, None]
    corners = to_view[2, 0] * columns[[0, -1]] + to_view[2, 1] * rows[[0, -1]] + to_view[2, 2]
    if corners.min() <= 0:
        is_seen &= to_view[2, 0] * columns + to_view[2, 1] * rows + to_view[2, 2] > 0
    return interpolated, is_seen


def _carried_into_lens(view: SkyView, camera: LensCamera) -> tuple[F32, Bool]:
    """Return what `_carried` does of a camera with a lens."""
    to_view = view.camera.T_camera_world[:3, :3] @ camera.T_camera_world[:3, :3].T
    projected = (camera.rays() @ (view.camera.K @ to_view).T).astype(np.float32)
    depth = projected[..., 2]
    is_ahead = depth > 0
    ahead = np.where(is_ahead, depth, np.float32(1))
    x, y = (projected[..., axis] / ahead - np.float32(0.5) for axis in range(2))
    size = view.camera.width, view.camera.height
    is_seen = is_ahead & camera.visible
    for place, count in zip((x, y), size, strict=True):
        is_seen &= (place > -0.5) & (place < count - 0.5)
    x, y = (np.where(is_seen, place, np.float32(0)) for place in (x, y))
    sky = cv2.remap(view.sky, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return sky, is_seen
