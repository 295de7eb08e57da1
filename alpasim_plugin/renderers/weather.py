"""Weather and light between a renderer and what follows, by the depth of a frame.

An image of the clear day is taken for what surfaces reflect of a light of 1, in linear light. Night
and a low sun put another light there, rain wets the ground, and lamps shine
(`alpasim_plugin.renderers.lights`). Air takes light away with distance and adds its own
(Koschmieder, 1924): ``L = L_0 exp(-beta d) + A (1 - exp(-beta d))``, where d is the distance along
the pixel's ray. Of fog ``beta = 3.912 / visibility``: at the visibility, 2 % of a contrast is left
(CIE 17.4). Rain adds an extinction of its own (`alpasim_plugin.renderers.rain`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np

from alpasim_plugin.core.errors import RendererError
from alpasim_plugin.core.geometry import interpolate, inverse
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F32, F64, U8, Frame, RecordedFrame, RenderRequest, Scenario
from alpasim_plugin.renderers.lights import Panels, SceneLights, drawn
from alpasim_plugin.renderers.rain import extinction, mirrored_share, streaks, wet_albedo
from alpasim_plugin.renderers.view import View, view_of
from alpasim_plugin.world.ground import height_at

KOSCHMIEDER = 3.912  # -ln(0.02)
FOG_SRGB = (202, 206, 210)  # light of the air itself, by day
STEPS = 4095  # of the table from linear light to bytes

# by night, in lux: what a camera shows as white, and the light of the sky over a town
NIGHT_WHITE_LUX, NIGHT_SKY_LUX = 6.0, 0.25
BRIGHTEST = 3.0  # in white: what a camera compresses any light of lamps to
NIGHT_RGB = np.array([0.8, 0.9, 1.25], np.float32)
LAMP_RGB = np.array([1.0, 0.88, 0.7], np.float32)
LOW_SUN_RGB = np.array([1.0, 0.76, 0.54], np.float32)  # about 3500 K
SUN_ELEVATION_RAD, SUN_RADIUS_DEG = np.radians(6.0), 0.7
# Veiling light of a lens about the sun, in white times square degrees: a tenth of what Stiles and
# Holladay found for the eye (CIE 146).
VEIL_DEG2, VEIL_LEAST_DEG = 9.0, 1.5
PANEL_M, PANEL_PER_M = 0.5, 0.03  # a lamp so much behind what is rendered is seen
BLOOM_SHARE, BLOOM_WIDTHS = 0.3, 0.008  # of a lamp's light about it, and how far, in image widths
SMEAR_HEIGHTS = 0.06  # of a lamp's reflection on a rough wet road, in image heights


def _linear(levels: F64) -> F64:
    """Return the linear light of sRGB values in 0..1 (IEC 61966-2-1)."""
    return np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)


def _encoded(light: F64) -> F64:
    """Return the sRGB values of linear light in 0..1."""
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)


LIGHT_OF_BYTE = _linear(np.arange(256) / 255.0).astype(np.float32)
BYTE_OF_STEP = np.rint(255 * _encoded(np.arange(STEPS + 1) / STEPS)).astype(np.uint8)
AIR_RGB = LIGHT_OF_BYTE[list(FOG_SRGB)]


@dataclass(frozen=True, eq=False)
class Moment:
    """When an image was taken, by which camera, and what stood where: ``T_world_rig (4, 4)`` and
    the boxes of road users.
    """

    t_us: int
    camera: str
    T_world_rig: F64
    actors: Mapping[str, F64]


class Weather:
    """The weather of a scene.

    Args:
        scenario: Its ``environment``, and what shines there.
        seed: The rollout's, of the drops.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self.scenario, self.seed = scenario, seed
        self.environment = scenario.environment
        self.is_clear = self.environment == self.environment.in_clear_day
        self.is_night = self.environment.time == "night"
        self.lights = SceneLights(scenario, is_night=self.is_night)
        heading = scenario.ego_log.quat[0]
        azimuth = 2 * np.arctan2(heading[3], heading[0])
        level = np.cos(SUN_ELEVATION_RAD)
        self.to_sun = np.array(
            [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(SUN_ELEVATION_RAD)]
        )
        skies = {"day": 1.0, "low_sun": LOW_SUN_RGB}
        night = NIGHT_RGB * np.float32(NIGHT_SKY_LUX / NIGHT_WHITE_LUX)
        self.sky_rgb = np.float32(skies.get(self.environment.time, night))

    @property
    def changes_images(self) -> bool:
        """Whether an image shows anything of it."""
        signals = self.scenario.lane_map.signals or ()
        return not self.is_clear or any(signal.head is not None for signal in signals)

    def shown(self, rgb: U8, depth: F32, K: F64, T_world_camera: F64, moment: Moment) -> U8:
        """Return an image in this weather.

        Args:
            rgb: ``(H, W, 3)`` sRGB of the clear day.
            depth: ``(H, W)`` metres along the optical axis; 0 where there is no surface.
            K: ``(3, 3)`` intrinsics of the pinhole, pixels.
            T_world_camera: ``(4, 4)`` its pose.
            moment: What stood where.
        """
        view = view_of(depth, K, T_world_camera, self.scenario.ground)
        rain = self.environment.rain
        light = LIGHT_OF_BYTE[rgb]
        if rain:
            light += view.ground[..., None] * (wet_albedo(light) - light)
        if self.is_night:
            lux = self.lights.lux(view, moment.T_world_rig, moment.actors)
            lamps = lux / np.float32(NIGHT_WHITE_LUX)
            light *= self.sky_rgb + (lamps / (1 + lamps / BRIGHTEST))[..., None] * LAMP_RGB
        else:
            light *= self.sky_rgb
        panels = self.lights.panels(view, moment.actors, moment.t_us)
        if rain:
            light += self._mirrored(view, panels)
        glow = _draw_lamps(light, view, panels)
        if not self.is_clear:
            through = self.transmittance(view)[..., None]
            light = light * through + AIR_RGB * self.sky_rgb * (1 - through)
        if self.is_night:
            light += glow
        if self.environment.time == "low_sun":
            light += self._sun(view)
        if rain:
            rng = stream(self.scenario.scene_id, self.seed, f"rain.{moment.camera}", moment.t_us)
            down = -T_world_camera[2, :3]
            covered = streaks(depth.shape, K, down, rain, rng)[..., None]
            light += covered * (AIR_RGB * self.sky_rgb - light)
        return BYTE_OF_STEP[np.rint(np.clip(light, 0, 1) * STEPS).astype(np.int32)]

    def transmittance(self, view: View) -> F32:
        """Return the share of light ``(H, W)`` that reaches the camera; 0 from the sky."""
        beta = extinction(self.environment.rain)
        if self.environment.fog_visibility_m is not None:
            beta += KOSCHMIEDER / self.environment.fog_visibility_m
        is_sky = np.isinf(view.distance_m)
        sky = np.float32(0 if beta else 1)
        return np.where(
            is_sky, sky, np.exp(np.where(is_sky, 0, view.distance_m) * -np.float32(beta))
        )

    def _mirrored(self, view: View, panels: Panels) -> F32:
        """Return what wet ground reflects of the sky and, smeared, of lamps ``(H, W, 3)``."""
        share = view.ground * mirrored_share(-view.rays[..., 2])
        corners = panels.corners.copy()
        foot = height_at(self.scenario.ground, corners.reshape(-1, 3)).reshape(-1, 4)
        corners[..., 2] = 2 * foot - corners[..., 2]
        lamps, _ = drawn(Panels(corners, panels.rgb), view)
        lamps = cv2.GaussianBlur(lamps, (0, 0), sigmaX=0.6, sigmaY=SMEAR_HEIGHTS * len(lamps))
        return share[..., None] * (AIR_RGB * self.sky_rgb + lamps)

    def _sun(self, view: View) -> F32:
        """Return the sun ahead and its veil in the lens ``(H, W, 1)``, as much as is not hidden."""
        cosine = np.clip(view.rays @ self.to_sun.astype(np.float32), -1, 1)
        angle_deg = np.degrees(np.arccos(cosine))
        about = angle_deg < 2 * SUN_RADIUS_DEG
        if not about.any():
            return np.zeros((*angle_deg.shape, 1), np.float32)
        is_sky = np.isinf(view.distance_m)
        seen = np.float32(is_sky[about].mean())
        veil = seen * np.float32(VEIL_DEG2) / np.maximum(angle_deg, VEIL_LEAST_DEG) ** 2
        return (veil + 10 * (is_sky & (angle_deg < SUN_RADIUS_DEG)))[..., None]


