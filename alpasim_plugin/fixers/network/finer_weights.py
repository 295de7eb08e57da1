"""How references are weighed once more in large images, where the network of the generator in
pixels sees images some times smaller and no line finer than its own pixels.

    e_k = (x_k - m_k) v_k u_k                  what reference k shows beyond the others' mean m_k, where both hold
    f_k = C (a e_k, a |e_k|, a d_k, ...)       d_k: what it shows beyond the image; all at 1/4 of the full size
    w_k <- w_k + f_k                           the logarithm of its weight (`reference_blend`)

Two recorded frames that agree with one another and not with the render are most likely right, and a
frame that agrees with neither is misplaced: plane-sweeping stereo's photo-consistency (Collins,
1996), learned.
"""

import torch
from torch import Tensor, nn

from alpasim_plugin.fixers.network.pixel_layers import Conv3, activation, pixels
from alpasim_plugin.fixers.network.reference_blend import DETAIL, FINER_PX, HALF, in_floats

CONTRAST = 4.0  # by which differences of colour are multiplied
MOST = 6.0  # of a logarithm that is read
FEATURES = 12


class FinerWeights(nn.Module):
    """Weigh each reference by what it shows beyond the image and beyond the other references.

    Args:
        width: Channels.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = Conv3(FEATURES, width)
        self.second = Conv3(width, width)
        self.write = Conv3(width, 1)
        for part in (self.write.weight, self.write.bias):
            assert part is not None
            nn.init.zeros_(part)

    def forward(
        self, render: Tensor, references: Tensor, change: Tensor, weight: Tensor, scale: int
    ) -> Tensor:
        """Return what is added to the logarithms of the references' weights, ``(B, K, h, w)``
        float32, of cells of `FINER_PX` pixels.

        Args:
            render: ``(B, h, w, 3)`` uint8, `FINER_PX` times smaller than the image.
            references: ``(B, K, h, w, 4)`` uint8, likewise.
            change: ``(B, H, W, 3)`` of a range of 2, of the image ``scale`` times smaller.
            weight: See `BlendHeads`, likewise.
            scale: How many times.
        """
        h, w = render.shape[1:3]
        rows, columns = (
            (torch.arange(size, device=render.device) * FINER_PX + FINER_PX // 2) // scale
            for size in (h, w)
        )
        b, k = weight.shape[:2]
        coarse_weight = pixels(weight.flatten(0, 1).float(), DETAIL)
        coarse_weight = coarse_weight.reshape(b, k, *coarse_weight.shape[1:])
        coarse_weight = coarse_weight[:, :, rows][:, :, :, columns]
        reference_planes = in_floats(references)
        colours, holds = reference_planes[..., :3], reference_planes[..., 3:]
        image = (render / HALF - 1 + change[:, rows][:, :, columns])[:, None]
        around = holds.sum(dim=1, keepdim=True) - holds
        mean = ((holds * colours).sum(dim=1, keepdim=True) - holds * colours) / around.clamp(
            min=1e-3
        )
        others = around.clamp(max=1)
        beyond = (
            (colours - image) * holds,
            (colours - mean) * holds * others,
            (mean - image) * others,
        )
        from_image, apart, far = (CONTRAST * part for part in beyond)
        sizes = [part.abs().mean(dim=-1, keepdim=True) for part in (from_image, apart, far)]
        coarse_weight = coarse_weight.clamp(-MOST, MOST) / 3
        features = torch.cat(
            [from_image, sizes[0], apart, sizes[1], sizes[2], holds, others, coarse_weight], dim=-1
        )
        x = features.flatten(0, 1).to(self.first.weight.dtype)
        for layer in (self.first, self.second):
            x = activation(layer(x), inplace=True)
        return self.write(x)[..., 0].float().reshape(b, k, h, w)
