"""A causal generator in pixels, one frame at a time: a recurrent U-Net that predicts the clean
frame from the render.

    z_1 = m r + (1 - m) eps                          source (OneFixer, Eq. 1), m = 1 above half opacity
    z_t = (1 - t) x_0 + t z_1                        interpolant; deployed at t = 1
    x_0 = r + G(r, z_t - r, opacity, map, state)     prediction of the clean frame, from the render
    v   = (z_t - x_0) / t                            velocity; the one step z_1 - v (Eq. 2) is x_0

The state is what the generator itself made of the past: its last output, the render that this was
made from, and recurrent channels at a quarter of the resolution. The network works at 1/4, 1/8 and
1/16; a detail path at 1/2 reads render, opacity and last output again and writes the result, so
that fine texture does not pass through the U-Net. Every value of the noise in the source is a
function of rollout, camera, frame, step and pixel.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor, nn
from torch.random import fork_rng

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import derive_seed
from alpasim_plugin.core.types import F32, I64, U8
from alpasim_plugin.fixers.network.checkpoints import load_checked
from alpasim_plugin.fixers.network.finer_weights import FinerWeights
from alpasim_plugin.fixers.network.pixel_layers import (
    Conv3,
    Downsample,
    ResidualBlock,
    Upsample,
    activation,
    cells,
    pixels,
    repeat_per_pixel,
    small,
)
from alpasim_plugin.fixers.network.reference_blend import (
    CELL,
    DETAIL,
    BlendHeads,
    Operations,
    ReferenceBlend,
    blend,
    enlarge,
    gather_references,
    likeness,
    offsets,
    smaller,
)

GRID_PX = 16  # sides are multiples of it
IMAGES = 16  # render 3, opacity 1, map 3, last output 3, last render 3, source minus render 3
DETAIL_IMAGES = 7  # render 3, opacity 1, last output 3
HOLE = 0.5  # opacity below which noise enters the source
# 2^64 over the golden ratio (Steele et al., 2014, SplitMix64); here and below as signed numbers
ODD = 0x9E3779B97F4A7C15 - 2**64
MIX = ((30, 0xBF58476D1CE4E5B9 - 2**64), (27, 0x94D049BB133111EB - 2**64))
LAST = 31
CHANNELS = 3


def pixel_source(render: Tensor, opacity: Tensor, eps: Tensor) -> Tensor:
    """Return z_1 = m r + (1 - m) eps (Eq. 1) for images ``(..., C)`` and an opacity of one
    channel.

    The mask m is hardened: 1 above half opacity, falling to 0 where nothing is drawn. With m =
    opacity, noise would enter the half of an image that is nearly opaque, and a small network would
    have to take it out again.
    """
    m = (opacity / HOLE).clamp(max=1)
    return m * render + (1 - m) * eps


def sparse_source(render: Tensor, opacity: Tensor, keys: Tensor) -> Tensor:
    """Return `pixel_source` with noise that is drawn only where it has weight, on the CPU.

    Args:
        render: ``(B, H, W, 3)``.
        opacity: ``(B, H, W, 1)``.
        keys: ``(B,)`` int64, `noise_key` of each image.
    """
    source = render
    for b, alpha in enumerate(opacity[..., 0].flatten(1)):
        holes = (alpha < HOLE).nonzero()[:, 0]
        if not len(holes):
            continue
        source = source.clone() if source is render else source
        eps = torch.from_numpy(pixel_noise(int(keys[b]), holes.numpy()))
        pixels = source[b].view(-1, render.shape[-1])
        pixels[holes] = pixel_source(pixels[holes], alpha[holes, None], eps)
    return source


def dense_source(render: Tensor, opacity: Tensor, keys: Tensor) -> Tensor:
    """Return the same as `sparse_source`, with all noise drawn by the device of the images."""
    values = torch.arange(render[0].numel(), device=render.device).view(render.shape[1:])
    u, v = (
        (_mixed(counters) + 1).double() * 2.0**-53
        for counters in _counters(keys[:, None, None, None], values)
    )
    normal = torch.sqrt(-2 * torch.log(u)) * torch.cos(2 * torch.pi * v)
    return pixel_source(render, opacity, normal.float())


def noise_key(scene_id: str, seed: int, camera: str, draw: int, frame: int) -> int:
    """Return the key of a frame's noise, a signed number of 64 bits.

    Args:
        scene_id, seed, camera: Of the stream.
        draw: Flow step.
        frame: Index in the rollout, or `content_key`.
    """
    key = derive_seed(scene_id, seed, f"fixer/{camera}/{draw}", frame)
    return key - 2**64 if key >= 2**63 else key


def pixel_noise(key: int, pixels: I64) -> F32:
    """Draw standard normal values for some pixels of a frame; a pixel's values do not depend on
    which others are asked for.

    Drawing whole frames would take longer than the network: holes are about one pixel in a hundred.

    Args:
        key: See `noise_key`.
        pixels: ``(N,)`` row-major indices in the image.

    Returns:
        ``(N, 3)``.

    Example:
        >>> few, many = (pixel_noise(3, np.array(p)) for p in ([7], [5, 7]))
        >>> bool((few[0] == many[1]).all())
        True
    """
    values = pixels[:, None] * CHANNELS + np.arange(CHANNELS)
    u, v = ((_mixed(counters) + 1) * 2.0**-53 for counters in _counters(key, values))
    normal = np.sqrt(-2 * np.log(u)) * np.cos(2 * np.pi * v)  # Box and Muller, 1958
    return np.asarray(normal, dtype=np.float32)


def content_key(t_us: int, rgb: U8) -> int:
    """Return a frame's number as its content gives it: the same render at the same time has the
    same noise in every rollout.
    """
    salt = t_us.to_bytes(8, "little")
    digest = hashlib.blake2b(rgb.tobytes(), digest_size=8, salt=salt).digest()
    return int.from_bytes(digest, "little")


def _counters(key: Any, values: Any) -> tuple[Any, Any]:
    """Return the two counters of each value, arrays or tensors of int64, modulo 2^64."""
    return key + (2 * values + 1) * ODD, key + (2 * values + 2) * ODD


def _mixed(x: Any) -> Any:
    """Mix counters into numbers of 53 bits."""
    for shift, factor in MIX:
        x = (x ^ _shifted(x, shift)) * factor
    return _shifted(x ^ _shifted(x, LAST), 11)


def _shifted(x: Any, bits: int) -> Any:
    """Shift to the right; zeros come in from the left, also where the number is negative."""
    return (x >> bits) & (2 ** (64 - bits) - 1)


@dataclass(frozen=True)
class PixelSizes:
    """Sizes of the network.

    Args:
        widths: Channels at 1/4, 1/8 and 1/16.
        blocks: Residual blocks at 1/4, 1/8, 1/16, and on the way back at 1/8 and 1/4.
        detail: Channels of the detail path at 1/2.
        hidden: Recurrent channels at 1/4; 0: none.
        blend: Channels of the head that blends references with the image (`reference_blend`); 0:
            references are not read.
        finer: Channels by which they are weighed in large images (`finer_weights`); 0: they are
            weighed in the smaller image alone.
    """

    widths: tuple[int, int, int] = (48, 80, 160)
    blocks: tuple[int, int, int, int, int] = (0, 1, 1, 1, 1)
    detail: int = 16
    hidden: int = 16
    blend: int = 0
    finer: int = 0


class PixelState(NamedTuple):
    """What the generator knows of the past."""

    output: Tensor  # (B, H, W, 3) its last output, in [-1, 1]
    render: Tensor  # (B, H, W, 3) what that was made from
    hidden: Tensor  # (B, H / 4, W / 4, hidden) in (-1, 1)
    recorded: Tensor  # (B, H, W, 1) share of the references in the last output, 0 to 1


class Repaired(NamedTuple):
    """What the network made of a frame, before references are blended in."""

    image: Tensor  # (B, H, W, 3) render plus change
    hidden: Tensor  # as in `PixelState`
    heads: BlendHeads | None  # None without references


TORCH = Operations(gather_references, blend, smaller, enlarge, likeness, offsets, dense_source)


class PixelGenerator(nn.Module):
    """The network.

    Args:
        sizes: Widths and depths.

    Example:
        >>> net = PixelGenerator(PixelSizes((8, 8, 8)))
        >>> r = torch.zeros(1, 32, 48, 3)
        >>> out, state = net(r, r[..., :1] + 1, r, net.start(r))
        >>> out.shape, state.hidden.shape
        (torch.Size([1, 32, 48, 3]), torch.Size([1, 8, 12, 16]))
    """

    def __init__(self, sizes: PixelSizes = PixelSizes()) -> None:
        super().__init__()
        self.sizes = sizes
        at4, at8, at16 = sizes.widths
        depth = sizes.blocks
        self.stem = nn.Linear(CELL**2 * IMAGES + sizes.hidden, at4)
        self.mix = Conv3(at4, at4)
        self.encode4 = _blocks(at4, depth[0])
        self.down8 = Downsample(at4, at8)
        self.time = nn.Linear(2, at8, bias=False)
        self.encode8 = _blocks(at8, depth[1])
        self.down16 = Downsample(at8, at16)
        self.middle = _blocks(at16, depth[2])
        self.up8 = Upsample(at16, at8)
        self.decode8 = _blocks(at8, depth[3])
        self.up4 = Upsample(at8, at4)
        self.decode4 = _blocks(at4, depth[4])
        self.remember = nn.Linear(at4, sizes.hidden) if sizes.hidden else None
        self.up2 = Upsample(at4, sizes.detail)
        self.read = nn.Linear(DETAIL**2 * DETAIL_IMAGES, sizes.detail)
        self.refine = Conv3(sizes.detail, sizes.detail)
        self.write = small(Conv3(sizes.detail, DETAIL**2 * 3))
        repeat_per_pixel(self.write, DETAIL)
        self.blend = ReferenceBlend(at4, sizes.detail, sizes.blend) if sizes.blend else None
        self.finer = FinerWeights(sizes.finer) if sizes.finer else None
        nn.init.zeros_(self.time.weight)

    @classmethod
    def random(cls, sizes: PixelSizes, seed: int) -> Self:
        """Return an untrained network: its weights are a function of the seed, and torch's own
        random state stays as it was.
        """
        with fork_rng(devices=[]):
            torch.manual_seed(seed % 2**63)
            return cls(sizes)

    def start(self, render: Tensor) -> PixelState:
        """Return the state before a rollout: the first render ``(B, H, W, 3)`` stands for the
        past.
        """
        b, h, w, _ = render.shape
        hidden = render.new_zeros(b, h // CELL, w // CELL, self.sizes.hidden)
        return PixelState(render, render, hidden, torch.zeros_like(render[..., :1]))

    def forward(
        self,
        render: Tensor,
        opacity: Tensor,
        sdmap: Tensor,
        state: PixelState,
        source: Tensor | None = None,
        t: Tensor | None = None,
        references: Tensor | None = None,
        operations: Operations = TORCH,
    ) -> tuple[Tensor, PixelState]:
        """Predict the clean frame.

        Args:
            render: ``(B, H, W, 3)`` in [-1, 1]; sides are multiples of 16.
            opacity: ``(B, H, W, 1)``, 0 to 1.
            sdmap: ``(B, H, W, 3)`` in [-1, 1]; black (-1) where there is no map.
            state: From `start` or the last call.
            source: ``(B, H, W, 3)`` z_t; None is the render, which is z_1 where nothing is
                transparent.
            t: ``(B,)`` flow time; None is 1, the deployed step.
            references: ``(B, K, H, W, 4)`` recorded frames in this view, colour in [-1, 1] and
                where it holds, 0 to 1, or both as bytes; None: there is none. A network without a
                blending head does not read them.
            operations: For the device.

        Returns:
            ``(B, H, W, 3)`` the clean frame x_0, float32, not clipped, and the state after it.
        """
        repaired = self.repair(render, opacity, sdmap, state, source, t, references, operations)
        return blended(repaired, render, references, operations)

    def repair(
        self,
        render: Tensor,
        opacity: Tensor,
        sdmap: Tensor,
        state: PixelState,
        source: Tensor | None = None,
        t: Tensor | None = None,
        references: Tensor | None = None,
        operations: Operations = TORCH,
    ) -> Repaired:
        """Run the network up to the blend of its image with the references; see `forward`."""
        dtype = self.stem.weight.dtype
        noised = render if source is None else source
        cover = 2 * opacity - 1
        images = render, cover, sdmap, state.output, state.render, noised - render
        coarse = torch.cat([*(cells(image, CELL) for image in images), state.hidden], dim=-1)
        details = render, cover, state.output
        fine = torch.cat([cells(image, DETAIL) for image in details], dim=-1)
        stem = self.stem(coarse.to(dtype))
        detail = self.read(fine.to(dtype))
        reference_cells = None
        if self.blend is not None and references is not None:
            reference_cells = operations.gather_references(references, render)
            at4, at2 = self.blend.features(reference_cells)
            stem = stem + at4
            detail = detail + at2

        x4 = self.encode4(self.mix(activation(stem, inplace=True)))
        x8 = self.down8(activation(x4))
        if t is not None:
            times = torch.stack([1 - t, (1 - t).square()], dim=-1).to(dtype)
            x8 = x8 + self.time(times)[:, None, None]
        x8 = self.encode8(x8)
        y = self.middle(self.down16(activation(x8)))
        y = self.decode8(self.up8(y).add_(x8))
        y = activation(self.decode4(self.up4(y).add_(x4)), inplace=True)
        hidden = state.hidden if self.remember is None else torch.tanh(self.remember(y)).float()
        fine = activation(detail.add_(self.up2(y)), inplace=True)
        fine = activation(self.refine(fine), inplace=True)

        change = pixels(self.write(fine), DETAIL).float()
        heads = None
        if self.blend is not None and reference_cells is not None:
            heads = self.blend(y, fine, reference_cells, operations)
        return Repaired(render + change, hidden, heads)

    @classmethod
    def from_state_dict(cls, tensors: Mapping[str, Tensor], source: str = "weights") -> Self:
        """Build the network that a state dict fits; sizes are read off the tensors.

        Raises:
            InputError: Tensors that are missing, unknown, of another shape or not finite.
        """
        net = cls(_sizes_of(tensors, source))
        load_checked(net, tensors, source)
        return net

    @property
    def facts(self) -> dict[str, object]:
        """Sizes as plain values."""
        return asdict(self.sizes)


def blended(
    repaired: Repaired, render: Tensor, references: Tensor | None, operations: Operations
) -> tuple[Tensor, PixelState]:
    """Blend what the network made of a render with the references; see `PixelGenerator.forward`."""
    out = repaired.image
    recorded = torch.zeros_like(render[..., :1])
    if repaired.heads is not None and references is not None:
        out, recorded = operations.blend(out, references, repaired.heads)
    return out, PixelState(out.clamp(-1, 1), render, repaired.hidden, recorded)


def _blocks(channels: int, count: int) -> nn.Sequential:
    return nn.Sequential(*(ResidualBlock(channels) for _ in range(count)))


def _sizes_of(tensors: Mapping[str, Tensor], source: str) -> PixelSizes:
    def width(key: str) -> int:
        if key not in tensors or tensors[key].ndim < 2:
            raise InputError(
                f"{source}: no kernel {key}", "give the weights of a generator in pixels"
            )
        return int(tensors[key].shape[0])

    def depth(stage: str) -> int:
        return len({key.split(".")[1] for key in tensors if key.startswith(f"{stage}.")})

    stages = ("encode4", "encode8", "middle", "decode8", "decode4")
    return PixelSizes(
        (width("stem.weight"), width("down8.weight"), width("down16.weight")),
        tuple(depth(stage) for stage in stages),  # type: ignore[arg-type]
        width("refine.weight"),
        width("remember.weight") if "remember.weight" in tensors else 0,
        width("blend.head.weight") if "blend.head.weight" in tensors else 0,
        width("finer.first.weight") if "finer.first.weight" in tensors else 0,
    )
