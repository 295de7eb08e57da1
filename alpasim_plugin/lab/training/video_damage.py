"""Damage a recorded video as an under-trained reconstruction damages a scene: the frames are drawn
again with splats that move along.

There is no pose and no geometry, so the splats live in the image: each has a place, an ellipse, a
colour from the frame it appears in, and an opacity. From frame to frame they follow the optical
flow, imperfectly, as Gaussians at a wrong depth do; where a motion opens a gap the ground shows
through until new ones appear. Patches have few and faint splats (holes), colours err by blotches,
floaters move faster than what is behind them. The project's own rasteriser draws them, so that
edges and opacity look as in its renders.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import cv2
import numpy as np

from alpasim_plugin.core.types import F32, F64, U8, Bool
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.raster.rasterize import rasterize
from alpasim_plugin.gaussians.sh import dc_from_rgb

Rng = np.random.Generator
MARGIN_PX = 12.0  # splats live this far outside the image
# Invented depths: lower rows are nearer and drawn over higher ones
NEAR_M = 5.0
FAR_M = 20.0
# share by which a colour approaches the frame's, each frame: views taken later are part of the fit
# as well
REFIT = 0.08
GROWTH = (0.92, 1.12)  # bounds of a splat's growth from frame to frame
LARGEST_CELLS = 3.0  # a splat that grows beyond this many cells ends


@dataclass(frozen=True)
class SplatDamage:
    """How a video is damaged.

    Attributes:
        cell_px: Distance of neighbouring splats; what is finer is lost.
        spread: Standard deviation of a splat in cells; near one half gaps remain.
        stretch: Spread of the logarithm of the ellipses' axes.
        wrong_motion: Spread of the splats' motion about the flow, as a share of it.
        colour_error: Size of colour blotches, 0 to 1 levels.
        hole_share: Share of the image that hole patches cover.
        floaters: Number of floaters at a time.
        life_frames: Mean life of a splat.
        drift: Spread of the exposure's drift.
    """

    cell_px: float
    spread: float
    stretch: float
    wrong_motion: float
    colour_error: float
    hole_share: float
    floaters: int
    life_frames: float
    drift: float


def draw_damage(rng: Rng, width: int) -> SplatDamage:
    """Draw a damage for frames ``width`` pixels wide; sizes are those of 256-pixel frames, scaled
    half as much as the frames.
    """
    scale = (width / 256) ** 0.5
    return SplatDamage(
        cell_px=scale * float(np.exp(rng.uniform(np.log(1.7), np.log(3.8)))),
        spread=rng.uniform(0.6, 0.95),
        stretch=rng.uniform(0.2, 0.6),
        wrong_motion=rng.uniform(0.0, 0.12),
        colour_error=rng.uniform(0.0, 0.04),
        hole_share=rng.uniform(0.0, 0.08),
        floaters=int(rng.integers(0, 7)),
        life_frames=rng.uniform(15, 60),
        drift=rng.uniform(0.0, 0.02),
    )


@dataclass
class _Splats:
    """Splats in the image; N rows each."""

    xy: F64  # (N, 2) px
    scale_px: F64  # (N, 2)
    turn_rad: F64  # (N,)
    rgb: F64  # (N, 3) 0..1
    tint: F64  # (N, 3) error of the colour
    opacity: F64  # (N,)
    depth_m: F64  # (N,)
    pace: F64  # (N,) share of the flow that it moves
    life: F64  # (N,) frames left

    def keep(self, which: Bool) -> Self:
        return type(self)(**{f.name: getattr(self, f.name)[which] for f in fields(self)})

    def join(self, other: _Splats) -> Self:
        return type(self)(
            **{
                f.name: np.concatenate([getattr(self, f.name), getattr(other, f.name)])
                for f in fields(self)
            }
        )


def damage_video(
    frames: Sequence[U8] | U8, damage: SplatDamage, rng: Rng
) -> Iterator[tuple[U8, U8]]:
    """Yield the damaged image ``(H, W, 3)`` and its opacity ``(H, W)``, both uint8, of every frame
    ``(H, W, 3)`` in order of time.
    """
    h, w = frames[0].shape[:2]
    camera = PinholeCamera(
        w, h, np.array([[w, 0.0, w / 2], [0.0, w, h / 2], [0.0, 0.0, 1.0]]), np.eye(4)
    )
    flow_between = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    thin = _thin_ground(rng, (h, w), damage)
    patches = smooth_field(rng, (h, w), 4, 30 * w / 256).astype(np.float64)
    # More of brightness than of hue
    blotches = damage.colour_error * (0.8 * patches[..., :1] + 0.35 * patches[..., 1:])
    behind = np.asarray(
        frames[0][: max(1, h // 4)].reshape(-1, 3).mean(axis=0) / 255
        if rng.random() < 0.7
        else np.zeros(3)
    )
    exposure = 1.0
    before = np.asarray(frames[0])
    splats = _born(rng, before, damage, thin, blotches, np.zeros((0, 2)))
    floaters = _floaters(rng, before, damage, damage.floaters)
    for frame in frames:
        now = np.asarray(frame)
        empty: Any = None  # the stubs do not know that OpenCV makes the array
        flow = flow_between.calc(
            cv2.cvtColor(before, cv2.COLOR_RGB2GRAY), cv2.cvtColor(now, cv2.COLOR_RGB2GRAY), empty
        )
        splats = _moved(splats, flow, now, damage)
        floaters = _moved(floaters, flow, None, damage)
        splats = splats.join(_born(rng, now, damage, thin, blotches, splats.xy))
        floaters = floaters.join(_floaters(rng, now, damage, damage.floaters - len(floaters.xy)))
        exposure = float(
            np.clip(exposure + damage.drift * rng.normal() - 0.1 * (exposure - 1), 0.85, 1.15)
        )
        out = rasterize(_cloud(splats.join(floaters), w, h), camera, tuple(behind))
        image = np.rint(np.clip(out.rgb * exposure, 0, 1) * 255).astype(np.uint8)
        yield image, np.rint(np.clip(out.alpha, 0, 1) * 255).astype(np.uint8)
        before = now


def smooth_field(rng: Rng, shape: tuple[int, ...], channels: int, scale_px: float) -> F32:
    """Draw a smooth random field ``(H, W, channels)`` with a scale of ``scale_px`` pixels and unit
    root mean square.
    """
    h, w = shape[:2]
    knots = rng.standard_normal(
        (max(2, round(h / scale_px) + 1), max(2, round(w / scale_px) + 1), channels),
        dtype=np.float32,
    )
    field = cv2.resize(knots, (w, h), interpolation=cv2.INTER_CUBIC).reshape(h, w, channels)
    return (field / (np.sqrt((field**2).mean()) + 1e-6)).astype(np.float32)


def _thin_ground(rng: Rng, shape: tuple[int, int], damage: SplatDamage) -> F32:
    """Return ``(H, W)`` 0..1: 1 where splats are few and faint."""
    field = smooth_field(rng, shape, 1, 22 * shape[1] / 256)[..., 0]
    edge = float(np.quantile(field, 1 - damage.hole_share))
    return np.asarray(np.clip((field - edge) / 0.3, 0, 1), dtype=np.float32)


def _born(
    rng: Rng, frame: U8, damage: SplatDamage, thin: F32, blotches: F64, taken: F64
) -> _Splats:
    """Return new splats on a jittered grid, where no other is near; fewer and fainter on thin
    ground.
    """
    h, w = frame.shape[:2]
    cell = damage.cell_px
    rows = int(np.ceil(h / cell)) + 2
    columns = int(np.ceil(w / cell)) + 2
    free = np.ones((rows, columns), dtype=bool)
    cell_index = np.floor(taken / cell + 1).astype(int)
    inside = (
        (cell_index >= 0).all(axis=1) & (cell_index[:, 0] < columns) & (cell_index[:, 1] < rows)
    )
    free[cell_index[inside, 1], cell_index[inside, 0]] = False
    # A gap closes with a delay: a fit sees it only with the next view.
    chosen = np.argwhere(free & (rng.random(free.shape) < (0.35 if len(taken) else 1.0)))
    xy = (chosen[:, ::-1] - 1 + rng.random((len(chosen), 2))) * cell
    x, y = (np.clip(xy[:, axis].astype(int), 0, size - 1) for axis, size in ((0, w), (1, h)))
    thinness = thin[y, x]
    stays = rng.random(len(xy)) > 0.75 * thinness
    xy = xy[stays]
    x = x[stays]
    y = y[stays]
    thinness = thinness[stays]
    n = len(xy)
    soft = cv2.GaussianBlur(frame, (0, 0), 0.35 * cell)
    axes = cell * damage.spread * np.exp(damage.stretch * rng.standard_normal((n, 2)))
    depth_m = FAR_M - (FAR_M - NEAR_M) * np.clip(xy[:, 1] / h, 0, 1) + rng.uniform(0, 0.5, n)
    return _Splats(
        xy,
        axes,
        rng.uniform(0, np.pi, n),
        soft[y, x] / 255.0,
        blotches[y, x],
        rng.uniform(0.5, 0.98, n) * (1 - 0.93 * thinness),
        depth_m,
        1 + damage.wrong_motion * rng.standard_normal(n),
        rng.exponential(damage.life_frames, n) + 3,
    )


def _floaters(rng: Rng, frame: U8, damage: SplatDamage, count: int) -> _Splats:
    """Return large splats in colours from elsewhere, before everything else."""
    h, w = frame.shape[:2]
    n = max(0, count)
    xy = rng.random((n, 2)) * (w, h)
    source = (rng.random((n, 2)) * (h, w)).astype(int)
    long_px = damage.cell_px * rng.uniform(1.0, 4.0, (n, 1))
    axes = long_px * np.column_stack([np.ones(n), rng.uniform(0.15, 1.0, n)])
    return _Splats(
        xy,
        axes,
        rng.uniform(0, np.pi, n),
        frame[source[:, 0], source[:, 1]] / 255.0,
        np.zeros((n, 3)),
        rng.uniform(0.2, 0.8, n),
        rng.uniform(2.0, 4.0, n),
        rng.uniform(1.2, 1.8, n),
        rng.exponential(20, n) + 5,
    )


def _moved(splats: _Splats, flow: F32, frame: U8 | None, damage: SplatDamage) -> _Splats:
    """Move splats by the flow ``(H, W, 2)`` at their places, let them grow with it, and end those
    that leave, age or grow too large.

    With a frame their colours approach its own.
    """
    h, w = flow.shape[:2]
    x, y = (np.clip(splats.xy[:, axis].astype(int), 0, size - 1) for axis, size in ((0, w), (1, h)))
    smooth = cv2.GaussianBlur(flow, (0, 0), 3.0)
    growth = (
        1 + 0.5 * (np.gradient(smooth[..., 0], axis=1) + np.gradient(smooth[..., 1], axis=0))[y, x]
    )
    splats.xy = splats.xy + splats.pace[:, None] * flow[y, x]
    splats.scale_px = splats.scale_px * np.clip(growth, *GROWTH)[:, None]
    splats.life = splats.life - 1
    near = ((splats.xy > -MARGIN_PX) & (splats.xy < (w + MARGIN_PX, h + MARGIN_PX))).all(axis=1)
    largest = LARGEST_CELLS * damage.cell_px * (1 if frame is not None else 3)
    splats = splats.keep(near & (splats.life > 0) & (splats.scale_px.max(axis=1) < largest))
    if frame is not None:
        x, y = (
            np.clip(splats.xy[:, axis].astype(int), 0, size - 1) for axis, size in ((0, w), (1, h))
        )
        soft = cv2.GaussianBlur(frame, (0, 0), 0.35 * damage.cell_px)
        splats.rgb = splats.rgb + REFIT * (soft[y, x] / 255.0 - splats.rgb)
    return splats


def _cloud(splats: _Splats, width: int, height: int) -> GaussianCloud:
    """Return splats as flat Gaussians before a camera whose focal length is ``width`` pixels."""
    z = splats.depth_m
    offset = (splats.xy - (width / 2, height / 2)) * (z / width)[:, None]
    size = splats.scale_px * (z / width)[:, None]
    half = splats.turn_rad / 2
    zero = np.zeros(len(z))
    quats = np.column_stack([np.cos(half), zero, zero, np.sin(half)])
    colour = dc_from_rgb(np.clip(splats.rgb + splats.tint, 0, 1))
    flat = np.column_stack([size, 1e-3 * size.min(axis=1)])
    return GaussianCloud(
        np.column_stack([offset, z]), quats, flat, splats.opacity, np.reshape(colour, (-1, 1, 3))
    )
