"""Layers of the Wan 2.1 video autoencoder, with its parameter names and shapes.

Inside, a video is ``(B, T, H, W, C)``. Every layer is causal in time. The first frame of a video is
special in the two layers that change the frame rate: it passes unchanged, and later frames are
processed in groups.

Source: Wan 2.1 ``wan/modules/vae.py`` (graph, keys, cache rules).
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.block_fixers.streaming import (
    DownsampleConv,
    PointwiseConv,
    StreamingState,
    UpsampleConv,
    channels_to_frames,
    conv_frames,
    run_layers,
)

ENCODER_TIME = (False, True, True)  # which of the three halvings also halve the frame rate
DECODER_TIME = (True, True, False)
DO = "give the state dict of a Wan 2.1 VAE or LightVAE (keys encoder.*, decoder.*, conv1.*, conv2.*, no prefix)"
TAPS = 3  # of every temporal kernel: the frame and its two predecessors


def causal_conv(joined: Tensor, weight: Tensor, bias: Tensor, frames: int) -> Tensor:
    """Convolve the last ``frames`` of ``joined`` in space and time.

    The three temporal taps are 2D convolutions that are summed: on a CPU up to six times faster than
    one 3D convolution on the small frames of the inner stages. Taps that would only see frames
    before the video are skipped.

    Args:
        joined: ``(B, k + frames, H, W, C)`` with k <= 2 past frames; missing ones are zero.
        weight: ``(O, C, 3, kh, kw)``, odd kernel sides, zero padding in space.
        bias: ``(O,)``.
        frames: Frames of the result.

    Returns:
        ``(B, frames, H, W, O)``.
    """
    past = joined.shape[1] - frames
    pad = weight.shape[-1] // 2
    out = conv_frames(joined[:, past:], weight[:, :, -1], bias, padding=pad)
    for back in range(1, TAPS):
        start = max(0, back - past)  # first output frame that has a frame ``back`` steps before it
        if start < frames:
            inputs = joined[:, past + start - back : past + frames - back]
            out[:, start:] += conv_frames(inputs, weight[:, :, -1 - back], None, padding=pad)
    return out


class CausalConv(nn.Module):
    """3x3x3 or 3x1x1 convolution over a frame and its two predecessors."""

    def __init__(self, inputs: int, outputs: int, side: int = 3) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(outputs, inputs, TAPS, side, side))
        self.bias = nn.Parameter(torch.zeros(outputs))

    def next(self, x: Tensor, streaming: StreamingState) -> Tensor:
        """Map ``(B, T, H, W, inputs)`` to ``(B, T, H, W, outputs)``."""
        return causal_conv(streaming.extend(x, TAPS - 1), self.weight, self.bias, x.shape[1])


class TemporalDownsampleConv(nn.Module):
    """3x1x1 convolution with stride 2 in time: each output sees two frames and their
    predecessor.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(width, width, TAPS, 1, 1))
        self.bias = nn.Parameter(torch.zeros(width))

    def next(self, x: Tensor, streaming: StreamingState) -> Tensor:
        """Halve the frames of ``(B, T, H, W, C)``; the first frame of a video passes unchanged and
        is the predecessor of the second.
        """
        joined = streaming.extend(x, 1)
        taps = self.weight.flatten(2).unbind(2)
        inputs = [joined[:, back : joined.shape[1] - (TAPS - 1) + back : 2] for back in range(TAPS)]
        out = (
            F.linear(inputs[0], taps[0], self.bias)
            + F.linear(inputs[1], taps[1])
            + F.linear(inputs[2], taps[2])
        )
        return torch.cat([x[:, :1], out], dim=1) if streaming.first else out


