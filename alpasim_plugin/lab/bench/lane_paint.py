"""Lane markings in images: which pixels show them, and how many were invented or lost.

A pixel shows a lane marking where the road is seen and it is brighter than the road on both its
sides along the row, which must be alike: the symmetrical local threshold, best of the comparison by
Veit et al. (ITSC 2008), here with medians. Brightness is the mean of red and green, so that white
and yellow count alike. The width of the sides follows from the distance: a lane marking is at most
`WIDEST_M` wide. The detector is simple on purpose and the same for the photograph and for what is
measured: a kerb's bright edge counts as one in both.

Precision is the share of the painted pixels of an image that lie within `TOLERANCE_PX` of a painted
pixel of the photograph; recall is the share of the photograph's that lie so near to one of the
image. A lane marking that is nowhere in the photograph is invented: 1 - precision.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import scipy

from alpasim_plugin.core.types import F64, U8, Bool, HeightField
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.world.ground import height_at

CONTRAST_LEVELS = 18.0  # by which a lane marking is brighter than either side
WIDEST_M = 0.35
# Of the road that is looked at, along the optical axis
NEAREST_M = 4.0
FARTHEST_M = 30.0
ASIDE_M = 4.0  # from the recorded path
SMALLEST_PX = 8  # of a painted spot
TOLERANCE_PX = 2


@dataclass(frozen=True)
class PaintCounts:
    """Painted pixels of images and of their photographs; counts of several images are added.

    Attributes:
        made: In the image.
        made_true: Of those, near a lane marking of the photograph.
        true: In the photograph.
        true_made: Of those, near a lane marking of the image.
    """

    made: int = 0
    made_true: int = 0
    true: int = 0
    true_made: int = 0

    def __add__(self, other: PaintCounts) -> PaintCounts:
        return PaintCounts(
            self.made + other.made,
            self.made_true + other.made_true,
            self.true + other.true,
            self.true_made + other.true_made,
        )

    @property
    def precision(self) -> float | None:
        """Return the share of lane markings that are real; None where there is none."""
        return self.made_true / self.made if self.made else None

    @property
    def recall(self) -> float | None:
        """Return the share of the real lane markings that are shown; None where there is none."""
        return self.true_made / self.true if self.true else None


@dataclass(frozen=True, eq=False)
class Road:
    """Where a camera sees the road.

    Attributes:
        mask: Where it sees the road, ``(H, W)`` bool.
        side_px: ``(H,)`` how far, in each row, the road beside a painted pixel is looked at; 0
            where the row shows no road.
    """

    mask: Bool
    side_px: F64


def road_of(camera: PinholeCamera, ground: HeightField, path: F64) -> Road:
    """Return the road before a camera, within `ASIDE_M` of a path.

    Args:
        camera: In the world.
        ground: Its height; the world's z is up.
        path: ``(N, 2+)`` metres, world.
    """
    v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    ray = (
        np.stack(
            [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=2
        )
        @ camera.T_camera_world[:3, :3]
    )
    eye = camera.centre_world
    z = np.full(u.shape, float(height_at(ground, eye[None])[0]))
    down = ray[..., 2] < -1e-3
    for _ in range(3):  # the ground is nearly level: its height where the ray last met it is enough
        depth = np.where(down, (z - eye[2]) / np.where(down, ray[..., 2], -1.0), np.inf)
        ground_point = eye[:2] + np.where(np.isfinite(depth), depth, 0.0)[..., None] * ray[..., :2]
        z = height_at(ground, ground_point.reshape(-1, 2)).reshape(u.shape)
    steps = np.concatenate(
        [
            np.linspace(a, b, 8, endpoint=False)
            for a, b in zip(path[:-1, :2], path[1:, :2], strict=True)
        ]
        + [path[-1:, :2]]
    )
    in_reach = down & (depth > NEAREST_M) & (depth < FARTHEST_M)
    in_reach[in_reach] = (
        scipy.spatial.KDTree(steps).query(ground_point[in_reach], distance_upper_bound=ASIDE_M)[0]
        < ASIDE_M
    )
    usual = np.array(
        [
            np.median(row[ok]) if ok.any() else np.inf
            for row, ok in zip(depth, in_reach, strict=True)
        ]
    )
    side = np.where(np.isfinite(usual), np.maximum(np.round(camera.fx * WIDEST_M / usual), 2), 0)
    return Road(np.asarray(in_reach), np.asarray(side, dtype=np.float64))


def paint_of(rgb: U8, road: Road) -> Bool:
    """Return which pixels ``(H, W)`` of an image ``(H, W, 3)`` are painted road."""
    bright = rgb[..., :2].astype(np.float64).mean(axis=2)
    out = np.zeros(bright.shape, dtype=bool)
    for row in np.flatnonzero(road.side_px):
        out[row] = _brighter(bright[row], int(road.side_px[row])) & road.mask[row]
    count, label, stats, _ = cv2.connectedComponentsWithStats(out.astype(np.uint8), connectivity=8)
    large = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] >= SMALLEST_PX)
    return np.asarray(np.isin(label, large[large > 0])) if count > 1 else out


def _brighter(row: F64, side: int) -> Bool:
    """Return where a row is brighter than its surroundings ``side`` to ``2 side`` pixels to the
    left and to the right, which are alike.

    The surroundings' brightness is a median: the other line of a double one lies there and must not
    count as road.
    """
    wide = np.pad(row, 2 * side, mode="edge")
    middle = np.median(np.lib.stride_tricks.sliding_window_view(wide, side), axis=1)
    i = np.arange(len(row))
    left = middle[i]
    right = middle[i + 3 * side + 1]
    alike = np.abs(left - right) < CONTRAST_LEVELS
    return np.asarray((row > left + CONTRAST_LEVELS) & (row > right + CONTRAST_LEVELS) & alike)


def compare_paint(made: U8, truth: U8, road: Road) -> PaintCounts:
    """Count the painted pixels of an image and of its photograph, both ``(H, W, 3)``."""
    a = paint_of(made, road)
    b = paint_of(truth, road)
    size = 2 * TOLERANCE_PX + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    near_a, near_b = (cv2.dilate(mask.astype(np.uint8), disc) > 0 for mask in (a, b))
    return PaintCounts(int(a.sum()), int((a & near_b).sum()), int(b.sum()), int((b & near_a).sum()))
