"""Night, fog and snow by fixed formulas on a clean frame and its depth: targets that cannot drift,
unlike edited videos.

Fog is Koschmieder's law, ``I exp(-b d) + A (1 - exp(-b d))``. Night darkens, shifts to blue and
adds lamps, also the ego's own. Snow whitens surfaces that face up and adds flakes that fall with
time. The same seed gives the same weather for every frame of a scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.block_fixers.settings import CLEAR, STYLES
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F32, F64, U8

VERSION = 1  # of the formulas: targets of another version are made anew
FAR_M = 1000.0  # depth of what has none
FOG_PER_M = (0.03, 0.06)
NIGHT_RGB = np.array([0.62, 0.74, 1.0], dtype=np.float32)
STREET_LIGHTS_M = 80.0  # as far as street lights are drawn
STREET_LIGHT_RGB = np.array([1.0, 0.84, 0.58])
HEADLIGHT_M = 18.0  # reach of the ego's own lamps
FLAKES = 260
BOX_M = np.array([16.0, 9.0, 14.0])  # of flakes around the camera's line of sight: x, y, z


@dataclass(frozen=True)
class SeenFrame:
    """A clean frame with what the formulas need.

    Args:
        rgb: ``(H, W, 3)``.
        depth_m: ``(H, W)`` along the line of sight's axis; 0 or less where there is nothing.
        K: ``(3, 3)`` pixels.
        T_world_camera: ``(4, 4)``.
        t_us: Its time.
        lamps: ``(N, 6)``: x, y, z in the camera's axes, metres, and the lamp's RGB, 0 to 1.
    """

    rgb: U8
    depth_m: F32
    K: F64
    T_world_camera: F64
    t_us: int
    lamps: F64


def restyle(frame: SeenFrame, style: str, scene_id: str, seed: int) -> U8:
    """Return a frame ``(H, W, 3)`` in another style: ``clear``, ``night``, ``fog`` or ``snow``.

    Raises:
        InputError: No such style.
    """
    if style == CLEAR:
        return np.array(frame.rgb)
    if style not in _FORMULAS:
        raise InputError(
            f"style {style!r}: no such style",
            f"choose one of {', '.join(STYLES)}",
        )
    image = frame.rgb.astype(np.float32) / np.float32(255)
    made = _FORMULAS[style](frame, image, stream(scene_id, seed, f"appearance.{style}"))
    return np.asarray(np.clip(np.rint(made * 255), 0, 255), dtype=np.uint8)


def _depth(frame: SeenFrame) -> F32:
    return np.where(frame.depth_m > 0.05, frame.depth_m, np.float32(FAR_M)).astype(np.float32)


def fog(frame: SeenFrame, image: F32, rng: np.random.Generator) -> F32:
    """Apply fog of one density to an image ``(H, W, 3)`` in 0 to 1."""
    per_m, light = rng.uniform(*FOG_PER_M), rng.uniform(0.68, 0.85) * np.array([0.99, 1.0, 1.02])
    through = np.exp(-per_m * _depth(frame))[..., None]
    return np.asarray(image * through + light * (1 - through), dtype=np.float32)


def night(frame: SeenFrame, image: F32, rng: np.random.Generator) -> F32:
    """Darken, shift to blue, and light the road ahead and the lamps."""
    gamma, gain = rng.uniform(1.5, 1.9), rng.uniform(0.16, 0.3)
    out = image**gamma * gain * NIGHT_RGB
    h, w = image.shape[:2]
    v, u = np.mgrid[:h, :w].astype(np.float32)
    side = (u - frame.K[0, 2]) / frame.K[0, 0]
    below = np.clip((v - frame.K[1, 2]) / frame.K[1, 1] * 8 + 0.5, 0, 1)
    own = np.exp(-_depth(frame) / HEADLIGHT_M) * np.exp(-((side / 0.45) ** 2)) * below
    out = out + image * 0.75 * own[..., None] * np.array([1.0, 0.96, 0.85])
    for x, y, z, *rgb in frame.lamps:
        if z < 1.0:
            continue
        at_u, at_v = frame.K[0, 0] * x / z + frame.K[0, 2], frame.K[1, 1] * y / z + frame.K[1, 2]
        if not (0 <= at_u < w and 0 <= at_v < h) or _depth(frame)[int(at_v), int(at_u)] < z - 1.0:
            continue  # outside, or hidden
        radius = max(0.12 * frame.K[0, 0] / z, 0.7)
        r2 = (u + 0.5 - at_u) ** 2 + (v + 0.5 - at_v) ** 2
        glow = np.exp(-r2 / (2 * radius**2)) + 0.18 * np.exp(-r2 / (2 * (4 * radius) ** 2))
        out = out + glow[..., None] * np.array(rgb)
    return np.asarray(out, dtype=np.float32)


def snow(frame: SeenFrame, image: F32, rng: np.random.Generator) -> F32:
    """Whiten what faces up, and let flakes fall; where a flake is depends on time alone."""
    cover, white = rng.uniform(0.6, 0.85), rng.uniform(0.82, 0.93)
    up = np.clip((_up_share(frame) - 0.6) / 0.3, 0, 1)[..., None]
    grey = image.mean(axis=2, keepdims=True)
    out = image + up * cover * (white * (0.75 + 0.25 * grey) - image)
    start, speed = (
        rng.uniform(0, 1, (FLAKES, 3)) * BOX_M,
        rng.uniform([-0.5, 1.0, -0.5], [0.5, 2.0, 0.5], (FLAKES, 3)),
    )
    return _with_flakes(frame, np.asarray(out, dtype=np.float32), start + speed * frame.t_us * 1e-6)


def _up_share(frame: SeenFrame) -> F32:
    """Return the upward part ``(H, W)`` of the surface's unit normal, from differences of depth; 0
    where there is no surface.
    """
    h, w = frame.depth_m.shape
    v, u = np.mgrid[:h, :w].astype(np.float64)
    z = frame.depth_m.astype(np.float64)
    rays = np.stack(
        [
            (u + 0.5 - frame.K[0, 2]) / frame.K[0, 0],
            (v + 0.5 - frame.K[1, 2]) / frame.K[1, 1],
            np.ones_like(u),
        ],
        axis=-1,
    )
    at = rays * z[..., None]
    normal = np.cross(np.gradient(at, axis=1), np.gradient(at, axis=0))
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    share = np.abs(normal @ frame.T_world_camera[2, :3])
    return np.where(z > 0.05, share, 0.0).astype(np.float32)


def _with_flakes(frame: SeenFrame, image: F32, world: F64) -> F32:
    """Draw flakes that fill space periodically and stand in the world, nearer ones larger; those
    behind a surface are hidden.
    """
    falling = world * np.array([1.0, -1.0, 1.0])  # y is the world's height here
    position = frame.T_world_camera[[0, 2, 1], 3]
    relative = (
        np.mod(falling - position, BOX_M) - BOX_M / 2
    )  # x, height, y in the world, around the camera
    at = (
        np.stack([relative[:, 0], relative[:, 2], relative[:, 1]], axis=1)
        @ frame.T_world_camera[:3, :3]
    )
    h, w = image.shape[:2]
    for x, y, z in at[at[:, 2] > 0.6]:
        u, v = frame.K[0, 0] * x / z + frame.K[0, 2], frame.K[1, 1] * y / z + frame.K[1, 2]
        if 1 <= u < w - 1 and 1 <= v < h - 1 and _depth(frame)[int(v), int(u)] > z:
            radius = int(np.clip(0.012 * frame.K[0, 0] / z, 0, 3))
            rows, columns = (
                slice(max(int(v) - radius, 0), int(v) + radius + 1),
                slice(max(int(u) - radius, 0), int(u) + radius + 1),
            )
            image[rows, columns] += 0.75 * (0.97 - image[rows, columns])
    return image


_FORMULAS = {"night": night, "fog": fog, "snow": snow}


def lights_of_posts(world: F64, T_world_camera: F64) -> F64:
    """Return the street lights within 80 m ahead as lamps ``(N, 6)`` of the camera, from their
    places ``(N, 3)`` in the world.
    """
    at = (world - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    seen = at[(at[:, 2] > 0) & (at[:, 2] < STREET_LIGHTS_M)]
    return np.concatenate([seen, np.tile(STREET_LIGHT_RGB, (len(seen), 1))], axis=1)


def vehicle_lamps(corners: Sequence[F64]) -> F64:
    """Return the lamps ``(N, 6)`` of vehicles from their boxes' corners ``(8, 3)``: white ahead,
    red behind.
    """
    rows = []
    for box in corners:
        for end, rgb in ((slice(4, 8), (1.0, 0.95, 0.8)), (slice(0, 4), (0.9, 0.08, 0.05))):
            face = box[end]  # low and high corners of both sides of one end
            top, bottom = face[np.argsort(face[:, 1])[:2]], face[np.argsort(face[:, 1])[2:]]
            nearer = np.linalg.norm(face.mean(axis=0)) < np.linalg.norm(box.mean(axis=0))
            if not nearer:
                continue
            for a, b in zip(
                top[np.argsort(top[:, 0])], bottom[np.argsort(bottom[:, 0])], strict=True
            ):
                side = 0.45 * a + 0.55 * b
                middle = face.mean(axis=0)
                rows.append([*(side + 0.15 * (middle - side)), *rgb])
    return np.array(rows, dtype=np.float64).reshape(-1, 6)
