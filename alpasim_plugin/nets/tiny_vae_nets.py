"""The learned parts of the tiny autoencoder: what its encoder adds to the latent and what its decoder adds to the picture.

Layout ``(B, T, H, W, C)`` as everywhere inside the codecs. Both parts end in a layer that starts at zero, so that an untrained network adds
nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import torch
from torch import Tensor, nn

from alpasim_plugin.errors import InputError
from alpasim_plugin.nets.clips import GROUP
from alpasim_plugin.nets.frame_layers import FrameConv, Pointwise, conv_frames, halves_to_frames, run
from alpasim_plugin.nets.streaming_state import Carry
from alpasim_plugin.nets.tiny_vae_transform import CELL, COLOURS, COMPONENTS

LATENT = len(COMPONENTS)
PIXELS = CELL * COLOURS  # numbers of one grid cell of one frame
DROPPED = GROUP - 1  # frames of the first group that are not frames of the video


@dataclass(frozen=True)
class TinySizes:
    """Channels of the tiny autoencoder, by part and fraction of the resolution.

    Args:
        encoder_quarter, encoder_eighth: Encoder, once per latent.
        decoder_eighth, decoder_quarter: Decoder, once per latent.
        decoder_frame: Decoder at a quarter of the resolution, once per frame: the dearest place. Multiples of 16 use a CPU's vectors fully.
    """

    encoder_quarter: int = 64
    encoder_eighth: int = 96
    decoder_eighth: int = 96
    decoder_quarter: int = 64
    decoder_frame: int = 48

    @classmethod
    def read(cls, tensors: Mapping[str, Tensor], doing: str, source: str, do: str) -> TinySizes:
        """Read the widths off biases.

        Raises:
            InputError: One of the biases is missing.
        """
        keys = {
            "encoder_quarter": "encoder.stem.bias", "encoder_eighth": "encoder.fold.bias", "decoder_eighth": "decoder.stem.bias",
            "decoder_quarter": "decoder.quarter.bias", "decoder_frame": "decoder.mix.last.bias",
        }  # fmt: skip
        missing = [key for key in keys.values() if key not in tensors]
        if missing:
            raise InputError(doing, f"{source} ({len(tensors)} tensors)", f"missing: {', '.join(missing)}", do)
        return cls(**{field.name: tensors[keys[field.name]].numel() for field in fields(cls)})


def bend(x: Tensor) -> Tensor:
    """Apply a leaky ReLU to ``x`` itself; units that die under a plain one do not come back in a network this small."""
    return nn.functional.leaky_relu_(x, 0.1)


class Bend(nn.Module):
    """`bend` as a layer; only after layers that make a new tensor."""

    def forward(self, x: Tensor) -> Tensor:
        """Map any shape to the same."""
        return bend(x)


class Memory(nn.Module):
    """Two convolutions over a frame and the one before it, added to the frame."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = FrameConv(2 * width, width)
        self.last = FrameConv(width, width)

    def next(self, x: Tensor, carry: Carry) -> Tensor:
        """Map ``(B, T, H, W, C)`` to the same shape; before the first frame is a zero one."""
        out: Tensor = self.last(bend(self.first(torch.cat([x, carry.shift(x)], dim=-1))))
        return bend(out.add_(x))


class Fold(nn.Conv2d):
    """2x2 convolution with stride 2: four cells become one."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, 2, stride=2)

    def forward(self, input: Tensor) -> Tensor:
        """Map ``(B, T, H, W, inputs)`` to ``(B, T, H/2, W/2, outputs)``."""
        return conv_frames(input, self.weight, self.bias, stride=2)


class Unfold(Pointwise):
    """One cell becomes four; the stored bias is shared by them."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, 4 * outputs, axes=0, bias=False)
        self.bias = nn.Parameter(torch.zeros(outputs))

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(B, T, H, W, inputs)`` to ``(B, T, 2H, 2W, outputs)``."""
        b, t, rows, columns, _ = x.shape
        assert self.bias is not None
        four = torch.nn.functional.linear(x, self.weight, self.bias.repeat(4)).view(b, t, rows, columns, 2, 2, -1)
        return four.permute(0, 1, 2, 4, 3, 5, 6).reshape(b, t, 2 * rows, 2 * columns, -1)


class TinyEncoder(nn.Module):
    """Grids of 4 frames to what is added to their cosine components."""

    def __init__(self, sizes: TinySizes) -> None:
        super().__init__()
        quarter, eighth = sizes.encoder_quarter, sizes.encoder_eighth
        self.stem = FrameConv(GROUP * PIXELS, quarter)
        self.near = Memory(quarter)
        self.fold = Fold(quarter, eighth)
        self.far = nn.ModuleList([Memory(eighth), Memory(eighth)])
        self.head = FrameConv(eighth, LATENT)

    def next(self, grid: Tensor, carry: Carry) -> Tensor:
        """Map ``(B, t, H/4, W/4, 192)`` to ``(B, t, H/8, W/8, 16)``."""
        return run((self.stem, Bend(), self.near, self.fold, Bend(), *self.far, self.head), grid, carry)


class TinyPainter(nn.Module):
    """Latents, and what the render shows, to corrections of the synthesised frames."""

    def __init__(self, sizes: TinySizes) -> None:
        super().__init__()
        eighth, quarter, frame = sizes.decoder_eighth, sizes.decoder_quarter, sizes.decoder_frame
        self.stem = FrameConv(LATENT, eighth)
        self.far = nn.ModuleList([Memory(eighth), Memory(eighth)])
        self.quarter = Unfold(eighth, quarter)
        self.near = Memory(quarter)
        self.grow = Pointwise(quarter, GROUP * frame, axes=0)
        self.see_colour = Pointwise(PIXELS, frame, axes=0, bias=False)
        self.see_opacity = Pointwise(CELL, frame, axes=0, bias=False)
        self.mix = Memory(frame)
        self.head = FrameConv(frame, PIXELS + CELL)

    def next(self, z: Tensor, seen: tuple[Tensor, Tensor | None] | None, carry: Carry) -> tuple[Tensor, Tensor | None]:
        """Map latents to corrections.

        Args:
            z: ``(B, t, H/8, W/8, 16)``.
            seen: Colours of the render times its opacity ``(B, T, H/4, W/4, 48)`` and the opacity ``(B, T, H/4, W/4, 16)``, or None for 1
                everywhere; or None: no render.
            carry: The past.

        Returns:
            What to add to the frames, ``(B, T, H/4, W/4, 48)``, and the gate of the render's detail ``(B, T, H/4, W/4, 16)`` if it is seen;
            T is 4t, or 4t - 3 at the start of a video.
        """
        latent_rate = (self.stem, Bend(), *self.far, self.quarter, Bend(), self.near, self.grow)
        x = halves_to_frames(run(latent_rate, z, carry), GROUP)[:, DROPPED if carry.first else 0 :]
        if seen is not None:
            covered = self.see_opacity.weight.sum(1) if seen[1] is None else self.see_opacity(seen[1])
            x = x + self.see_colour(seen[0]) + covered
        x = self.mix.next(bend(x), carry)
        if seen is None:
            assert self.head.bias is not None
            return conv_frames(x, self.head.weight[:PIXELS], self.head.bias[:PIXELS], padding=1), None
        out = self.head(x)
        return out[..., :PIXELS], 2 * torch.sigmoid(out[..., PIXELS:])
