"""Small detectors of vehicles and of lane lines, which answer as `lab.video_metrics.detectors` says and
can be exported by TorchScript.

Both shrink the image to a focal length of `FOCAL_PX`, in which they were trained.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

# The camera of the drawn test scenes
FOCAL_PX = 166.8  # at 256 pixels across
HEIGHT_M = 1.5  # over the ground
PITCH = math.radians(4.0)  # by which it looks down
STRIDE = 4  # pixels of a cell of the boxes' grid
FIELDS = 10  # of a cell: score, middle (2), depth, size (3), twice the direction (2)
# and, in training, whether it has a box
MOST_BOXES = 40
LEAST_SCORE = 0.05
DEPTH_M = 20.0  # depths are predicted as logarithms of shares of it
SIZE_M = (4.5, 1.6, 1.9)  # of a car: length, height, width
FIRST_M = 3.0  # of the rows of the lanes' grid, ahead
ROW_M = 2.0
ROWS = 29
COLUMN_M = 0.5
COLUMNS = 49  # 12 m to either side
GATE_M = 0.8  # from where a lane is expected in the next row
LONGEST_GAP = 3  # rows
FEWEST_ROWS = 5


def conv(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """Return a convolution with its normalisation and activation."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.GroupNorm(8, outputs), nn.SiLU()
    )


def head(inputs: int, outputs: int, score: float) -> nn.Conv2d:
    """Return a last layer whose first output, the logit of a score, begins at ``score``."""
    layer = nn.Conv2d(inputs, outputs, 1)
    bias = torch.zeros(outputs)
    bias[0] = score
    layer.bias = nn.Parameter(bias)
    return layer


