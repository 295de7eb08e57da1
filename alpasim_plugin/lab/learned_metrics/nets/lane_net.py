"""The lane judge: lane lines on the ground from one frame.

The image is laid on the ground plane by the known camera, so that a line has one width at all
distances. The network says for each of 29 distances (3, 5 ... 59 m) and 54 cells of 0.4 m whether a
line passes, where in the cell, and in which direction. Points are joined to lines along these
directions. Baselines with a fixed number of line slots need a set loss and far more training than
this takes.
"""

from __future__ import annotations

import numpy as np
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.core.types import F32, F64
from alpasim_plugin.lab.learned_metrics.nets.ground_view import CELL_M, HALF_WIDTH_M
from alpasim_plugin.lab.learned_metrics.nets.layers import ResidualPair
from alpasim_plugin.lab.learned_metrics.types import FORWARD_M, Lane3D

CHANNELS = 32
CELLS = round(2 * HALF_WIDTH_M / CELL_M)  # 54
STEP_M = float(FORWARD_M[1] - FORWARD_M[0])
POINT = 0.3  # least probability of a point
PEAK_M = 1.0  # a point is the most probable one within this reach on its row
LINK_M = 0.8  # a line goes on at a point this near to where it points
GAP_ROWS = 3  # rows that a line may miss: one gap of dashes
LEAST_POINTS = 3


class LaneNet(nn.Module):
    """Cells with lines.

    Example:
        >>> LaneNet()(torch.zeros(1, 4, 58, 216)).shape
        torch.Size([1, 3, 29, 54])
    """

    def __init__(self, channels: int = CHANNELS) -> None:
        super().__init__()
        self.stem = nn.Conv2d(4, channels // 2, (3, 4), stride=(1, 2), padding=(1, 1))
        self.down = nn.Conv2d(channels // 2, channels, 4, stride=2, padding=1)
        self.body = nn.Sequential(
            *(ResidualPair(channels, (5, 1), (1, 5), dilation) for dilation in (1, 2, 4, 1))
        )
        self.norm = nn.GroupNorm(4, channels)
        self.head = nn.Conv2d(channels, 3, 1)

    def forward(self, ground: Tensor) -> Tensor:
        """Map ``(B, 4, 58, 216)`` of `GroundView` to ``(B, 3, 29, 54)``: logit, offset to the right
        in cells, slope in metres per row.
        """
        x = F.leaky_relu(self.stem(ground), 0.1)
        out: Tensor = self.head(F.leaky_relu(self.norm(self.body(self.down(x))), 0.1))
        return out


def join_lines(cells: F32) -> list[Lane3D]:
    """Return the lines in one frame's cells ``(3, 29, 54)`` as `LaneNet` gives them, the surest
    first.

    From near to far, a point goes to the line whose extrapolation is nearest, at most 0.8 m away; a
    line may miss three rows. The score of a line is the mean probability of its points. Missed rows
    between points are filled in linearly.
    """
    probability = 1 / (1 + np.exp(-cells[0].astype(np.float64)))
    lateral = HALF_WIDTH_M - CELL_M * (np.arange(CELLS) + 0.5 + np.clip(cells[1], -0.75, 0.75))
    open_lines: list[
        list[tuple[int, float, float, float]]
    ] = []  # points: row, lateral, slope, probability
    done: list[list[tuple[int, float, float, float]]] = []
    for row in range(len(FORWARD_M)):
        done += [line for line in open_lines if row - line[-1][0] > GAP_ROWS + 1]
        open_lines = [line for line in open_lines if row - line[-1][0] <= GAP_ROWS + 1]
        points = [
            (row, float(lateral[row, c]), float(cells[2, row, c]), float(probability[row, c]))
            for c in _peaks(probability[row], lateral[row])
        ]
        pairs = sorted(
            (
                abs(p[1] - (line[-1][1] + _slope(line) * (row - line[-1][0])))
                - 0.1 * len(line[-5:]),
                i,
                j,
            )
            for i, line in enumerate(open_lines)
            for j, p in enumerate(points)
            if abs(p[1] - (line[-1][1] + _slope(line) * (row - line[-1][0]))) <= LINK_M
        )
        lines_used: set[int] = set()
        points_used: set[int] = set()
        for _, i, j in pairs:
            if i not in lines_used and j not in points_used:
                lines_used.add(i)
                points_used.add(j)
                open_lines[i].append(points[j])
        open_lines += [[p] for j, p in enumerate(points) if j not in points_used]
    found = [_lane(line) for line in done + open_lines if len(line) >= LEAST_POINTS]
    return sorted(found, key=lambda lane: -lane.score)


def _slope(line: list[tuple[int, float, float, float]]) -> float:
    """Return where a line points, metres per row: the mean of the network's slopes and the line's
    own over the last points.
    """
    said = line[-1][2]
    if len(line) < 3:
        return said
    row, at = line[-3][0], line[-3][1]
    return 0.5 * (said + (line[-1][1] - at) / (line[-1][0] - row))


def _peaks(probability: F64, lateral: F64) -> list[int]:
    """Return the cells of one row that hold a point: the surest within a reach, surest first."""
    taken: list[int] = []
    for c in np.argsort(-probability, kind="stable"):
        if probability[c] < POINT:
            break
        if all(abs(lateral[c] - lateral[k]) >= PEAK_M for k in taken):
            taken.append(int(c))
    return taken


def _lane(points: list[tuple[int, float, float, float]]) -> Lane3D:
    rows = np.array([p[0] for p in points])
    every = np.arange(rows[0], rows[-1] + 1)
    lateral = np.full(len(FORWARD_M), np.nan)
    lateral[every] = np.interp(every, rows, [p[1] for p in points])
    return Lane3D(lateral, float(np.mean([p[3] for p in points])))
