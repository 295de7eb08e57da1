"""Read photographs from structure from motion, and place the points that they share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64, Bool
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.fit.photographs import present, read_posed_photographs, resized
from alpasim_plugin.gaussians.fit.start import Match, cloud_from_points
from alpasim_plugin.gaussians.fit.views import PosedView

# Structure from motion has no unit: the camera that is farthest from the middle of all is put so
# far from it.
EXTENT_M = 4.0
SIDE_PX = 16  # sides are multiples of this, as fixers need
LARGEST_ERROR_PX = 1.5  # of reprojection of a triangulated point
LEAST_ANGLE_DEG = 1.5  # between the rays to it


@dataclass(frozen=True)
class Photographs:
    """Photographs in the order of the file.

    Attributes:
        views: Those that exist, without distortion, of one size.
        missing: Names that the file lists and the folder lacks.
        listed: How many the file lists.
    """

    views: tuple[PosedView, ...]
    missing: tuple[str, ...]
    listed: int


def read_photographs(folder: Path, width: int = 256) -> Photographs:
    """Read a folder of photographs from structure from motion: axes of OpenGL, an arbitrary unit,
    and not all images there.

    An image is freed of its distortion at full size, then reduced by averaging, and its height is
    cut at the middle to a multiple of 16.

    Args:
        folder: Holds ``transforms.json`` and the images that it names.
        width: Pixels across of the views, a multiple of 16.

    Raises:
        InputError: No such file, a key is missing, another lens model than OpenCV's, or fewer than
            two images exist.
    """
    if width < SIDE_PX or width % SIDE_PX:
        raise InputError(
            f"width {width}: not a multiple of {SIDE_PX}",
            f"choose for example {16 * SIDE_PX}",
        )
    _, pictures = read_posed_photographs(folder, "opengl")
    pictures_on_disk, missing = present(folder, pictures)
    # Camera by camera, as files list them.
    pictures_on_disk = sorted(pictures_on_disk, key=lambda photograph: photograph.camera or "")
    poses = _scaled(np.array([picture.T_world_camera for picture in pictures_on_disk]))
    views = [
        _cut(replace(photograph, T_world_camera=pose).view(), width, photograph.location)
        for photograph, pose in zip(pictures_on_disk, poses, strict=True)
    ]
    return Photographs(tuple(views), missing, len(pictures))


def _scaled(poses: F64) -> F64:
    out = poses.copy()
    middle = out[:, :3, 3].mean(axis=0)
    farthest = float(np.linalg.norm(out[:, :3, 3] - middle, axis=1).max())
    if farthest > 0:
        out[:, :3, 3] = (out[:, :3, 3] - middle) * (EXTENT_M / farthest)
    return out


def _cut(view: PosedView, width: int, location: str) -> PosedView:
    """Reduce a view to a width, and cut its height at the middle to a multiple of `SIDE_PX`."""
    small = resized(view, width)
    height = small.camera.height
    kept = height // SIDE_PX * SIDE_PX
    if kept < SIDE_PX:
        raise InputError(
            f"{location}: {height} pixels high at {width} across", "choose a larger width"
        )
    top = (height - kept) // 2
    K = small.pinhole.K.copy()
    K[1, 2] -= top
    camera = PinholeCamera(width, kept, K, small.camera.T_camera_world)
    return PosedView(camera, np.ascontiguousarray(small.rgb[top : top + kept]), view.name)


def triangulated(
    views: Sequence[PosedView],
    matches: Sequence[Match],
    used: Sequence[int],
    most: int,
    rng: np.random.Generator,
) -> GaussianCloud:
    """Return start Gaussians at the points that views place consistently.

    Args:
        views: That were matched.
        matches: Their matches.
        used: Indices of the views that may be looked at; matches with others are left out.
        most: Points at most, drawn from all.
        rng: Draws them.

    Raises:
        InputError: Fewer than ten such points.
    """
    may = set(used)
    parts: list[tuple[F64, F64]] = []
    pairs = sorted({(m.first, m.second) for m in matches if m.first in may and m.second in may})
    for i, j in pairs:
        pair_matches = [m for m in matches if (m.first, m.second) == (i, j)]
        a = np.array([m.at_first for m in pair_matches])
        b = np.array([m.at_second for m in pair_matches])
        place, good = _triangulate(views[i].pinhole, views[j].pinhole, a, b)
        pixels = a[good].astype(np.int64)
        parts.append((place[good], views[i].rgb[pixels[:, 1], pixels[:, 0]] / 255.0))
    points = np.concatenate([np.zeros((0, 3)), *(place for place, _ in parts)])
    colours = np.concatenate([np.zeros((0, 3)), *(rgb for _, rgb in parts)])
    count = len(points)
    if count < 10:
        raise InputError(
            f"{len(used)} photographs: {count} points that two photographs place consistently",
            "give photographs that overlap, in order along the way",
        )
    kept = rng.permutation(count)[:most]
    return cloud_from_points(points[kept], colours[kept])


def _triangulate(first: PinholeCamera, second: PinholeCamera, a: F64, b: F64) -> tuple[F64, Bool]:
    """Return points ``(N, 3)`` and which are good: before both cameras, near both rays, and seen at
    an angle.
    """
    P = [camera.K @ camera.T_camera_world[:3] for camera in (first, second)]
    homogeneous = cv2.triangulatePoints(P[0], P[1], a.T, b.T)
    w = np.where(np.abs(homogeneous[3]) < 1e-12, 1e-12, homogeneous[3])
    points = (homogeneous[:3] / w).T
    good = np.ones(len(points), dtype=bool)
    for camera, observed in ((first, a), (second, b)):
        local = points @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]
        pixel = local @ camera.K.T
        error = np.linalg.norm(
            pixel[:, :2] / np.where(np.abs(local[:, 2:]) < 1e-9, 1e-9, local[:, 2:]) - observed,
            axis=1,
        )
        good &= (local[:, 2] > 1e-3) & (error < LARGEST_ERROR_PX)
    rays = [points - camera.centre_world for camera in (first, second)]
    cosine = np.einsum("ij,ij->i", *rays) / np.maximum(
        np.linalg.norm(rays[0], axis=1) * np.linalg.norm(rays[1], axis=1), 1e-12
    )
    return points, good & (cosine < np.cos(np.radians(LEAST_ANGLE_DEG)))
