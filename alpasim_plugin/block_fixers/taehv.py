"""The tiny decoder for Wan latents (TAEHV, LightTAE): 2D convolutions with one past frame.

Three stages, each: three memory blocks, spatial upsampling by 2, temporal upsampling by 1, 2 and 2.
A latent becomes 4 frames, and the first three frames of a video are dropped so that the first
latent is 1 frame, as in the Wan autoencoder.

Two families of weights share the graph. TAEHV's own Wan weights take the normalised latent;
LightTAE's take the de-normalised one (``scaled=True``). The tensors do not show which; the wrong
choice gives a washed-out image, so the caller must state it.

Source: madebyollin/taehv ``taehv.py``; ModelTC/LightX2V ``vae_tiny.py`` for the scaling.
"""

from collections.abc import Mapping, Sequence
from typing import Self

import torch
from torch import Tensor, nn

from alpasim_plugin.block_fixers.clips import DROPPED, check_video
from alpasim_plugin.block_fixers.codec_weights import (
    LatentStats,
    fill_random,
    first_axes,
)
from alpasim_plugin.block_fixers.streaming import (
    FrameConv,
    PointwiseConv,
    State,
    StreamingDecoder,
    StreamingState,
    UpsampleConv,
    channels_first,
    channels_last,
    channels_to_frames,
    run_layers,
)
from alpasim_plugin.fixers.network.checkpoints import clean, load_checked, unwrap

GROWTH = (1, 2, 2)  # temporal upsampling factor of each stage
COLOURS = 3
STAGE = 6  # entries of one stage: three memory blocks, upsampling, growth, convolution
FIRST = 3  # entry of the first stage
DO = "give the state dict of TAEHV or LightTAE for Wan 2.1 (keys decoder.*)"


class SoftClamp(nn.Module):
    """Keep latents within (-3, 3)."""

    def forward(self, x: Tensor) -> Tensor:
        """Map any shape to the same."""
        return 3 * torch.tanh(x / 3)


