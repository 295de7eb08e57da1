"""Weather and light between a renderer and what follows, by the depth of what a camera looks at: of
a built scene that of the scene, behind every renderer alike, of a recorded drive that of its frames.

An image of the clear day is taken for what surfaces reflect of a light of 1, in linear light. Night
and a low sun put another light there, rain wets the ground, and lamps shine
(`alpasim_plugin.renderers.lights`). Air takes light away with distance and adds its own
(Koschmieder, 1924): ``L = L_0 exp(-beta d) + A (1 - exp(-beta d))``, where d is the distance along
the pixel's ray. Of fog ``beta = 3.912 / visibility``: at the visibility, 2 % of a contrast is left
(CIE 17.4). Rain and snow add their own (`alpasim_plugin.renderers.precipitation`); snow lies on what
is seen (`alpasim_plugin.renderers.snow`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import cv2
import numpy as np

from alpasim_plugin.cameras.lens import blackened, intrinsics_on_axis
from alpasim_plugin.cameras.shutter import at_share
from alpasim_plugin.core.errors import RendererError
from alpasim_plugin.core.geometry import interpolate, inverse
from alpasim_plugin.core.interfaces import Renderer, complete
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import (
    F32,
    F64,
    U8,
    CameraSpec,
    Frame,
    RecordedFrame,
    RenderRequest,
    Scenario,
)
from alpasim_plugin.gaussians.lens_camera import blind_part
from alpasim_plugin.renderers.built_depth import BuiltDepth
from alpasim_plugin.renderers.gaussian import CleanRenderer
from alpasim_plugin.renderers.lights import SceneLights, Spot, drawn, in_image
from alpasim_plugin.renderers.precipitation import RAIN, SNOW, mirrored_share, wet_albedo
from alpasim_plugin.renderers.snow import ALBEDO, SnowCover
from alpasim_plugin.renderers.view import (
    View,
    depths_of,
    shown_at,
    view_of,
)

KOSCHMIEDER = 3.912  # -ln(0.02)
STEPS = 4095  # of the table from linear light to bytes
# At night, in lux: what a camera shows as white, and the light of the sky over a town; in white:
# what it compresses any light of lamps to.
WHITE_LUX = 6.0
SKY_LUX = 0.25
BRIGHTEST = 3.0
LIGHT_RGB = {
    "day": (1.0, 1.0, 1.0),
    "low_sun": (1.0, 0.76, 0.54),  # about 3500 K
    "night": tuple(share * SKY_LUX / WHITE_LUX for share in (0.8, 0.9, 1.25)),
}
LAMP_RGB = np.array([1.0, 0.88, 0.7], dtype=np.float32)
SUN_TANGENT = 0.1  # of its height
# Veiling light of a lens about the sun, in white times square degrees, about a tenth of what Stiles
# and Holladay found for the eye (CIE 146).
VEIL_DEG2 = 6.0
# A lamp so much behind what is rendered is seen
SEEN_M = 0.5
SEEN_PER_M = 0.03
GLOW_SHARE = 0.3  # of a lamp's light about it
GLOW_WIDTHS = 0.008  # how far that light reaches, in image widths
SMEAR_HEIGHTS = 0.06  # of a lamp's reflection on a rough wet road, in image heights


def _linear(levels: F64) -> F64:
    """Return the linear light of sRGB values in 0..1 (IEC 61966-2-1)."""
    return np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)


LIGHT_OF_BYTE = _linear(np.arange(256) / 255.0).astype(np.float32)
FOG_SRGB = (202, 206, 210)
DAY_AIR_RGB = LIGHT_OF_BYTE[list(FOG_SRGB)]  # of the air itself, and of what falls
STEP_LIGHT = np.arange(STEPS + 1) / STEPS
BYTE_OF_STEP = np.rint(np.interp(STEP_LIGHT, LIGHT_OF_BYTE, np.arange(256))).astype(np.uint8)


class WeatherRenderer(Renderer):
    """Show what another renderer shows in the weather of a scene, and the same of its recorded
    frames.

    Args:
        base: Its frames need depth.
        scenario: Its ``environment``, and what shines there.
        seed: The rollout's, of the drops.
        device: Where the depth of a built scene is drawn.
        threads: Of the CPU rasteriser; None leaves their number.
        cameras: Those that the base renderer draws; None: the scenario's.

    Raises:
        RendererError: A frame without depth.
    """

    def __init__(
        self,
        base: Renderer,
        scenario: Scenario,
        seed: int,
        device: str = "cpu",
        threads: int | None = None,
        cameras: Sequence[CameraSpec] | None = None,
    ) -> None:
        self.mounts = {
            camera.name: camera.T_rig_camera
            for camera in (scenario.cameras if cameras is None else cameras)
        }
        self.base, self.scenario, self.seed = complete(base, Renderer), scenario, seed
        self.lookahead = self.base.lookahead
        self.block = self.base.block
        self.has_history = self.base.has_history
        self.draws_lenses = self.base.draws_lenses
        self.unlit_frames = 0
        self.is_clear = scenario.environment == scenario.environment.in_clear_day
        self.lights = SceneLights(scenario)
        self.light_rgb = np.array(LIGHT_RGB[scenario.environment.time], dtype=np.float32)
        self.air_rgb = DAY_AIR_RGB * self.light_rgb
        rates = ((RAIN, scenario.environment.rain), (SNOW, scenario.environment.snow))
        self.falling = [(kind, rate) for kind, rate in rates if rate]
        self.extinction = KOSCHMIEDER / (scenario.environment.fog_visibility_m or np.inf)
        self.extinction += sum(kind.extinction(rate) for kind, rate in self.falling)
        self.snow = SnowCover(scenario) if scenario.environment.snow else None
        # The depth of `clean` is that of the scene as built.
        has_own_depth = scenario.model is not None or isinstance(base, CleanRenderer)
        self.built = None if has_own_depth else BuiltDepth(scenario, device, threads)

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
            replace(frame, read=partial(self._recorded, frame)) for frame in self.base.recorded()
        ]

    def facts(self) -> Mapping[str, Any]:
        """Return the base renderer's facts, the weather, and in how many frames of a renderer without
        depth a traffic light in view could not be drawn.
        """
        unlit = {"unlit_frames": self.unlit_frames} if self.unlit_frames else {}
        return {**self.base.facts(), "environment": asdict(self.scenario.environment), **unlit}

    def _shown(self, request: RenderRequest, frame: Frame) -> Frame:
        if frame.depth is None and not self.is_clear:
            raise RendererError(
                f"weather over {type(self.base).__name__}: its frame has no depth",
                "Remove environment.time, rain, snow and fog_visibility_m, or let the renderer return depth",
            )
        camera = request.camera
        # Of a rolling shutter the middle row's, so that no row is off by more than half of it.
        T_world_camera, actors = request.T_world_camera[-1], request.actors
        if request.exposure is not None:
            T_world_camera, actors = at_share(request, 0.5)
        if self._is_as_rendered(camera, T_world_camera, actors, request.t_us):
            return frame
        if frame.depth is None:
            self.unlit_frames += 1
            return frame
        rgb = frame.rgb
        depth = frame.depth if self.built is None else self.built.of_request(request)
        taken = RecordedFrame(
            request.t_us, camera.name, camera.K, T_world_camera, actors, lambda: (rgb, depth)
        )
        T_world_rig = T_world_camera @ inverse(camera.T_rig_camera)
        weathered = self._in_weather(rgb, depth, taken, camera, T_world_rig)
        return replace(frame, rgb=blackened(weathered, blind_part(camera)))

    def _recorded(self, frame: RecordedFrame) -> tuple[U8, F32]:
        """Return a recorded image in this weather, and its depth as the renderer sees it; the ego is
        where its camera's mount says, and where the log says for a camera that the scenario does
        not mount.
        """
        log = self.scenario.ego_log
        T_world_rig = (
            frame.T_world_camera @ inverse(self.mounts[frame.camera])
            if frame.camera in self.mounts
            else interpolate(log, np.clip(frame.t_us, log.t_us[0], log.t_us[-1]))
        )
        rgb, seen_depth = frame.read()
        height, width = seen_depth.shape
        camera = CameraSpec(frame.camera, width, height, frame.K, np.eye(4), lens=frame.lens)
        if self._is_as_rendered(camera, frame.T_world_camera, frame.actors, frame.t_us):
            return rgb, seen_depth
        depth = seen_depth
        if self.built is not None:
            depth = self.built.of_recorded(frame, height, width)
        return self._in_weather(rgb, depth, frame, camera, T_world_rig), seen_depth

    def _is_as_rendered(
        self,
        camera: CameraSpec,
        T_world_camera: F64,
        actors: Mapping[str, F64],
        t_us: int,
    ) -> bool:
        """Return whether nothing of the weather is in an image: a clear day without a traffic light
        in view. Then nobody needs its depth.
        """
        return self.is_clear and not in_image(
            self.lights.spots(actors, t_us), camera, T_world_camera
        )

    def _in_weather(
        self, rgb: U8, depth: F32, frame: RecordedFrame, camera: CameraSpec, T_world_rig: F64
    ) -> U8:
        """Return an image in this weather, with the ego at a pose ``(4, 4)``.

        Surfaces get their colours, then the light that falls on them, then what lies between them
        and the camera, each effect on what the ones before it made.

        Args:
            rgb: ``(H, W, 3)`` sRGB of the clear day.
            depth: ``(H, W)`` metres of what the camera looks at (see `view.depths_of`), 0 in the
                sky.
            frame: When, from where and beside whom it was taken.
            camera: Its size and lens.
            T_world_rig: Of the ego.
        """
        view = self._view(frame, camera, depth)
        spots = self.lights.spots(frame.actors, frame.t_us)
        light = LIGHT_OF_BYTE[rgb]
        self._wet(light, view)
        self._cover_with_snow(light, view)
        illumination = self._illumination(view, T_world_rig)
        light *= illumination
        self._mirror_lamps(light, view, spots, T_world_rig)
        glow = _draw_lamps(light, view, [*self.lights.windows, *spots])
        light = self._through_air(light, view)
        if self.lights.is_night:
            light += glow
        self._veil(light, view)
        self._draw_falling(light, illumination, frame, camera)
        return BYTE_OF_STEP[np.rint(np.clip(light, 0, 1) * STEPS).astype(np.int32)]

    def _view(self, frame: RecordedFrame, camera: CameraSpec, depth: F32) -> View:
        """Return what stands where in an image, road users among it."""
        boxes_by_id = {actor.actor_id: actor.box for actor in self.scenario.actors}
        boxes = [
            (T_world_box, boxes_by_id[actor_id])
            for actor_id, T_world_box in frame.actors.items()
            if actor_id in boxes_by_id
        ]
        return view_of(depth, camera, frame.T_world_camera, self.scenario.ground, boxes)

    def _wet(self, light: F32, view: View) -> None:
        """Darken the ground where it is wet, in place."""
        if self.scenario.environment.rain or self.scenario.environment.snow:
            light += view.ground[..., None] * (wet_albedo(light) - light)

    def _cover_with_snow(self, light: F32, view: View) -> None:
        """Whiten what snow lies on, in place."""
        if self.snow:
            light += self.snow.on(view)[..., None] * (ALBEDO - light)

    def _illumination(self, view: View, T_world_rig: F64) -> F32:
        """Return the light on each pixel's surface, ``(3,)`` of the sky alone, ``(H, W, 3)`` where
        lamps add to it; compressed so that near lamps do not saturate.
        """
        if not self.lights.is_night:
            return self.light_rgb
        lamps = self.lights.lux(view, T_world_rig) / np.float32(WHITE_LUX)
        compressed = (lamps / (1 + lamps / np.float32(BRIGHTEST)))[..., None]
        return (self.light_rgb + compressed * LAMP_RGB).astype(np.float32)

    def _mirror_lamps(
        self, light: F32, view: View, spots: Sequence[Spot], T_world_rig: F64
    ) -> None:
        """Mirror the sky, and lamps that nothing hides, in a wet ground, smeared upright by its
        ripples, in place.
        """
        if not self.scenario.environment.rain:
            return
        flip = np.array([1.0, 1.0, -1.0])
        ground_twice = np.array([0.0, 0.0, 2 * T_world_rig[2, 3]])
        below = [
            replace(spot, middle=spot.middle * flip + ground_twice)
            for spot in spots
            if not _is_hidden(spot, view)
        ]
        lamps, _ = drawn(below, view)
        smeared = cv2.GaussianBlur(lamps, (0, 0), sigmaX=0.6, sigmaY=SMEAR_HEIGHTS * len(lamps))
        share = view.ground * mirrored_share(-view.rays[..., 2])
        light += share[..., None] * (self.air_rgb + smeared)

    def _through_air(self, light: F32, view: View) -> F32:
        """Return an image seen through fog, rain or snow, by Koschmieder's law."""
        if not self.extinction:
            return light
        transmitted = np.exp(-np.float32(self.extinction) * view.distance_m)[..., None]
        return light * transmitted + self.air_rgb * (1 - transmitted)

    def _veil(self, light: F32, view: View) -> None:
        """Add the glare of a low sun ahead of the recorded drive, as far as the sun is seen, in
        place.
        """
        if self.scenario.environment.time != "low_sun":
            return
        start = interpolate(self.scenario.ego_log, self.scenario.ego_log.t_us[0])
        to_sun = start[:3, 0] + np.array([0, 0, SUN_TANGENT])
        cosine = view.rays @ (to_sun / np.linalg.norm(to_sun)).astype(np.float32)
        angle_deg = np.maximum(np.degrees(np.arccos(np.clip(cosine, -1, 1))), 1)
        in_sun = angle_deg == 1
        visible_share = (np.isinf(view.distance_m) & in_sun).sum() / max(in_sun.sum(), 1)
        light += np.float32(visible_share * VEIL_DEG2) / angle_deg[..., None] ** 2

    def _draw_falling(
        self, light: F32, illumination: F32, frame: RecordedFrame, camera: CameraSpec
    ) -> None:
        """Draw drops and flakes, keyed by scene, seed, camera and time, in place."""
        shape = camera.height, camera.width
        for kind, rate in self.falling:
            key = (self.scenario.scene_id, self.seed, f"{kind.name}.{frame.camera}", frame.t_us)
            covered = kind.covered(shape, intrinsics_on_axis(camera), rate, stream(*key))
            light += covered[..., None] * (DAY_AIR_RGB * illumination - light)


