"""Reference implementations of the image and window sessions: a whole clip at once in float32, as
the equations are written.

Nothing is streamed, batched by camera, cropped early or left undecoded. Images are padded
to multiples of 16 like the sessions'.
"""

import numpy as np
import torch

from alpasim_plugin.block_fixers.clips import SIDE, crop_clip, pad_clip, to_clip, to_images
from alpasim_plugin.block_fixers.clips import TOKEN_PX as TOKEN
from alpasim_plugin.block_fixers.networks import LATENT, decode, load_networks
from alpasim_plugin.block_fixers.onefixer import latent_noise
from alpasim_plugin.fixers.views import HALF, group_views
from alpasim_plugin.lab.image_fixers.settings import (
    NoiseWindowSettings,
)
from alpasim_plugin.lab.image_fixers.window_fixer import fade_weights, windows


@torch.inference_mode()
def whole_clip_images(
    settings,
    frames,
    scene_id,
    seed,
):
    """Fix a clip of one camera as the session of these settings would in exact arithmetic.

    Args:
        settings: Their precision is set to float32.
        frames: Oldest first, of one camera.
        scene_id, seed: Key of the noise.

    Returns:
        ``(T, H, W, 3)`` uint8.
    """
    exact = settings.model_copy(update={"precision": "fp32", "codec_precision": "fp32"})
    networks = load_networks(exact)
    (views,) = group_views(frames, (), len(frames))
    clip = to_clip(
        views,
        max(len(frames), exact.window_frames if isinstance(exact, NoiseWindowSettings) else 1),
    )
    if isinstance(exact, NoiseWindowSettings):
        noise = _window_noise(exact, views.cameras, clip, scene_id, seed)
        video = _in_windows(networks, exact, clip, noise)
    else:
        video = _one_by_one(networks, exact, clip, views.size)
    images = to_images(video, views.size)[0]
    return images


def _one_by_one(networks, settings, clip, size):
    """x = z_r / (alpha + sigma), z_0 = x - t v(x, t), over the clip [render, last outputs] where
    there are enough outputs.
    """
    alpha, sigma = settings.render_level.alpha, settings.render_level.sigma
    t = sigma / (alpha + sigma)
    shown = []
    made = []
    for i in range(clip.rgb.shape[2]):
        rgb = clip.rgb[:, :, i : i + 1]
        video = (
            torch.cat([rgb, *shown[-1 : -settings.references - 1 : -1]], dim=2)
            if len(shown) >= settings.references
            else rgb
        )
        x = networks.vae.encode(video) / (alpha + sigma)
        z_0 = x - t * networks.dit(
            x, float(round(1000 * t)), networks.text, torch.zeros_like(x), block_latents=None
        )
        repeated = torch.cat(
            [rgb] * video.shape[2], dim=2
        )  # a decoder that sees the render is only asked for the first frame
        made.append(
            decode(
                networks, settings, z_0, repeated, _opacity(settings, clip, [i] * video.shape[2])
            )[0][:, :, :1]
        )
        eight_bits = (crop_clip(made[-1], size).clamp(-1, 1) + 1).mul(HALF).round() / HALF - 1
        shown.append(pad_clip(eight_bits, group=1, side=TOKEN)[0])
    return torch.cat(made, dim=2)


def _in_windows(networks, settings, clip, noise):
    """Sum over windows of weight times the window's frames; z <- z - v / n, n times, in each."""
    frames = clip.rgb.shape[2]
    parts = windows(frames, settings.window_frames, settings.stride_frames)
    weights = torch.from_numpy(fade_weights(parts, settings.fade_frames))
    out = torch.zeros_like(clip.rgb)
    for window, eps, weight in zip(parts, noise, weights, strict=True):
        here = slice(window.start, window.stop)
        z, z_r = eps, networks.vae.encode(clip.rgb[:, :, here])
        for t, after in zip(settings.steps, (*settings.steps[1:], 0.0), strict=True):
            z = z - (t - after) / 1000 * networks.dit(z, t, networks.text, z_r, block_latents=None)
        made = decode(
            networks, settings, z, clip.rgb[:, :, here], _opacity(settings, clip, window)
        )[0]
        out[:, :, here] += weight[here, None, None] * made
    return out


def _window_noise(settings, cameras, clip, scene_id, seed):
    shape, n = (LATENT, clip.rgb.shape[3] // SIDE, clip.rgb.shape[4] // SIDE), settings.latents
    count = len(windows(clip.rgb.shape[2], settings.window_frames, settings.stride_frames))
    starts = np.zeros(count, int) if settings.noise == "fixed" else np.arange(count) * n
    return [
        latent_noise(scene_id, seed, cameras, 1, range(int(i), int(i) + n), shape)[0]
        for i in starts
    ]


def _opacity(settings, clip, frames):
    return (
        clip.alpha[:, :, list(frames)]
        if settings.opacity_to_decoder and clip.alpha is not None
        else None
    )