class ChannelNorm(nn.Module):
    """Scale every pixel's channel vector to length sqrt(C), then by a learned gain; in float32.

    Args:
        width: Channels C.
        axes: Trailing axes of the stored gain: 3 in video layers, 2 in the attention layer.
    """

    def __init__(self, width: int, axes: int = 3) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width, *(1,) * axes))

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(..., C)`` to the same shape and dtype; a zero vector stays zero."""
        wide = x.float()
        length = torch.linalg.vector_norm(wide, dim=-1, keepdim=True).clamp_min(1e-12)
        gain = self.gamma.flatten().float() * math.sqrt(x.shape[-1])
        return (wide / length * gain).to(x.dtype)


class ResidualBlock(nn.Module):
    """Norm, SiLU, convolution, twice, added to the input (through a 1x1x1 convolution if the width
    changes).
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        # Position 5 is a dropout in the checkpoint's numbering.
        self.residual = nn.ModuleList(
            [
                ChannelNorm(inputs),
                nn.SiLU(),
                CausalConv(inputs, outputs),
                ChannelNorm(outputs),
                nn.SiLU(),
                nn.Identity(),
                CausalConv(outputs, outputs),
            ]
        )
        self.shortcut = (
            PointwiseConv(inputs, outputs, axes=3) if inputs != outputs else nn.Identity()
        )

    def next(self, x: Tensor, streaming: StreamingState) -> Tensor:
        """Map ``(B, T, H, W, inputs)`` to ``(B, T, H, W, outputs)``."""
        return run_layers(self.residual, x, streaming) + self.shortcut(x)


class FrameAttention(nn.Module):
    """Residual single-head self-attention among the pixels of each frame."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = ChannelNorm(width, axes=2)
        self.to_qkv = PointwiseConv(width, 3 * width, axes=2)
        self.proj = PointwiseConv(width, width, axes=2)

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(B, T, H, W, C)`` to the same shape."""
        pixels = self.norm(x).flatten(0, 1).flatten(1, 2)[:, None]  # (B * T, one head, H * W, C)
        q, k, v = self.to_qkv(pixels).chunk(3, dim=-1)
        return x + self.proj(F.scaled_dot_product_attention(q, k, v)).view(x.shape)


class Downsample(nn.Module):
    """Downsample by 2 in space and, with ``time``, in time."""

    def __init__(self, width: int, time: bool) -> None:
        super().__init__()
        # Position 0 is the padding
        self.resample = nn.ModuleList([nn.Identity(), DownsampleConv(width, width)])
        self.time_conv = TemporalDownsampleConv(width) if time else None

    def next(self, x: Tensor, streaming: StreamingState) -> Tensor:
        """Map ``(B, T, H, W, C)`` to ``(B, T', H/2, W/2, C)``: T' = T, or T/2 not counting a first
        frame.
        """
        x = run_layers(self.resample, x, streaming)
        return x if self.time_conv is None else self.time_conv.next(x, streaming)


class Upsample(nn.Module):
    """Upsample by 2 in space, after upsampling by 2 in time with ``time``, and change the channels.

    Temporal upsampling is a causal convolution to twice the channels, whose halves become
    consecutive frames. The first latent of a video skips it; the padding of that convolution is
    zero and follows the first latent.
    """

    def __init__(self, inputs: int, outputs: int, time: bool) -> None:
        super().__init__()
        # Position 0 is the repetition of pixels
        self.resample = nn.ModuleList([nn.Identity(), UpsampleConv(inputs, outputs)])
        self.time_conv = CausalConv(inputs, 2 * inputs, side=1) if time else None

    def next(self, x: Tensor, streaming: StreamingState) -> Tensor:
        """Map ``(B, T, H, W, inputs)`` to ``(B, T', 2H, 2W, outputs)``: T' = T, or 2T not counting
        a first latent.
        """
        if self.time_conv is not None:
            first = 1 if streaming.first else 0
            alone = x[:, :first]
            following = x[:, first:]
            if following.shape[1]:
                following = channels_to_frames(self.time_conv.next(following, streaming), 2)
            else:
                # Only the first latent: cache an empty history, so that the slot exists
                streaming.extend(following, TAPS - 1)
            x = torch.cat([alone, following], dim=1)
        return run_layers(self.resample, x, streaming)
