"""How the generator in pixels uses references: recorded frames that were warped into the view
(`alpasim_plugin.fixers.references`).

    s_k       = act(y + C_k)                                        C_k: what reference k shows beyond the render, at 1/4; y: the U-Net
    m_k(p, q) = <Q y(p), N s_k(p + q)>, |q| <= 2 cells              how alike the image here and the reference there are
                                                                    (cost volume; Sun et al., 2018,
                                                                    PWC-Net, Sec. 3)
    a_k       = A (s_k, m_k)
    f_k       = act(H (fine + E_k + U a_k))                         E_k: the same at 1/2; fine: the detail path
    w, d, c   = W f_k                                               weight of each pixel, offset of each cell, correction of each pixel
    o_k       = 8 px tanh (D a_k + d)                               a misplaced reference is seen at 1/4, its edges at 1/2
    x_k       = ref_k(p + o_k) + c                                  the reference, moved by a learned offset
    p_0..p_K  = softmax(0, w_k + log v_k(p + o_k))                  v_k: where reference k holds
    x         = p_0 (render + residual) + sum_k p_k x_k

All references share one set of weights, so their number and order are free; without any, p_0 is 1
and the generator is the one without references. A warp that is wrong costs nothing where the
network gives it no weight.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.fixers.network.pixel_layers import (
    Conv3,
    Upsample,
    activation,
    cells,
    pixels,
)

CELL = 4  # pixels of a cell's side in the U-Net
DETAIL = 2  # the same in the detail path
FINER_PX = 4  # pixels of the side of a cell in which large images are weighed
HALF = 127.5  # grey levels from 0 to 1 on the scale of [-1, 1]
# of a reference: colour minus that of the render where the reference holds, and where it holds
CHANNELS = 4
OFFSET_PX = 8.0  # largest learned offset
SMALL_OFFSET_PX = 0.6  # of a smaller image: within it, an offset is no better known than none
USUAL_SCALE = 2  # up to which a network weighs references in a smaller image as in the whole one
NOWHERE = 1e-6  # the share of a pixel that holds, at least, so that its logarithm is finite
MATCH_CELLS = 2  # how far a reference is compared with the image, in cells
MATCH_CHANNELS = 16  # of the features compared
DOUBT = -2.5  # initial logarithm of a reference's weight over that of the render


class ReferenceCells(NamedTuple):
    """What references show beyond the render, ``(ref - render) v`` and ``v``, as `cells`;
    float32.
    """

    mean4: Tensor  # (B, H / 4, W / 4, 64) the mean over the references
    mean2: Tensor  # (B, H / 2, W / 2, 16)
    each4: Tensor  # (B K, H / 4, W / 4, 64)
    each2: Tensor  # (B K, H / 2, W / 2, 16)


class BlendHeads(NamedTuple):
    """How references enter the image, at half its resolution; offsets in float32."""

    # (B, K, H / 2, W / 2, 4) logarithm of each pixel's weight over that of the repaired render,
    # `cells` of one channel
    weight: Tensor
    offset_px: Tensor  # (B, K, H / 2, W / 2, 2) x and y of where it is looked up
    # (B, K, H / 2, W / 2, 12) what is added to its colour, `cells` of three channels
    correction: Tensor
    # (B, K, H / 4, W / 4) what is added to the logarithms, of a large image; see `finer_weights`
    finer: Tensor | None = None


@dataclass(frozen=True)
class Operations:
    """What the generator computes besides its layers; one implementation per kind of device.

    `pixel_generator.TORCH` runs on any device and has gradients; `alpasim_plugin.fixers.gather.CPU`
    is the same to rounding, fused for processors.

    Attributes:
        gather_references: See `gather_references`.
        blend: See `blend`.
        smaller: See `smaller`.
        enlarge: See `enlarge`.
        likeness: See `likeness`.
        offsets: See `offsets`.
        source: Fill what is transparent with noise; see `pixel_generator.sparse_source`.
    """

    gather_references: Callable[[Tensor, Tensor], ReferenceCells]
    blend: Callable[[Tensor, Tensor, BlendHeads], tuple[Tensor, Tensor]]
    smaller: Callable[[Tensor, int], Tensor]
    enlarge: Callable[[Tensor, Tensor, Tensor | None, BlendHeads | None, int], Tensor]
    likeness: Callable[[Tensor, Tensor], Tensor]
    offsets: Callable[[Tensor, Tensor], Tensor]
    source: Callable[[Tensor, Tensor, Tensor], Tensor]


class ReferenceBlend(nn.Module):
    """Read references; `mix` then blends them with the generator's own image.

    Args:
        coarse: Channels of the generator at 1/4.
        detail: Channels of its detail path.
        width: Channels of the blending head.
    """

    def __init__(self, coarse: int, detail: int, width: int) -> None:
        super().__init__()
        self.stem = nn.Linear(CELL**2 * CHANNELS, coarse, bias=False)
        self.read = nn.Linear(DETAIL**2 * CHANNELS, detail, bias=False)
        self.coarse = nn.Linear(CELL**2 * CHANNELS, coarse)
        self.sought = nn.Linear(coarse, MATCH_CHANNELS, bias=False)
        self.shown = Conv3(coarse, MATCH_CHANNELS)
        self.match = nn.Linear((2 * MATCH_CELLS + 1) ** 2, width, bias=False)
        self.align = nn.ModuleList([Conv3(coarse, width), Conv3(width, width)])
        self.shift = nn.Linear(width, 2)
        self.up = Upsample(width, detail)
        self.own = nn.Linear(DETAIL**2 * CHANNELS, detail)
        self.head = Conv3(detail, width)
        self.write = nn.Linear(width, DETAIL**2 + 2 + DETAIL**2 * 3)
        for layer in (self.stem, self.read, self.match, self.shift, self.up, self.write):
            nn.init.zeros_(layer.weight)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
        assert self.write.bias is not None
        with torch.no_grad():
            self.write.bias[: DETAIL**2] = DOUBT

    def features(self, cells: ReferenceCells) -> tuple[Tensor, Tensor]:
        """Return what the references add to the first layers: ``(B, H / 4, W / 4, coarse)`` and
        ``(B, H / 2, W / 2, detail)``.
        """
        dtype = self.stem.weight.dtype
        return self.stem(cells.mean4.to(dtype)), self.read(cells.mean2.to(dtype))

    def forward(
        self, y: Tensor, fine: Tensor, cells: ReferenceCells, operations: Operations
    ) -> BlendHeads:
        """Return how every reference enters the image.

        Args:
            y: ``(B, H / 4, W / 4, coarse)`` the U-Net's features.
            fine: ``(B, H / 2, W / 2, detail)`` the detail path's features.
            cells: What the references show.
            operations: For the device.
        """
        b = y.shape[0]
        k = cells.each4.shape[0] // b
        side = activation(_add_to_each(self.coarse(cells.each4.to(y.dtype)), y), inplace=True)
        alike = operations.likeness(self.sought(y), self.shown(side))
        at4 = activation(self.align[0](side) + self.match(alike), inplace=True)
        at4 = activation(self.align[1](at4), inplace=True)
        joined = _add_to_each(self.own(cells.each2.to(fine.dtype)).add_(self.up(at4)), fine)
        features = activation(self.head(activation(joined, inplace=True)), inplace=True)
        heads = self.write(features).unflatten(0, (b, k))
        weight, offset, correction = heads.split([DETAIL**2, 2, DETAIL**2 * 3], dim=-1)
        moved = operations.offsets(offset.flatten(0, 1), self.shift(at4))
        return BlendHeads(weight, moved.view(offset.shape), correction)


def likeness(sought: Tensor, candidates: Tensor) -> Tensor:
    """Compare features with those of the cells around, the mean of products over channels.

    Args:
        sought: ``(B, h, w, C)``.
        candidates: ``(B K, h, w, C)`` K references of each; beyond the border nothing is alike.

    Returns:
        ``(B K, h, w, (2 MATCH_CELLS + 1)^2)`` by row and column of the other cell.
    """
    h, w = sought.shape[1:3]
    reach = 2 * MATCH_CELLS + 1
    around = F.pad(candidates, (0, 0, MATCH_CELLS, MATCH_CELLS, MATCH_CELLS, MATCH_CELLS))
    each = sought[:, None].expand(-1, len(candidates) // len(sought), -1, -1, -1).flatten(0, 1)
    # The mean as a product: a sum over few channels is slow on a CPU.
    mean = sought.new_full((sought.shape[-1], 1), 1 / sought.shape[-1])
    return torch.cat(
        [
            (each * around[:, i : i + h, j : j + w]) @ mean
            for i in range(reach)
            for j in range(reach)
        ],
        dim=-1,
    )


def offsets(at2: Tensor, at4: Tensor) -> Tensor:
    """Return the offsets ``(N, H / 2, W / 2, 2)`` in pixels that are given at half the resolution
    and, coarser, at a quarter of it.
    """
    finer = F.interpolate(
        at4.float().permute(0, 3, 1, 2), scale_factor=2, mode="bilinear", align_corners=False
    )
    return torch.tanh(at2.float() + finer.permute(0, 2, 3, 1)) * OFFSET_PX


def enlarged(heads: BlendHeads, scale: int) -> BlendHeads:
    """Return what a network that saw images ``scale`` times smaller says of the whole ones.

    Errors of an offset grow with the image and bend its lines, so offsets are shortened by
    `SMALL_OFFSET_PX`, down to none. The blur of a render is not seen in a smaller image, so
    references weigh more, the more the smaller it was; at half the size the network is right. What
    it adds to the colour of a thin line is as blurred as its image, and tints the line, so it counts
    for less.
    """
    length = heads.offset_px.norm(dim=-1, keepdim=True)
    kept = 1 - SMALL_OFFSET_PX / length.clamp(min=SMALL_OFFSET_PX)
    smaller_by = max(scale / USUAL_SCALE, 1.0)
    return BlendHeads(
        heads.weight + math.log(smaller_by),
        heads.offset_px * kept,
        heads.correction / smaller_by,
    )


class Sources(NamedTuple):
    """What an image is blended of: the generator's own, then each reference."""

    colour: Tensor  # (B, 1 + K, H, W, 3)
    logit: Tensor  # (B, 1 + K, H, W, 1) their softmax over the sources is the blend
    holds: Tensor  # (B, 1 + K, H, W, 1) where each holds, above 0 to 1