def _is_hidden(spot: Spot, view: View) -> bool:
    """Return whether something stands before a spot's middle, as far as it lies in the image."""
    local = ((spot.middle - view.place) @ view.T_world_camera[:3, :3])[None]
    pixels, can_be_seen = shown_at(view.camera, local)
    if not can_be_seen[0]:
        return False
    column, row = np.floor(pixels[0]).astype(np.int64).tolist()
    height, width = view.depth_m.shape
    if not (0 <= row < height and 0 <= column < width):
        return False
    return bool(depths_of(view.camera, local)[0] >= _farthest_m(view.depth_m[row, column]))


def _farthest_m(depth_m: F32) -> F32:
    """Return how deep a lamp is still before a surface, or on it."""
    return depth_m * np.float32(1 + SEEN_PER_M) + np.float32(SEEN_M)


def _draw_lamps(light: F32, view: View, spots: Sequence[Spot]) -> F32:
    """Draw spots that nothing hides into an image, and return their glow."""
    colours, depth = drawn(spots, view)
    visible = (depth < _farthest_m(view.depth_m)) & np.isfinite(depth)
    light[visible] = colours[visible]
    colours[~visible] = 0
    return cv2.GaussianBlur(colours, (0, 0), GLOW_WIDTHS * light.shape[1]) * np.float32(GLOW_SHARE)


def in_weather(
    renderer: Renderer,
    scenario: Scenario,
    seed: int,
    device: str = "cpu",
    threads: int | None = None,
    cameras: Sequence[CameraSpec] | None = None,
) -> Renderer:
    """Return a renderer in the weather of a scene; itself where nothing of it is seen."""
    weather_renderer = WeatherRenderer(renderer, scenario, seed, device, threads, cameras)
    return (
        renderer
        if weather_renderer.is_clear and not weather_renderer.lights.signals
        else weather_renderer
    )
