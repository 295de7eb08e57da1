"""Reference implementation of the streaming fixer: a whole clip at once in float32, nothing
streamed, cached, folded or reused.

Every block sees all blocks before it in one forward pass under the block-causal mask, so the cost
grows with the square of the clip.
"""

from dataclasses import dataclass

import numpy as np
import torch

from alpasim_plugin.block_fixers.clips import to_clip, to_images
from alpasim_plugin.block_fixers.networks import LATENT, decode, load_networks
from alpasim_plugin.block_fixers.onefixer import latent_noise
from alpasim_plugin.block_fixers.pipeline import condition_of, map_video
from alpasim_plugin.block_fixers.sampling import (
    context_level,
    flow_step,
    mixed_source,
    opacity_mask,
)
from alpasim_plugin.core.interfaces import BlockRule
from alpasim_plugin.core.types import F32, I64, U8, Frame
from alpasim_plugin.fixers.network.schedule import from_names, interpolant
from alpasim_plugin.fixers.views import group_views


@dataclass(frozen=True)
class Clip:
    """Frames of one camera with their semantic maps, the input of a fixer in a rollout.

    Attributes:
        camera: Its name.
        t_us: ``(T,)`` int64 microseconds.
        rgb: ``(T, H, W, 3)`` uint8 sRGB.
        alpha: ``(T, H, W)`` float32 opacity, 0 to 1.
        maps: ``(T, H, W, 3)`` uint8 semantic maps.
    """

    camera: str
    t_us: I64
    rgb: U8
    alpha: F32
    maps: U8

    @classmethod
    def of(cls, frames, maps):
        """Stack frames of one camera and their maps; a frame without opacity counts as opaque."""
        alpha = [
            np.ones(frame.rgb.shape[:2], dtype=np.float32) if frame.alpha is None else frame.alpha
            for frame in frames
        ]
        times = np.array([frame.t_us for frame in frames], dtype=np.int64)
        return cls(
            frames[0].camera,
            times,
            np.stack([frame.rgb for frame in frames]),
            np.stack(alpha),
            np.stack(maps),
        )

    def first(self, count):
        """Return the first frames."""
        return Clip(
            self.camera, self.t_us[:count], self.rgb[:count], self.alpha[:count], self.maps[:count]
        )

    def frames(self):
        """Return the frames."""
        rows = zip(self.t_us, self.rgb, self.alpha, strict=True)
        return [Frame(int(t_us), self.camera, rgb, alpha) for t_us, rgb, alpha in rows]

    def blocks(self, rule):
        """Yield whole blocks of frames with their maps; frames at the end that fill no block are
        left out.
        """
        frames = self.frames()
        start = 0
        index = 0
        while start + rule(index) <= len(frames):
            end = start + rule(index)
            yield frames[start:end], list(self.maps[start:end])
            start = end
            index = index + 1


def refine_latents(
    networks,
    settings,
    z_render,
    mask,
    condition,
    noise,
):
    """Fix the latents of a whole clip.

    Args:
        networks: In float32, not folded.
        settings: Steps, history, window, block length.
        z_render: ``(B, 16, T, h, w)``.
        condition: ``(B, channels, T, h, w)``, from `condition_of`.
        mask: ``(B, 1, T, h, w)``, ``m`` of Eq. 1.
        noise: Draws like ``z_render``.

    Returns:
        ``(B, 16, T, h, w)`` clean latents.
    """
    schedule = from_names(settings.steps)
    n = settings.block_latents
    clean = z_render[:, :, :0]
    past = z_render[:, :, :0]
    past_t = torch.zeros(1, 0)
    for start in range(0, z_render.shape[2], n):
        own = slice(start, start + n)
        sources = [
            mixed_source(z_render[:, :, own], mask[:, :, own], eps[:, :, own]) for eps in noise
        ]  # Eq. 1
        x = sources[0]
        for i, level in enumerate(schedule):
            given = torch.cat([past, x], dim=2)
            t = torch.cat([past_t, torch.full((1, x.shape[2]), level.t)], dim=1)
            v = networks.dit(
                given,
                t,
                networks.text,
                condition[:, :, : start + n],
                block_latents=n,
                window=settings.window,
                sink=settings.sink,
            )
            z_0 = flow_step(x, v[:, :, start:], level.sigma)  # Eq. 2
            if i + 1 < len(schedule):
                x = interpolant(z_0, sources[i + 1], schedule[i + 1].sigma)
        if settings.history == "finalise":
            level = context_level()
            x = interpolant(z_0, noise[-1][:, :, own], level.sigma)
        clean = torch.cat([clean, z_0], dim=2)
        past = torch.cat([past, x], dim=2)
        past_t = torch.cat([past_t, torch.full((1, x.shape[2]), level.t)], dim=1)
    return clean


@torch.inference_mode()
def refine_clip(
    networks,
    settings,
    rgb,
    alpha,
    sdmap,
    noise,
):
    """Fix a whole clip; arguments as `BlockPipeline.run`, for all frames.

    Returns:
        ``(B, 3, T, H, W)``, not clipped to [-1, 1].
    """
    z_render = networks.vae.encode(rgb)
    shown = map_video(settings, rgb, sdmap)
    z_map = torch.zeros_like(z_render) if shown is None else networks.vae.encode(shown)
    mask = {
        "noise": opacity_mask(alpha, first=True),
        "render": torch.ones_like(z_render[:, :1]),
        "everywhere": torch.zeros_like(z_render[:, :1]),
    }[settings.holes]
    condition = condition_of(settings, z_map, z_render, alpha, first=True)
    clean = refine_latents(networks, settings, z_render, mask, condition, noise)
    return decode(networks, settings, clean, rgb, alpha)[0]


def whole_clip(settings, clip, scene_id, seed):
    """Fix a clip as a streaming fixer with these settings and this key would in exact arithmetic.

    Args:
        settings: Their precision is set to float32.
        clip: Any number of frames of one camera; the last block is padded.
        scene_id, seed: Key of the noise.

    Returns:
        ``(T, H, W, 3)`` uint8.
    """
    exact = settings.model_copy(
        update={"precision": "fp32", "codec_precision": "fp32", "fold": False}
    )
    networks = load_networks(exact)
    rule = BlockRule.of_latents(settings.block_latents)
    frames = clip.frames()
    due = rule.first + -(-max(0, len(frames) - rule.first) // rule.then) * rule.then
    (views,) = group_views(frames, list(clip.maps) if settings.uses_map else (), due)
    video = to_clip(views, due)
    latents = 1 + -(-(due - 1) // 4)
    draws = len(settings.steps) + settings.finalises
    shape = (LATENT, video.rgb.shape[3] // 8, video.rgb.shape[4] // 8)
    noise = latent_noise(scene_id, seed, views.cameras, draws, range(latents), shape)
    fixed = refine_clip(networks, settings, video.rgb, video.alpha, video.maps, noise)
    images = to_images(fixed, views.size)[0]
    return images