def sources_of(repaired: Tensor, references: Tensor, heads: BlendHeads, scale: int = 1) -> Sources:
    """Return what the image is blended of.

    Args:
        repaired: ``(B, H, W, 3)`` render plus change, in [-1, 1].
        references: ``(B, K, H, W, 4)`` colour in [-1, 1], and where it holds, 0 to 1.
        heads: Of the same, or of images ``scale`` times smaller, whose last rows and columns may lie
            beyond; they are then interpolated, and offsets are as much longer.
        scale: How many times.
    """
    b, k, h, w, _ = references.shape
    weight, offset_px, correction = (part.flatten(0, 1) for part in heads[:3])
    weight, correction = (
        larger(pixels(part, DETAIL).to(repaired.dtype), scale)[:, :h, :w]
        for part in (weight, correction)
    )
    moved = _sampled(references.flatten(0, 1), scale * offset_px, scale * DETAIL)
    colour = (moved[..., :3] + correction).view(b, k, h, w, 3)
    holds = moved[..., 3:].clamp(min=NOWHERE, max=1)
    if heads.finer is not None:
        weight = weight + larger(heads.finer.flatten(0, 1)[..., None], FINER_PX)[:, :h, :w]
    logit = (weight + holds.log()).view(b, k, h, w, 1)
    image_logit = torch.zeros_like(logit[:, :1])
    return Sources(
        torch.cat([repaired[:, None], colour], dim=1),
        torch.cat([image_logit, logit], dim=1),
        torch.cat([image_logit + 1, holds.view(b, k, h, w, 1)], dim=1),
    )


