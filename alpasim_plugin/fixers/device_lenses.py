"""Join the planes of the pinholes that cover a lens on the device that drew them: what `cameras.lens`
does with arrays.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import zip_longest
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.cameras.lens import NOT_HELD, Lens
from alpasim_plugin.core.devices import upload

LEAST = 1e-6  # weight by which is divided where no pinhole shows the lens


def joined_planes(sides: Sequence[Lens], planes: Sequence[Any]) -> Any:
    """Return the `DevicePlanes` of a lens, with references, from those of its pinholes; depth is 0
    everywhere.
    """
    rgb = joined_tensor(sides, [part.rgb for part in planes])
    alpha = joined_tensor(sides, [part.alpha[..., None] for part in planes], 1)[..., 0]
    carried = [() if part.references is None else part.references for part in planes]
    nothing = rgb.new_zeros((1, 1, 4))
    references = [
        joined_tensor(sides, images, holds=True)
        for images in zip_longest(*carried, fillvalue=nothing)
    ]
    return replace(
        planes[0],
        rgb=rgb,
        alpha=alpha,
        depth=torch.zeros_like(alpha),
        pairs=torch.stack([part.pairs for part in planes]).amax(),
        again=lambda: joined_planes(sides, [part.again() for part in planes]),
        references=torch.stack(references) if references else None,
    )


def joined_tensor(
    sides: Sequence[Lens], images: Sequence[Tensor], outside: int = 0, holds: bool = False
) -> Tensor:
    """Return the lens's image of those of its pinholes ``(h, w, C)``; see `cameras.lens.joined_image`."""
    first = images[0]
    shape = sides[0].height, sides[0].width
    total = torch.zeros((*shape, first.shape[-1]), device=first.device)
    weight_sum = torch.zeros((*shape, 1), device=first.device)
    for side, image in zip(sides, images, strict=True):
        place, weight = _uploaded(side, first.device)
        channels = image.permute(2, 0, 1)[None].float()
        sampled = F.grid_sample(channels, place, padding_mode="border", align_corners=False)
        sampled = sampled[0].permute(1, 2, 0)
        share = weight * (sampled[..., -1:] + float(NOT_HELD)) if holds else weight
        total[side.part] += share * sampled
        weight_sum[side.part] += share
    mean = torch.where(weight_sum > 0, total / weight_sum.clamp(min=LEAST), outside)
    return mean if first.is_floating_point() else mean.round().to(first.dtype)


@lru_cache(maxsize=64)
def _uploaded(side: Lens, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return where a pinhole's image is looked up, from -1 to 1 across it, ``(1, h, w, 2)``, and
    with which weight ``(h, w, 1)``.
    """
    assert side.resample is not None, "a pinhole that covers a lens"
    place = (2 * side.resample + 1) / np.array(side.cover, dtype=np.float32) - 1
    weight = np.ones(place.shape[:2], dtype=np.float32)
    if side.weight is not None:
        weight = side.weight
    elif side.visible is not None:
        weight = side.visible.astype(np.float32)
    return upload(place[None], device), upload(weight[..., None], device)
