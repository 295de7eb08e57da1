"""The cuboid judge: vehicles as boxes in space from one frame, after CenterNet (Zhou et al., 2019,
"Objects as Points").

Every cell of 4x4 pixels holds the logit of a vehicle's middle, its place in the cell, the logarithm
of its depth at a focal length of one image width, the logarithms of its sizes relative to a car's,
the angle under which it is seen, and its class.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.core.types import F32, F64
from alpasim_plugin.lab.learned_metrics.nets.layers import ResidualPair
from alpasim_plugin.lab.learned_metrics.types import Cuboid

CLASSES = ("car", "truck", "bus")
STRIDE = 4
TYPICAL_M = (4.6, 1.6, 1.9)  # length, height, width
OUTPUTS = 1 + 2 + 1 + 3 + 2 + len(CLASSES)
REST_LOGIT = -4.6  # of a middle, before training: one cell in a hundred
MOST = 32  # boxes a frame


class CuboidNet(nn.Module):
    """Cells with middles of vehicles.

    Example:
        >>> CuboidNet()(torch.zeros(1, 3, 144, 256)).shape
        torch.Size([1, 12, 36, 64])
    """

    def __init__(self, widths: tuple[int, int, int, int] = (16, 32, 64, 96)) -> None:
        super().__init__()
        one, two, three, four = widths
        self.stem = nn.Conv2d(3, one, 4, 2, 1)
        self.down = nn.ModuleList(
            [nn.Conv2d(a, b, 3, 2, 1) for a, b in ((one, two), (two, three), (three, four))]
        )
        self.body = nn.ModuleList([nn.Sequential(), ResidualPair(three), ResidualPair(four)])
        self.up = nn.ModuleList([nn.Conv2d(four, three, 1), nn.Conv2d(three, two, 1)])
        self.merge = ResidualPair(two)
        self.head = nn.Sequential(
            nn.GroupNorm(4, two),
            nn.Conv2d(two, 64, 1),
            nn.LeakyReLU(0.1),
            nn.Conv2d(64, OUTPUTS, 1),
        )

    def rest(self) -> None:
        """Let the untrained network see no vehicle."""
        with torch.no_grad():
            last = self.head[3]
            assert isinstance(last, nn.Conv2d)
            assert last.bias is not None
            last.weight.mul_(0.1)
            last.bias[0] = REST_LOGIT

    def forward(self, image: Tensor) -> Tensor:
        """Map ``(B, 3, H, W)`` in [-1, 1], sides multiples of 16, to ``(B, 12, H / 4, W / 4)``."""
        x, levels = F.leaky_relu(self.stem(image), 0.1), []
        for down, body in zip(self.down, self.body, strict=True):
            x = body(F.leaky_relu(down(x), 0.1))
            levels.append(x)
        for up, level in zip(self.up, levels[-2::-1], strict=True):
            x = level + F.interpolate(
                up(x), size=level.shape[2:], mode="bilinear", align_corners=False
            )
        out: Tensor = self.head(self.merge(x))
        return out


def encode(cuboid: Cuboid, K: F64, width: int) -> tuple[float, float, F64] | None:
    """Return column and row of a vehicle's middle in cells, and the 7 regressed numbers; None
    behind the camera.

    The inverse of `decode`.
    """
    if cuboid.z_m <= 0:
        return None
    u, v = (
        (K[0, 0] * cuboid.x_m / cuboid.z_m + K[0, 2]) / STRIDE,
        (K[1, 1] * cuboid.y_m / cuboid.z_m + K[1, 2]) / STRIDE,
    )
    seen_rad = cuboid.yaw_rad - np.arctan2(cuboid.x_m, cuboid.z_m)
    sizes = np.log(np.array([cuboid.length_m, cuboid.height_m, cuboid.width_m]) / TYPICAL_M)
    numbers = [
        np.log(cuboid.z_m * width / K[0, 0]) - LOG_DEPTH,
        *sizes,
        np.sin(seen_rad),
        np.cos(seen_rad),
    ]
    return float(u), float(v), np.array([CLASSES.index(cuboid.label), *numbers])


LOG_DEPTH = float(np.log(30.0))  # of the middle of the range


def decode(cells: F32, K: F64, width: int, least_score: float) -> list[Cuboid]:
    """Return the vehicles in one frame's cells ``(12, h, w)``, the surest first.

    A middle is a cell that is the surest among its neighbours.

    Args:
        cells: As `CuboidNet` gives them.
        K: Of the image that it saw, pixels.
        width: Of that image, pixels.
        least_score: Least probability.
    """
    heat = 1 / (1 + np.exp(-cells[0].astype(np.float64)))
    padded = np.pad(heat, 1)
    around = np.max(
        [padded[i : i + heat.shape[0], j : j + heat.shape[1]] for i in range(3) for j in range(3)],
        axis=0,
    )
    rows, columns = np.nonzero((heat >= around) & (heat >= least_score))
    best = np.argsort(-heat[rows, columns], kind="stable")[:MOST]
    out = []
    for row, column in zip(rows[best], columns[best], strict=True):
        at = cells[:, row, column].astype(np.float64)
        u, v = (column + at[1]) * STRIDE, (row + at[2]) * STRIDE
        z = float(np.exp(np.clip(at[3], -3.0, 2.0) + LOG_DEPTH) * K[0, 0] / width)
        x, y = (u - K[0, 2]) * z / K[0, 0], (v - K[1, 2]) * z / K[1, 1]
        length, height, wide = (
            float(s) for s in np.array(TYPICAL_M) * np.exp(np.clip(at[4:7], -2.0, 2.0))
        )
        yaw = float(np.arctan2(at[7], at[8]) + np.arctan2(x, z))
        label = CLASSES[int(np.argmax(at[9:]))]
        out.append(
            Cuboid(
                label, float(heat[row, column]), float(x), float(y), z, length, height, wide, yaw
            )
        )
    return out