def in_floats(references: Tensor) -> Tensor:
    """Return references of bytes ``(..., 4)`` as the network reads them: colour in [-1, 1], and
    where it holds, 0 to 1; those of floats unchanged.
    """
    if references.dtype != torch.uint8:
        return references
    return torch.cat([references[..., :3] / HALF - 1, references[..., 3:] / (2 * HALF)], dim=-1)


def in_bytes(image: Tensor) -> Tensor:
    """Convert images in [-1, 1] to bytes; what is not a number is black."""
    levels = (image * HALF).add_(HALF).round_().clamp_(0, 255)
    return levels.nan_to_num_(0.0).to(torch.uint8)


def smaller(x: Tensor, scale: int) -> Tensor:
    """Average images ``(..., H, W, C)``, of bytes or floats, over squares of ``scale`` pixels; the
    last row and column go on up to whole squares.
    """
    if scale == 1:
        return x
    height, width = x.shape[-3:-1]
    planes = x.flatten(0, -4).permute(0, 3, 1, 2).float()
    whole = F.pad(planes, (0, -width % scale, 0, -height % scale), mode="replicate")
    mean = F.avg_pool2d(whole, scale).permute(0, 2, 3, 1).unflatten(0, x.shape[:-3])  # type: ignore[no-untyped-call]
    return mean if x.is_floating_point() else mean.round().to(x.dtype)


