"""The motion of a camera in a hand: a smooth way, the steps of whoever walks, and the unrest of the
hand, in six degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import scipy

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64

TREMOR_HZ, SLOW_HZ = (1.5, 4.0), (0.15, 0.8)
WAVES = 5  # sines of an unrest


@dataclass(frozen=True)
class Hand:
    """Amounts; each is the standard deviation of an unrest, or the amplitude of a step.

    Attributes:
        sway_m: Sideways, once every two steps.
        bob_m: Up and down, with every step.
        drift_m: Slow wandering of the eye along each axis.
        turn_deg: Slow unrest of yaw, pitch and roll.
        tremor_deg: The same, fast.
        steps_hz: Steps a second; 0 stands still.
    """

    sway_m: float = 0.02
    bob_m: float = 0.015
    drift_m: float = 0.04
    turn_deg: tuple[float, float, float] = (1.6, 1.2, 1.0)
    tremor_deg: tuple[float, float, float] = (0.12, 0.15, 0.10)
    steps_hz: float = 1.8


def hand_held(
    eye: F64, target: F64, t_s: F64, hand: Hand, scene_id: str, seed: int, take: str
) -> F64:
    """Return camera poses ``T_world_camera (T, 4, 4)``, OpenCV axes, z up in the world.

    Args:
        eye, target: ``(K, 3)`` where the camera is and what it looks at, evenly spaced over
            ``t_s``; splines join them.
        t_s: ``(T,)`` seconds, from the first to the last of the points.
        hand: Amounts.
        scene_id, seed: Key of the random streams.
        take: Which of several takes along the same way; each has its own unrest.
    """
    rng = stream(scene_id, seed, f"hand-held.{take}")
    knots = np.linspace(t_s[0], t_s[-1], len(eye))
    at, to = (scipy.interpolate.CubicSpline(knots, points)(t_s) for points in (eye, target))
    phase = rng.uniform(0, 2 * np.pi)
    drift = np.stack([_unrest(rng, t_s, SLOW_HZ) for _ in range(3)], axis=1)
    turns = np.stack(
        [
            a * _unrest(rng, t_s, SLOW_HZ) + b * _unrest(rng, t_s, TREMOR_HZ)
            for a, b in zip(hand.turn_deg, hand.tremor_deg, strict=True)
        ],
        axis=1,
    )
    forward = (to - at) / np.linalg.norm(to - at, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    step = 2 * np.pi * hand.steps_hz * t_s + phase
    at = at + hand.drift_m * drift + hand.sway_m * np.sin(step / 2)[:, None] * right
    at[:, 2] += hand.bob_m * np.sin(step)
    out = np.tile(np.eye(4), (len(t_s), 1, 1))
    for i, (x, z) in enumerate(zip(right, forward, strict=True)):
        yaw, pitch, roll = np.radians(turns[i])
        shaken = cv2.Rodrigues(np.array([pitch, yaw, roll]))[
            0
        ]  # about the camera's x (right), y (down) and z (forward)
        out[i, :3, :3] = np.stack([x, np.cross(z, x), z], axis=1) @ shaken
        out[i, :3, 3] = at[i]
    return out


def _unrest(rng: np.random.Generator, t_s: F64, band_hz: tuple[float, float]) -> F64:
    """Return ``(T,)`` numbers of unit spread: sines of random frequency and phase within a band."""
    frequency, phase = rng.uniform(*band_hz, WAVES), rng.uniform(0, 2 * np.pi, WAVES)
    return np.asarray(
        np.sqrt(2.0 / WAVES) * np.sin(2 * np.pi * frequency * t_s[:, None] + phase).sum(axis=1)
    )
