"""The state of road users at one instant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alpasim_plugin.core.types import F64, Box, Trajectory
from alpasim_plugin.world.idm import Bodies

NO_BODIES = Bodies(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0), np.zeros((0, 2)))


def bodies_from(xy: F64, yaw: F64, boxes: Sequence[Box], velocity: F64) -> Bodies:
    """Build `Bodies` from centres ``(M, 2)``, headings ``(M,)``, boxes and velocities ``(M, 2)``."""
    half = np.array([[b.length_m / 2, b.width_m / 2] for b in boxes]).reshape(-1, 2)
    return Bodies(np.asarray(xy).reshape(-1, 2), np.asarray(yaw).reshape(-1), half[:, 0], half[:, 1], np.asarray(velocity).reshape(-1, 2))


def concatenate(parts: Sequence[Bodies]) -> Bodies:
    """Stack several groups of bodies."""
    if not parts:
        return NO_BODIES
    return Bodies(
        np.concatenate([p.xy for p in parts]),
        np.concatenate([p.yaw for p in parts]),
        np.concatenate([p.half_length_m for p in parts]),
        np.concatenate([p.half_width_m for p in parts]),
        np.concatenate([p.velocity for p in parts]),
    )


def speeds(track: Trajectory) -> F64:
    """Return the speed in the plane ``(T,)`` at every pose of a track, by central differences; one pose: 0."""
    if len(track) < 2:
        return np.zeros(len(track))
    t_s = (track.t_us - track.t_us[0]).astype(np.float64) * 1e-6
    v = np.gradient(track.xyz[:, :2], t_s, axis=0)
    return np.asarray(np.hypot(v[:, 0], v[:, 1]))