def larger(x: Tensor, scale: int) -> Tensor:
    """Enlarge images ``(B, H, W, C)`` bilinearly, a whole number of times."""
    if scale == 1:
        return x
    return F.interpolate(
        x.permute(0, 3, 1, 2), scale_factor=scale, mode="bilinear", align_corners=False
    ).permute(0, 2, 3, 1)


def blend(
    repaired: Tensor, references: Tensor, heads: BlendHeads, scale: int = 1
) -> tuple[Tensor, Tensor]:
    """Blend the generator's own image with its references; arguments as of `sources_of`,
    references also as bytes.

    Returns:
        ``(B, H, W, 3)`` float32, and ``(B, H, W, 1)`` the weight of all references together.
    """
    return mix(sources_of(repaired, in_floats(references), heads, scale))


def enlarge(
    rgb: Tensor,
    change: Tensor,
    references: Tensor | None,
    heads: BlendHeads | None,
    scale: int,
) -> Tensor:
    """Return large images as a network that saw smaller ones would have them: its change of the
    render and the heads of the references are interpolated, and render and references are blended
    at their own size (joint upsampling; Kopf et al., 2007).

    Args:
        rgb: ``(B, H, W, 3)`` uint8, the render.
        change: ``(B, h, w, 3)`` of the image ``scale`` times smaller, of a range of 2; its last
            rows and columns may lie beyond the large one.
        references: ``(B, K, H, W, 4)`` uint8; None: there is none.
        heads: Of the smaller images, see `enlarged`; None: there is none.
        scale: How many times.

    Returns:
        ``(B, H, W, 3)`` uint8.
    """
    height, width = rgb.shape[1:3]
    image = rgb / HALF - 1 + larger(change, scale)[:, :height, :width]
    if references is not None and heads is not None:
        image, _ = blend(image, references, heads, scale)
    return in_bytes(image)


def mix(sources: Sources) -> tuple[Tensor, Tensor]:
    """Blend the sources of an image; see `blend`."""
    shares = sources.logit.softmax(dim=1)
    return (shares * sources.colour).sum(dim=1), 1 - shares[:, 0]


def gather_references(references: Tensor, render: Tensor) -> ReferenceCells:
    """Put what the network reads of references side by side.

    Args:
        references: ``(B, K, H, W, 4)`` colour in [-1, 1], and where it holds v, 0 to 1; or the same
            as bytes.
        render: ``(B, H, W, 3)`` in [-1, 1].
    """
    planes = in_floats(references)
    holds = planes[..., 3:]
    each = torch.cat([(planes[..., :3] - render[:, None]) * holds, holds], dim=-1)
    mean, flat = each.mean(dim=1), each.flatten(0, 1)
    return ReferenceCells(
        cells(mean, CELL), cells(mean, DETAIL), cells(flat, CELL), cells(flat, DETAIL)
    )


def _add_to_each(each: Tensor, image: Tensor) -> Tensor:
    """Add an image ``(B, ...)`` to each of K: ``(B K, ...)``, in place."""
    parts = each.view(image.shape[0], -1, *image.shape[1:])
    return parts.add_(image[:, None]).flatten(0, 1)


def _sampled(images: Tensor, offset: Tensor, side: int = DETAIL) -> Tensor:
    """Look images ``(N, H, W, 4)`` up at offsets in their pixels, x and y, of cells of ``side``
    pixels; beyond the border the outermost go on.
    """
    h, w = images.shape[1:3]
    full = larger(offset, side)[:, :h, :w]
    columns = torch.arange(w, device=images.device) + 0.5
    rows = torch.arange(h, device=images.device)[:, None] + 0.5
    grid = torch.stack(
        [(columns + full[..., 0]) * (2 / w) - 1, (rows + full[..., 1]) * (2 / h) - 1], dim=-1
    )
    sampled = F.grid_sample(
        images.permute(0, 3, 1, 2),
        grid,
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )
    return sampled.permute(0, 2, 3, 1)
