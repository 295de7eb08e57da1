"""Photographs of a drawn street whose depth, poses and exposure are known."""

from dataclasses import replace

import cv2
import numpy as np

from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.fit.views import PosedView
from tests.drives.street import CAMERA_M, HEIGHT, STEP_M, WALL_M, WIDTH, K, Street

STREET = Street(bow_m=0.0)


def street_views(count=10):
    """Return photographs every 0.6 m along the street, the world's z up, named ``front-000000`` and
    on.
    """
    views = []
    for i in range(count):
        T = STREET.pose(STEP_M * i, 0.0)
        rgb = np.ascontiguousarray(STREET.photograph(T)[..., ::-1])
        views.append(PosedView(PinholeCamera.from_pose(WIDTH, HEIGHT, K, T), rgb, f"front-{i:06d}"))
    return views


def true_depth(view):
    """Return ``(H, W)`` metres of the road and the walls, which hide nothing of each other;
    infinite for sky. The box is left out.
    """
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    ray = (
        np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=2)
        @ view.camera.T_camera_world[:3, :3]
    )
    eye = view.camera.centre_world
    with np.errstate(divide="ignore"):
        road = np.where(ray[..., 2] < 0, -CAMERA_M / ray[..., 2], np.inf)
        wall = np.where(
            ray[..., 1] > 0, (WALL_M - eye[1]) / ray[..., 1], (-WALL_M - eye[1]) / ray[..., 1]
        )
    wall = np.where(eye[2] + wall * ray[..., 2] < 6.0, wall, np.inf)
    return np.minimum(road, np.abs(wall))


def turned(view, turn_rad, shift_m):
    """Return a view whose pose is wrong by a rotation vector and a shift, both in its own frame."""
    wrong = np.eye(4)
    wrong[:3, :3], wrong[:3, 3] = cv2.Rodrigues(turn_rad)[0], shift_m
    return replace(
        view, camera=replace(view.camera, T_camera_world=wrong @ view.camera.T_camera_world)
    )


def brightened(view, gain):
    """Return a view as a camera of another exposure takes it."""
    return replace(view, rgb=np.rint(view.rgb * np.array(gain)).clip(0, 255).astype(np.uint8))