class CuboidNet(nn.Module):
    """Vehicles as points: a score in every cell of a grid, and there the box.

    The network sees where each pixel looks, so that the height in the image tells the distance.
    """

    def __init__(self) -> None:
        super().__init__()
        self.stride = STRIDE  # TorchScript sees attributes, and no constants of a module
        self.most = MOST_BOXES
        self.least = LEAST_SCORE
        self.depth_m = DEPTH_M
        self.length_m, self.height_m, self.width_m = SIZE_M
        self.enter = nn.Sequential(conv(5, 16, 2), conv(16, 32, 2), conv(32, 32))
        self.down = nn.Sequential(conv(32, 64, 2), conv(64, 64))
        self.deep = nn.Sequential(conv(64, 96, 2), conv(96, 96), conv(96, 96))
        self.up = nn.ModuleList([conv(96 + 64, 64), conv(64 + 32, 48)])
        self.out = head(48, FIELDS, -4.0)

    def cells(self, images: Tensor, K: Tensor) -> Tensor:
        """Return what the cells say, ``(B, 10, H/4, W/4)``.

        Args:
            images: ``(B, 3, H, W)`` RGB, 0 to 1; sides are multiples of 16.
            K: ``(3, 3)`` in their pixels.
        """
        batch, _, height, width = images.shape
        rows = (torch.arange(height, device=images.device) + 0.5 - K[1, 2]) / K[1, 1]
        columns = (torch.arange(width, device=images.device) + 0.5 - K[0, 2]) / K[0, 0]
        rays = torch.stack(
            [columns[None].expand(height, width), rows[:, None].expand(height, width)]
        )
        fine = self.enter(torch.cat([images - 0.5, rays[None].expand(batch, 2, height, width)], 1))
        middle = self.down(fine)
        coarse = self.deep(middle)
        for i, layer in enumerate(self.up):
            beside = middle if i == 0 else fine
            larger = F.interpolate(coarse, size=beside.shape[-2:], mode="nearest")
            coarse = layer(torch.cat([larger, beside], 1))
        cells: Tensor = self.out(coarse)
        return cells

    def forward(self, image: Tensor, K: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return boxes ``(N, 7)``, scores ``(N,)`` and labels ``(N,)`` of an image ``(3, H, W)``."""
        small, K = shrunk(image, K)
        cells = self.cells(small, K)[0]
        scores = torch.sigmoid(cells[0])
        highest = F.max_pool2d(scores[None, None], 3, 1, 1)[0, 0]
        peaks = torch.where(scores == highest, scores, torch.zeros_like(scores)).flatten()
        count = min(self.most, peaks.numel())
        best, index = torch.topk(peaks, count)
        chosen = best >= self.least
        best, index = best[chosen], index[chosen]
        width = cells.shape[2]
        fields = cells.flatten(1)[:, index]
        u = ((index % width).to(fields.dtype) + 0.5 + fields[1]) * self.stride
        v = (
            torch.div(index, width, rounding_mode="floor").to(fields.dtype) + 0.5 + fields[2]
        ) * self.stride
        z = self.depth_m * torch.exp(fields[3].clamp(-4.0, 3.0))
        size = torch.exp(fields[4:7].clamp(-2.0, 2.0))
        # Front and back are not told apart: a box covers the same pixels
        yaw = torch.atan2(fields[7], fields[8]) / 2.0 + torch.atan2(
            (u - K[0, 2]) / K[0, 0], torch.ones_like(u)
        )
        boxes = torch.stack(
            [
                (u - K[0, 2]) / K[0, 0] * z,
                (v - K[1, 2]) / K[1, 1] * z,
                z,
                self.length_m * size[0],
                self.height_m * size[1],
                self.width_m * size[2],
                yaw,
            ],
            1,
        )
        return boxes, best, torch.zeros_like(index)


class LaneNet(nn.Module):
    """Lane lines on a grid of the ground before the camera, linked from row to row.

    Args:
        height_m: Of the camera over the ground.
        pitch: By which it looks down, radians.
    """

    def __init__(self, height_m: float, pitch: float) -> None:
        super().__init__()
        self.first_m = FIRST_M  # TorchScript sees attributes, and no constants of a module
        self.row_m = ROW_M
        self.rows = ROWS
        self.column_m = COLUMN_M
        self.columns = COLUMNS
        self.gate_m = GATE_M
        self.longest_gap = LONGEST_GAP
        self.fewest_rows = FEWEST_ROWS
        self.height_m = height_m
        self.pitch = pitch
        self.image = nn.Sequential(conv(3, 16), conv(16, 24, 2), conv(24, 24))
        self.ground = nn.Sequential(
            conv(25, 48), conv(48, 48), conv(48, 48), conv(48, 48), conv(48, 48)
        )
        self.out = head(48, 3, -2.0)

    def cells(self, images: Tensor, K: Tensor) -> Tensor:
        """Return score, offset in columns and slope of a line in every cell, ``(B, 3, 29, 49)``.

        Args:
            images: ``(B, 3, H, W)`` RGB, 0 to 1.
            K: ``(3, 3)`` in their pixels.
        """
        height, width = images.shape[2], images.shape[3]
        ahead = self.first_m + self.row_m * torch.arange(self.rows, device=images.device)
        lateral = self.column_m * (
            torch.arange(self.columns, device=images.device) - self.columns // 2
        )
        y = ahead[:, None].expand(self.rows, self.columns)
        x = lateral[None].expand(self.rows, self.columns)
        sine = math.sin(self.pitch)
        cosine = math.cos(self.pitch)
        depth = y * cosine + self.height_m * sine
        below = self.height_m * cosine - y * sine
        u = K[0, 0] * x / depth + K[0, 2]
        v = K[1, 1] * below / depth + K[1, 2]
        grid = torch.stack([2.0 * u / width - 1.0, 2.0 * v / height - 1.0], -1)
        inside = ((grid.abs() <= 1.0).all(-1)).to(images.dtype)
        features = self.image(images - 0.5)
        ground = F.grid_sample(
            features,
            grid[None].expand(images.shape[0], self.rows, self.columns, 2),
            align_corners=False,
        )
        is_inside = inside[None, None].expand(images.shape[0], 1, self.rows, self.columns)
        cells: Tensor = self.out(self.ground(torch.cat([ground, is_inside], 1)))
        return cells

    def forward(self, image: Tensor, K: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return points ``(N, 29, 3)``, visible ``(N, 29)`` and scores ``(N,)`` of an image ``(3, H, W)``."""
        small, K = shrunk(image, K)
        cells = self.cells(small, K)[0].cpu()
        scores = torch.sigmoid(cells[0])
        highest = F.max_pool2d(scores[None, None], (1, 3), 1, (0, 1))[0, 0]
        peaks = (scores == highest) & (scores >= 0.5)
        # Of every lane that is followed: its last row, position and slope
        rows: list[int] = []
        lasts: list[float] = []
        slopes: list[float] = []
        points = torch.zeros(0, self.rows, 3)
        visible = torch.zeros(0, self.rows)
        for row in range(self.rows):
            taken: list[int] = []
            columns: list[int] = torch.nonzero(peaks[row]).flatten().tolist()
            for column in columns:
                x = self.column_m * (column - self.columns // 2 + float(cells[1, row, column]))
                slope = float(cells[2, row, column])
                nearest = -1
                least = self.gate_m
                for lane in range(len(rows)):
                    gap = row - rows[lane]
                    if gap < 1 or gap > self.longest_gap or lane in taken:
                        continue
                    distance = abs(x - lasts[lane] - slopes[lane] * self.row_m * gap)
                    if distance < least:
                        least = distance
                        nearest = lane
                if nearest < 0:
                    nearest = len(rows)
                    rows.append(row)
                    lasts.append(x)
                    slopes.append(slope)
                    points = torch.cat([points, torch.zeros(1, self.rows, 3)])
                    visible = torch.cat([visible, torch.zeros(1, self.rows)])
                taken.append(nearest)
                rows[nearest], lasts[nearest], slopes[nearest] = row, x, slope
                points[nearest, row, 0] = x
                visible[nearest, row] = float(scores[row, column])
        points[:, :, 1] = self.first_m + self.row_m * torch.arange(self.rows)
        count = (visible > 0.0).sum(1)
        long_enough = count >= self.fewest_rows
        mean = visible.sum(1) / count.clamp(min=1)
        return points[long_enough], visible[long_enough], mean[long_enough]


def shrunk(image: Tensor, K: Tensor, focal_px: float = FOCAL_PX) -> tuple[Tensor, Tensor]:
    """Return an image ``(3, H, W)`` at the focal length of the training as a batch of one, its sides
    multiples of 16, and its matrix.
    """
    scale = focal_px / float(K[0, 0])
    height = max(int(image.shape[1] * scale + 0.5), 16)
    width = max(int(image.shape[2] * scale + 0.5), 16)
    small = F.interpolate(image[None], size=[height, width], mode="area")
    K = K.clone()
    K[0] *= width / image.shape[2]
    K[1] *= height / image.shape[1]
    return F.pad(small, [0, -width % 16, 0, -height % 16]), K