def _draw_lamps(light: F32, view: View, panels: Panels) -> F32:
    """Draw panels that nothing hides into an image, and return their glow."""
    colours, depth = drawn(panels, view)
    seen = depth < view.depth_m * (1 + PANEL_PER_M) + PANEL_M
    seen &= np.isfinite(depth)
    light[seen] = colours[seen]
    colours[~seen] = 0
    sigma = BLOOM_WIDTHS * light.shape[1]
    return cv2.GaussianBlur(colours, (0, 0), sigma) * np.float32(BLOOM_SHARE)


class WeatherRenderer(Renderer):
    """Show what another renderer shows in the weather of a scene, and the same of its recorded
    frames.

    Args:
        base: Its frames need depth.
        weather: Of the scene.

    Raises:
        RendererError: A frame without depth.
    """

    def __init__(self, base: Renderer, weather: Weather) -> None:
        self.base, self.weather = base, weather
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
        """Return the base renderer's recorded frames in the weather, with the ego where it was."""
        return [
            replace(frame, read=partial(_read_in, self.weather, frame))
            for frame in self.base.recorded()
        ]

    def facts(self) -> Mapping[str, Any]:
        """Return the base renderer's facts and the weather."""
        environment = self.weather.environment
        keys = ("fog_visibility_m", "time", "rain")
        return {**self.base.facts(), **{key: getattr(environment, key) for key in keys}}

    def _shown(self, request: RenderRequest, frame: Frame) -> Frame:
        if frame.depth is None and self.weather.is_clear:
            return frame
        if frame.depth is None:
            raise RendererError(
                f"weather over {type(self.base).__name__}: its frame has no depth",
                "Drive by clear day (environment.time, rain, fog_visibility_m), or let the renderer return depth",
            )
        camera, pose = request.camera, request.T_world_camera[-1]
        T_world_rig = pose @ inverse(camera.T_rig_camera)
        moment = Moment(request.t_us, camera.name, T_world_rig, request.actors)
        return replace(
            frame, rgb=self.weather.shown(frame.rgb, frame.depth, camera.K, pose, moment)
        )


def _read_in(weather: Weather, frame: RecordedFrame) -> tuple[U8, F32]:
    rgb, depth = frame.read()
    T_world_rig = interpolate(weather.scenario.ego_log, frame.t_us)
    moment = Moment(frame.t_us, frame.camera, T_world_rig, frame.actors)
    return weather.shown(rgb, depth, frame.K, frame.T_world_camera, moment), depth


def in_weather(renderer: Renderer, scenario: Scenario, seed: int) -> Renderer:
    """Return a renderer in the weather of a scene; itself where nothing of it is seen."""
    weather = Weather(scenario, seed)
    return WeatherRenderer(renderer, weather) if weather.changes_images else renderer
