"""Weather between a renderer and what follows: fog in the depth of a frame.

Fog takes light away with distance and adds its own (Koschmieder, 1924): in linear light
``L = L_0 exp(-beta d) + A (1 - exp(-beta d))``, where d is the distance along the pixel's ray and
``beta = 3.912 / visibility``: at the visibility, 2 % of a contrast is left (CIE 17.4).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np

from alpasim_plugin.core.errors import RendererError
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.types import F32, F64, U8, Environment, Frame, RecordedFrame, RenderRequest

KOSCHMIEDER = 3.912  # -ln(0.02)
FOG_SRGB = (202, 206, 210)  # light of the fog itself, by day
STEPS = 4095  # of the table from linear light to bytes


def _linear(levels: F64) -> F64:
    """Return the linear light of sRGB values in 0..1 (IEC 61966-2-1)."""
    return np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)


def _encoded(light: F64) -> F64:
    """Return the sRGB values of linear light in 0..1."""
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)


LIGHT_OF_BYTE = _linear(np.arange(256) / 255.0).astype(np.float32)
BYTE_OF_STEP = np.rint(255 * _encoded(np.arange(STEPS + 1) / STEPS)).astype(np.uint8)


def transmittance(depth: F32, K: F64, T_world_camera: F64, visibility_m: float) -> F32:
    """Return the share of light that reaches the camera through fog.

    Args:
        depth: ``(H, W)`` metres along the optical axis; 0 where there is no surface. Above the
            horizon that is the sky; below it is a hole of the model, which is as far away as the
            nearest surface in the image.
        K: ``(3, 3)`` intrinsics of the pinhole, pixels.
        T_world_camera: ``(4, 4)`` its pose.
        visibility_m: Distance at which 2 % of a contrast is left.

    Returns:
        ``(H, W)``, 0 in the sky.
    """
    height, width = depth.shape
    x = ((np.arange(width) + 0.5 - K[0, 2]) / K[0, 0])[None, :]
    y = ((np.arange(height) + 0.5 - K[1, 2]) / K[1, 1])[:, None]
    along_ray = np.sqrt(1 + x**2 + y**2).astype(np.float32)
    up = T_world_camera[2, 0] * x + T_world_camera[2, 1] * y + T_world_camera[2, 2]
    filled = _nearest_surface(depth)
    through = np.exp(filled * along_ray * np.float32(-KOSCHMIEDER / visibility_m))
    is_sky = (filled == 0) | ((depth == 0) & (up > 0))
    return np.where(is_sky, np.float32(0), through)


def _nearest_surface(depth: F32) -> F32:
    """Return a depth image with holes filled by the nearest pixel that has a surface."""
    surfaces = np.flatnonzero(depth)
    if surfaces.size in (0, depth.size):
        return depth
    holes = (depth == 0).astype(np.uint8)
    _, labels = cv2.distanceTransformWithLabels(
        holes, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(int(labels.max()) + 1, np.float32)
    of_label[labels.reshape(-1)[surfaces]] = depth.reshape(-1)[surfaces]
    return of_label[labels]


def in_fog(rgb: U8, depth: F32, K: F64, T_world_camera: F64, visibility_m: float) -> U8:
    """Return an image ``(H, W, 3)`` sRGB in fog; arguments as of `transmittance`."""
    through = transmittance(depth, K, T_world_camera, visibility_m)[..., None]
    fog = LIGHT_OF_BYTE[list(FOG_SRGB)]
    light = LIGHT_OF_BYTE[rgb] * through + fog * (1 - through)
    return BYTE_OF_STEP[np.rint(light * STEPS).astype(np.int32)]


class FogRenderer(Renderer):
    """Show what another renderer shows, in fog, and the same of its recorded frames.

    Args:
        base: Its frames need depth.
        visibility_m: See `transmittance`.

    Raises:
        RendererError: A frame without depth.
    """

    def __init__(self, base: Renderer, visibility_m: float) -> None:
        self.base, self.visibility_m = base, visibility_m
        self.lookahead = base.lookahead
        self.block = base.block
        self.has_history = base.has_history

    @property
    def stage_ms(self) -> Mapping[str, float]:  # type: ignore[override]  # that of the base
        """Times of the base renderer's last call."""
        return self.base.stage_ms

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame."""
        return self._shown(request, self.base.render(request))

    def render_batch(self, requests: Sequence[RenderRequest]) -> Sequence[Frame]:
        """Render the frames of an instant."""
        frames = self.base.render_batch(requests)
        return [self._shown(request, f) for request, f in zip(requests, frames, strict=True)]

    def recorded(self) -> Sequence[RecordedFrame]:
        """Return the base renderer's recorded frames in fog."""
        return [
            replace(frame, read=partial(_read_in_fog, frame, self.visibility_m))
            for frame in self.base.recorded()
        ]

    def facts(self) -> Mapping[str, Any]:
        """Return the base renderer's facts and the visibility."""
        return {**self.base.facts(), "fog_visibility_m": self.visibility_m}

    def _shown(self, request: RenderRequest, frame: Frame) -> Frame:
        if frame.depth is None:
            raise RendererError(
                f"fog over {type(self.base).__name__}: its frame has no depth",
                "Drive without environment.fog_visibility_m, or let the renderer return depth",
            )
        pose = request.T_world_camera[-1]
        rgb = in_fog(frame.rgb, frame.depth, request.camera.K, pose, self.visibility_m)
        return replace(frame, rgb=rgb)


def _read_in_fog(frame: RecordedFrame, visibility_m: float) -> tuple[U8, F32]:
    rgb, depth = frame.read()
    return in_fog(rgb, depth, frame.K, frame.T_world_camera, visibility_m), depth


def in_weather(renderer: Renderer, environment: Environment) -> Renderer:
    """Return a renderer in the weather of a scene; itself where there is none."""
    if environment.fog_visibility_m is None:
        return renderer
    return FogRenderer(renderer, environment.fog_visibility_m)
