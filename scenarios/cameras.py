"""Cameras of a scenario file."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.types import F64, CameraSpec
from scenarios.schema import CameraModel

# Columns: camera x (right), y (down), z (forward) seen in the rig's axes (x forward, y left, z up).
_RIG_FROM_FORWARD_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def camera_spec(model: CameraModel | None = None) -> CameraSpec:
    """Return the camera of a section; None gives the default front camera."""
    m = model or CameraModel()
    focal = 0.5 * m.width / np.tan(np.deg2rad(m.hfov_deg) / 2)
    K = np.array([[focal, 0.0, m.width / 2], [0.0, focal, m.height / 2], [0.0, 0.0, 1.0]])
    T = np.eye(4)
    T[:3, :3] = _rotation(np.deg2rad(m.yaw_deg), np.deg2rad(m.pitch_down_deg)) @ _RIG_FROM_FORWARD_CAMERA
    T[:3, 3] = m.x_m, m.y_m, m.z_m
    return CameraSpec(m.name, m.width, m.height, K, T, m.shutter_us)


def _rotation(yaw: float, pitch_down: float) -> F64:
    """Return Rz(yaw) Ry(pitch): positive pitch about y (left) turns x (forward) down."""
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch_down), np.sin(pitch_down)
    about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    return np.asarray(about_z @ about_y)
