"""An image's depth as directions and distances from the camera, and what of it is ground."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from alpasim_plugin.cameras.lens import projected
from alpasim_plugin.core.types import F32, F64, Bool, Box, CameraSpec, HeightField
from alpasim_plugin.gaussians.lens_camera import lens_rays
from alpasim_plugin.world.ground import height_at

# What is less than this above the ground, and so much more with distance, is ground that the model
# shows too near, unless it is about so near to a road user; what is twice as high is none.
GROUND_M = 0.35
GROUND_PER_M = 0.015
BOX_M = 0.2


@dataclass(frozen=True, eq=False)
class View:
    """What a camera sees.

    Attributes:
        camera: Its size and lens.
        T_world_camera: ``(4, 4)`` its pose.
        rays: ``(H, W, 3)`` unit, world.
        depth_m: ``(H, W)`` as `depths_of` counts it; infinite in the sky.
        distance_m: ``(H, W)`` along the rays; infinite in the sky.
        ground: ``(H, W)`` how much a pixel belongs to the ground, 0 to 1.
        points: ``(H, W, 3)`` world, relative to the camera; on the ground where they belong to it, 0
            in the sky.
    """

    camera: CameraSpec
    T_world_camera: F64
    rays: F32
    depth_m: F32
    distance_m: F32
    ground: F32
    points: F32

    @property
    def place(self) -> F64:
        """Return the camera's position ``(3,)``, world."""
        return self.T_world_camera[:3, 3]


def depths_of(camera: CameraSpec, points: F64) -> F64:
    """Return the depths ``(N,)`` of points ``(N, 3)`` in a camera's axes as its images have them: of
    a pinhole along the optical axis, through a lens from its centre.
    """
    return points[:, 2] if camera.lens is None else np.linalg.norm(points, axis=1)


def shown_at(camera: CameraSpec, points: F64) -> tuple[F64, Bool]:
    """Return where a camera shows points ``(N, 3)`` in its axes, inside its image or outside of it:
    pixels ``(N, 2)``, the middle of the first being (0.5, 0.5), and which of them it can show.
    """
    if camera.lens is not None:
        return projected(camera, points)
    is_ahead = points[:, 2] > 0
    uvw = points @ camera.K.T
    return uvw[:, :2] / np.where(is_ahead, uvw[:, 2], 1.0)[:, None], is_ahead


def _rays_of(camera: CameraSpec, shape: tuple[int, int]) -> tuple[F32, F32]:
    """Return each pixel's point at the depth 1 ``(H, W, 3)`` in the camera's axes, and its distance
    ``(H, W)``.
    """
    if camera.lens is not None:
        return lens_rays(camera).ray.reshape(*shape, 3).astype(np.float32), np.ones(
            shape, dtype=np.float32
        )
    K = camera.K
    height, width = shape
    local = np.ones((height, width, 3), dtype=np.float32)
    local[..., 0] = (np.arange(width) + 0.5 - K[0, 2]) / K[0, 0]
    local[..., 1] = ((np.arange(height) + 0.5 - K[1, 2]) / K[1, 1])[:, None]
    return local, np.sqrt(np.einsum("...i,...i->...", local, local))


def view_of(
    depth: F32,
    camera: CameraSpec,
    T_world_camera: F64,
    ground: HeightField,
    boxes: Sequence[tuple[F64, Box]] = (),
) -> View:
    """Return the view of a depth image.

    Args:
        depth: ``(H, W)`` metres, see `depths_of`; 0 where there is no surface. Above the
            horizon that is the sky; below it is a hole of the model, which is as far away as the
            nearest surface in the image.
        camera: Its size and lens.
        T_world_camera: ``(4, 4)`` its pose.
        ground: Heights of the ground.
        boxes: Poses and sizes of road users.
    """
    local, along = _rays_of(camera, (camera.height, camera.width))
    rays = (local / along[..., None]) @ T_world_camera[:3, :3].T.astype(np.float32)
    _, labels = cv2.distanceTransformWithLabels(
        np.uint8(depth == 0), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(labels.max() + 1, dtype=np.float32)
    of_label[labels[depth > 0]] = depth[depth > 0]
    filled = of_label[labels]  # each hole by the nearest pixel that has a surface
    is_sky = (filled == 0) | ((depth == 0) & (rays[..., 2] > 0))
    depth_m = np.where(is_sky, np.float32(np.inf), filled)
    distance_m = depth_m * along
    points = rays * np.where(is_sky, np.float32(0), distance_m)[..., None]
    is_low = ~is_sky & (rays[..., 2] < 0)
    low = points[is_low] + T_world_camera[:3, 3]
    above_m = low[:, 2] - height_at(ground, low)
    limit_m = GROUND_M + GROUND_PER_M * distance_m[is_low]
    share = np.clip(2 - above_m / limit_m, 0, 1)
    for pose, box in boxes:
        reach = BOX_M + np.array(box.size_m) / 2
        share[(np.abs((low - pose[:3, 3]) @ pose[:3, :3]) < reach).all(axis=1)] = 0
    belongs = np.zeros(depth.shape, dtype=np.float32)
    belongs[is_low] = share
    points[is_low, 2] -= share * above_m
    return View(camera, T_world_camera, rays, depth_m, distance_m, belongs, points)