class TemporalUpsample(nn.Module):
    """Upsample in time by ``growth`` with a 1x1 convolution (TGrow)."""

    def __init__(self, width: int, growth: int) -> None:
        super().__init__()
        self.growth = growth
        self.conv = PointwiseConv(width, growth * width, axes=2, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(B, T, H, W, C)`` to ``(B, growth * T, H, W, C)``."""
        return channels_to_frames(self.conv(x), self.growth)


class MemBlock(nn.Module):
    """Residual block of three convolutions over a frame and its predecessor."""

    def __init__(self, width: int) -> None:
        super().__init__()
        convs = [FrameConv(inputs, width) for inputs in (2 * width, width, width)]
        self.conv = nn.ModuleList(
            [convs[0], nn.ReLU(inplace=True), convs[1], nn.ReLU(inplace=True), convs[2]]
        )

    def next(self, x: Tensor, streaming: StreamingState) -> Tensor:
        """Map ``(B, T, H, W, C)`` to the same shape; the first frame's predecessor is zero."""
        out = run_layers(self.conv, torch.cat([x, streaming.shift(x)], dim=-1), streaming)
        return out.add_(x).relu_()


class TinyDecoder(StreamingDecoder):
    """Decode normalised Wan latents with a small network; weights are frozen, gradients with
    respect to the input flow.

    Args:
        latent: Channels of the latent.
        widths: Channels after the first convolution and after each of the three stages.
        scaled: Whether the weights expect the de-normalised latent (LightTAE).

    Example:
        >>> decoder = TinyDecoder.random(16, (8, 8, 4, 4))
        >>> tuple(decoder(torch.zeros(1, 16, 3, 2, 4)).shape)
        (1, 3, 9, 16, 32)
    """

    def __init__(self, latent: int, widths: Sequence[int], scaled: bool = False) -> None:
        super().__init__()
        self.latent = latent
        layers: list[nn.Module] = [SoftClamp(), FrameConv(latent, widths[0]), nn.ReLU(inplace=True)]
        for inputs, outputs, growth in zip(widths[:-1], widths[1:], GROWTH, strict=True):
            layers += [MemBlock(inputs) for _ in range(3)]
            # The original repeats pixels at the first of these positions. Temporal upsampling is
            # pointwise, so repeating after it is equal at a quarter of the cost.
            layers += [
                nn.Identity(),
                TemporalUpsample(inputs, growth),
                UpsampleConv(inputs, outputs, bias=False),
            ]
        self.decoder = nn.ModuleList(
            [*layers, nn.ReLU(inplace=True), FrameConv(widths[-1], COLOURS)]
        )
        self.stats = LatentStats() if scaled else None
        self.eval().requires_grad_(False)

    @classmethod
    def from_state_dict(
        cls,
        sd: Mapping[str, Tensor],
        scaled: bool = False,
        *,
        source: str = "a state dict",
    ) -> Self:
        """Build the decoder that ``sd`` holds, at whatever widths it has (256, 128, 64, 64 as
        published).

        Args:
            sd: Original keys, alone or under ``model`` or ``state_dict``; ``encoder.*`` is ignored.
                Of a temporal upsampling layer with more rows than needed, the last ones are used.
            scaled: True for LightTAE, whose weights expect ``z * std + mean``.
            source: Where ``sd`` comes from, for messages.

        Raises:
            InputError: Missing, unexpected, mis-shaped or transposed keys.
        """
        tensors = {
            key: value
            for key, value in clean(unwrap(sd, source)).items()
            if not key.startswith("encoder.")
        }
        first_convs = [
            f"decoder.{FIRST + STAGE * stage}.conv.0.bias" for stage in range(len(GROWTH))
        ]
        stem = "decoder.1.weight"
        last = f"decoder.{FIRST + STAGE * len(GROWTH) - 1}.weight"
        *widths, _ = first_axes(tensors, [*first_convs, last, stem], source, DO)
        with torch.device("meta"):
            net = cls(tensors[stem].shape[1], widths, scaled)
        for stage, growth in enumerate(GROWTH):
            key = f"decoder.{FIRST + STAGE * stage + 4}.conv.weight"
            if key in tensors and tensors[key].ndim == 4:
                tensors[key] = tensors[key][-growth * widths[stage] :]
        load_checked(net, tensors, source, DO)
        return net

    @classmethod
    def random(
        cls, latent: int, widths: Sequence[int], scaled: bool = False, seed: int = 0
    ) -> Self:
        """Build an untrained decoder, for tests and timing."""
        with torch.device("meta"):
            net = cls(latent, widths, scaled)
        fill_random(net, seed, "taehv")
        return net

    def decode_next(
        self, z: Tensor, state: State | None, *, clamp: bool = True
    ) -> tuple[Tensor, State]:
        """Decode the next latents of a stream; a pure function.

        Args:
            z: ``(B, 16, m, h, w)``, any m.
            state: State after the previous call, None at the start of the video.
            clamp: Whether to cut the result to [-1, 1].

        Returns:
            Frames ``(B, 3, n, 8h, 8w)``, n = 4m, or 1 + 4 (m - 1) at the start; and the state for
            the next call.

        Raises:
            InputError: Another shape.
        """
        check_video("latents", z, self.latent)
        video, state = self.decode_in_passes(self._pass, z, state)
        return (video.clamp(0, 1) if clamp else video) * 2 - 1, state

    def _pass(self, state: State | None, z: Tensor) -> tuple[Tensor, State]:
        streaming = StreamingState(state)
        frames = run_layers(
            self.decoder,
            channels_last(z if self.stats is None else self.stats.denormalise(z)),
            streaming,
        )
        return channels_first(frames[:, DROPPED if streaming.first else 0 :]), streaming.state

    forward = StreamingDecoder.decode
