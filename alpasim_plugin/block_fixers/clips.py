"""Valid clip sizes of video autoencoders (1 + 4k frames, sides in multiples of 8), and padding to
them.

Padding is explicit: `pad_clip` repeats the last frame and the right and bottom edges, and returns
the size to crop to after decoding.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.core.devices import upload
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F32, U8
from alpasim_plugin.fixers.views import HALF, ClipSize, Views

GROUP = 4  # temporal compression: frames of every latent but the first
DROPPED = GROUP - 1  # frames of the first group that stand for the first frame again
SIDE = 8  # spatial compression: pixels per latent along a side
TOKEN_PX = 16  # side of a token


def frame_counts(latents: Sequence[int], first: bool) -> list[int]:
    """Return how many frames each pass has; the first latent of a video holds one frame.

    Example:
        >>> frame_counts([2, 1], first=True), frame_counts([2, 1], first=False)
        ([5, 4], [8, 4])
    """
    counts = [GROUP * count for count in latents]
    counts[0] -= DROPPED * first
    return counts


def whole_groups(video: Tensor, first: bool) -> Tensor:
    """Repeat the first frame of a video ``(B, C, T, H, W)`` that starts here three times before it,
    since the first latent covers it alone.
    """
    if not first:
        return video
    return torch.cat([video[:, :, :1].expand(-1, -1, DROPPED, -1, -1), video], dim=2)


def pad_clip(video: Tensor, group: int = GROUP, side: int = SIDE) -> tuple[Tensor, ClipSize]:
    """Pad a clip to a valid size by repeating the last frame, row and column.

    Args:
        video: ``(B, C, T, H, W)``, T at least 1.
        group: Frames of a latent after the first.
        side: Pixels that height and width must be a multiple of (16 for a network that works on 2x2
            latents).

    Returns:
        The padded clip and the size to crop to (`crop_clip`).
    """
    size = ClipSize(*video.shape[2:])
    extra = (-size.width % side, -size.height % side, (1 - size.frames) % group)
    if any(extra):
        video = F.pad(video, (0, extra[0], 0, extra[1], 0, extra[2]), mode="replicate")
    return video, size


def crop_clip(video: Tensor, size: ClipSize) -> Tensor:
    """Return the top left ``size`` of ``(B, C, T, H, W)``; undoes `pad_clip`."""
    return video[:, :, : size.frames, : size.height, : size.width]


def check_video(name: str, x: Tensor, channels: int, side: int = 1) -> None:
    """Refuse other tensors than ``(B, channels, T, H, W)`` floating point, none of the sizes zero,
    height and width multiples of ``side``.

    Raises:
        InputError: Another shape or dtype.
    """
    fits = x.ndim == 5 and x.shape[1] == channels and x.is_floating_point() and 0 not in x.shape
    if not fits or x.shape[3] % side or x.shape[4] % side:
        raise InputError(
            f"{name}: shape {list(x.shape)} of {x.dtype}",
            f"give (batch, {channels}, time, height, width) of floats, sides in multiples of {side}",
        )


def check_frames(name: str, video: Tensor, channels: int, first: bool) -> None:
    """Refuse clips that a codec cannot divide into latents.

    Args:
        name: Of the video, for the error.
        video: Meant to be ``(B, channels, T, H, W)``, sides in multiples of 8.
        channels: How many.
        first: Whether these frames start the video (1 + 4k) or continue it (4k).

    Raises:
        InputError: Another shape or dtype.
    """
    check_video(name, video, channels, SIDE)
    if (video.shape[2] - first) % GROUP:
        raise InputError(
            f"{name}: {video.shape[2]} frames",
            f"give {'1 + ' if first else ''}{GROUP}k frames; pad_clip repeats the last",
        )


@dataclass(frozen=True)
class Clip:
    """One block as the networks take it, padded in time and space."""

    rgb: Tensor  # (B, 3, T, H, W) in [-1, 1]
    alpha: Tensor  # (B, 1, T, H, W), 0 to 1
    maps: Tensor | None  # (B, 3, T, H, W) in [-1, 1]


def to_clip(views: Views, frames_due: int, device: torch.device | str = "cpu") -> Clip:
    """Convert views to tensors: ``x / 127.5 - 1``, the last frame repeated up to ``frames_due``,
    edges padded to multiples of 16.
    """

    def video(images: U8 | F32) -> Tensor:
        x = upload(images, device).float()
        x = x if images.dtype == np.float32 else x.div_(HALF).sub_(1)
        x = x.permute(0, 4, 1, 2, 3)
        short = frames_due - x.shape[2]
        if short:
            x = torch.cat([x, x[:, :, -1:].expand(-1, -1, short, -1, -1)], dim=2)
        return pad_clip(x, group=1, side=TOKEN_PX)[0]

    alpha = np.ones(views.rgb.shape[:-1], dtype=np.float32) if views.alpha is None else views.alpha
    maps = None if views.maps is None else video(views.maps)
    return Clip(video(views.rgb), video(alpha[..., None]), maps)


def to_images(video: Tensor, size: ClipSize) -> U8:
    """Crop ``(B, 3, T, H, W)`` in [-1, 1] and round it to images ``(B, T, H, W, 3)``; values are
    clipped to the range.
    """
    levels = crop_clip(video, size).float().clamp(-1, 1).add_(1).mul_(HALF).round_()
    return levels.to(torch.uint8).permute(0, 2, 3, 4, 1).contiguous().cpu().numpy()
