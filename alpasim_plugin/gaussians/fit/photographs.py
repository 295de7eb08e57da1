"""Photographs of a place with poses from structure from motion: read, freed of the lens's distortion, and triangulated.

The file is Instant-NGP's ``transforms.json``: intrinsics with OpenCV's radial and tangential distortion, and camera-to-world matrices with
OpenGL axes. Posed images that need no undistortion are read by `view_files`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F64, U8
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.fit.start import cloud_from_points
from alpasim_plugin.gaussians.fit.view_files import AXES, FILE
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.io.limits import SOURCE_BYTES
from alpasim_plugin.io.reading import read_bytes, read_json_object
from alpasim_plugin.io.reading.images import decode_image
from alpasim_plugin.io.reading.json_files import as_shape

DOING = "reading photographs"
MODEL = ("k1", "k2", "p1", "p2", "k3")  # the order of OpenCV's coefficients
EXTENT_M = 4.0  # structure from motion has no unit: the camera that is farthest from their middle is put so far from it
SIDE_PX = 16  # sides are multiples of this, as fixers need
NEIGHBOURS, FEATURES, RATIO = 4, 2500, 0.75  # of the next photographs; SIFT keypoints; Lowe's ratio test
LARGEST_ERROR_PX, LEAST_ANGLE_DEG = 1.5, 1.5  # of a triangulated point: reprojection, and between its rays


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


class Match(NamedTuple):
    """A point that two photographs show: their indices, and where, in pixels of their views ``(2,)``."""

    first: int
    second: int
    at_first: F64
    at_second: F64


def read_photographs(folder: Path, width: int = 256) -> Photographs:
    """Read a folder of photographs.

    A picture is freed of its distortion at full size, then reduced by averaging, and its height is cut at the middle to a multiple of 16.

    Args:
        folder: Holds ``transforms.json`` and the images that it names.
        width: Pixels across of the views, a multiple of 16.

    Raises:
        InputError: No such file, a key is missing, another lens model than OpenCV's, or fewer than two images exist.
    """
    path = folder / FILE
    document = read_json_object(path, DOING, do_this=f"give a folder with images and their {FILE} (docs/lab/pairs.md)")
    if width < SIDE_PX or width % SIDE_PX:
        raise InputError(DOING, f"width {width}", f"not a multiple of {SIDE_PX}", f"choose for example {16 * SIDE_PX}")
    odd = sorted({str(document["camera_model"])} if document.get("camera_model", "OPENCV") not in ("OPENCV", "PINHOLE") else set())
    if odd or document.get("k4"):
        found = f"lens model {odd[0]}" if odd else "a coefficient k4"
        raise InputError(DOING, str(path), found, "give OpenCV's k1, k2, p1, p2, k3, or undistort the images first")
    frames = as_shape(list[dict[str, Any]], document.get("frames") or [], f"{path}, key 'frames'", DOING)
    here = [frame for frame in frames if (folder / str(frame.get("file_path"))).is_file()]
    missing = tuple(str(frame.get("file_path")) for frame in frames if frame not in here)
    if len(here) < 2:
        raise InputError(DOING, str(folder), f"{len(here)} of {len(frames)} listed images exist", "give the images that the file names")
    poses = _scaled(np.array([_pose(frame, f"{path}, {frame['file_path']}") for frame in here]))
    views = [_view(folder, {**document, **frame}, T, width, path) for frame, T in zip(here, poses, strict=True)]
    return Photographs(tuple(views), missing, len(frames))


def resized(view: PosedView, width: int) -> PosedView:
    """Return a view with another number of pixels, its field of view unchanged."""
    camera, scale = view.camera, width / view.camera.width
    height = round(camera.height * scale)
    K = np.diag([scale, height / camera.height, 1.0]) @ camera.K
    rgb = cv2.resize(view.rgb, (width, height), interpolation=cv2.INTER_AREA)
    return PosedView(PinholeCamera(width, height, K, camera.T_camera_world), np.asarray(rgb, dtype=np.uint8), view.name)


def matches(views: Sequence[PosedView]) -> list[Match]:
    """Return points that a view and one of its next ones show: SIFT, nearest neighbours in both directions, ratio test."""
    sift, matcher = cv2.SIFT_create(FEATURES), cv2.BFMatcher(cv2.NORM_L2)  # type: ignore[attr-defined]
    found = []
    for view in views:
        points, described = sift.detectAndCompute(cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY), None)
        found.append((np.array([p.pt for p in points]).reshape(-1, 2) + 0.5, described))
    out = []
    for i in range(len(views)):
        for j in range(i + 1, min(i + 1 + NEIGHBOURS, len(views))):
            (at_i, describes_i), (at_j, describes_j) = found[i], found[j]
            if describes_i is None or describes_j is None or len(at_i) < 2 or len(at_j) < 2:
                continue
            back = {m.queryIdx: m.trainIdx for (m,) in matcher.knnMatch(describes_j, describes_i, k=1)}
            for best, second in matcher.knnMatch(describes_i, describes_j, k=2):
                if best.distance < RATIO * second.distance and back[best.trainIdx] == best.queryIdx:
                    out.append(Match(i, j, at_i[best.queryIdx], at_j[best.trainIdx]))
    return out


def triangulated(
    views: Sequence[PosedView], found: Sequence[Match], used: Sequence[int], most: int, rng: np.random.Generator
) -> GaussianCloud:
    """Return start Gaussians at the points that views place consistently.

    Args:
        views: That were matched.
        found: Their matches.
        used: Indices of the views that may be looked at; matches with others are left out.
        most: Points at most, drawn from all.
        rng: Draws them.

    Raises:
        InputError: Fewer than ten such points.
    """
    may, points, colours = set(used), [], []
    pairs = sorted({(m.first, m.second) for m in found if m.first in may and m.second in may})
    for i, j in pairs:
        mine = [m for m in found if (m.first, m.second) == (i, j)]
        a, b = (np.array([at for at in side]) for side in ([m.at_first for m in mine], [m.at_second for m in mine]))
        place, good = _triangulate(views[i].camera, views[j].camera, a, b)
        at = a[good].astype(np.int64)
        points.append(place[good])
        colours.append(views[i].rgb[at[:, 1], at[:, 0]] / 255.0)
    count = sum(map(len, points))
    if count < 10:
        found_text = f"{count} points that two photographs place consistently"
        raise InputError(
            "starting from photographs", f"{len(used)} photographs", found_text, "give photographs that overlap, in order along the way"
        )
    kept = rng.permutation(count)[:most]
    return cloud_from_points(np.concatenate(points)[kept], np.concatenate(colours)[kept])


def _triangulate(first: PinholeCamera, second: PinholeCamera, a: F64, b: F64) -> tuple[F64, np.ndarray[Any, np.dtype[np.bool_]]]:
    """Return points ``(N, 3)`` and which are good: before both cameras, near both rays, and seen at an angle."""
    P = [camera.K @ camera.T_camera_world[:3] for camera in (first, second)]
    homogeneous = cv2.triangulatePoints(P[0], P[1], a.T, b.T)
    w = np.where(np.abs(homogeneous[3]) < 1e-12, 1e-12, homogeneous[3])
    points = (homogeneous[:3] / w).T
    good = np.ones(len(points), dtype=bool)
    for camera, at in ((first, a), (second, b)):
        local = points @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]
        pixel = local @ camera.K.T
        error = np.linalg.norm(pixel[:, :2] / np.where(np.abs(local[:, 2:]) < 1e-9, 1e-9, local[:, 2:]) - at, axis=1)
        good &= (local[:, 2] > 1e-3) & (error < LARGEST_ERROR_PX)
    rays = [points - camera.centre_world for camera in (first, second)]
    cosine = np.einsum("ij,ij->i", *rays) / np.maximum(np.linalg.norm(rays[0], axis=1) * np.linalg.norm(rays[1], axis=1), 1e-12)
    return points, good & (cosine < np.cos(np.radians(LEAST_ANGLE_DEG)))


def _pose(frame: dict[str, Any], where: str) -> F64:
    T = np.asarray(as_shape(list[list[float]], frame.get("transform_matrix"), f"{where}, transform_matrix", DOING), dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(DOING, f"{where}, transform_matrix", f"shape {T.shape}", "give a finite matrix of 4 x 4")
    u, _, vt = np.linalg.svd(T[:3, :3])  # what is written with a few digits is not quite a rotation
    if np.abs(T[:3, :3] - u @ vt).max() > 1e-3 or np.linalg.det(u @ vt) < 0:
        raise InputError(DOING, f"{where}, transform_matrix", "its first three columns are no rotation", "give a rigid transform")
    T[:3, :3] = u @ vt
    return np.asarray(T @ AXES["opengl"])


def _scaled(poses: F64) -> F64:
    out = poses.copy()
    middle = out[:, :3, 3].mean(axis=0)
    farthest = float(np.linalg.norm(out[:, :3, 3] - middle, axis=1).max())
    if farthest > 0:
        out[:, :3, 3] = (out[:, :3, 3] - middle) * (EXTENT_M / farthest)
    return out


def _view(folder: Path, frame: dict[str, Any], T_world_camera: F64, width: int, path: Path) -> PosedView:
    where = f"{path}, {frame['file_path']}"
    try:
        full_w, full_h = int(frame["w"]), int(frame["h"])
        K = np.array([[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1]], dtype=np.float64)
        bend = np.array([float(frame.get(key) or 0.0) for key in MODEL])
        if not np.isfinite([*K.ravel(), *bend]).all() or min(K[0, 0], K[1, 1]) <= 0:
            raise ValueError("intrinsics that are not finite, or no focal length")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        do = "give w, h, fl_x, fl_y, cx and cy in pixels, and k1, k2, p1, p2 where the lens bends lines"
        raise InputError(DOING, where, f"{type(error).__name__}: {error}", do) from error
    file = folder / str(frame["file_path"])
    rgb: U8 = decode_image(read_bytes(file, DOING, SOURCE_BYTES), str(file), DOING)[..., ::-1]
    if rgb.shape[:2] != (full_h, full_w):
        raise InputError(
            DOING, where, f"{rgb.shape[1]}x{rgb.shape[0]} pixels, the file says {full_w}x{full_h}", "give the photographs as they were"
        )
    if bend.any():
        centre = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # OpenCV counts from pixel centres
        whole, _ = cv2.getOptimalNewCameraMatrix(K - centre, bend, (full_w, full_h), 0.0)  # shows only what the photograph shows
        rgb = np.asarray(cv2.undistort(rgb, K - centre, bend, None, whole), dtype=np.uint8)
        K = np.asarray(whole, dtype=np.float64) + centre
    height = round(full_h * width / full_w)
    small = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA)
    kept = height // SIDE_PX * SIDE_PX
    top = (height - kept) // 2
    if kept < SIDE_PX:
        raise InputError(DOING, where, f"{height} pixels high at {width} across", "choose a larger width")
    K = np.diag([width / full_w, height / full_h, 1.0]) @ K
    K[1, 2] -= top
    camera = PinholeCamera(width, kept, K, inverse(T_world_camera))
    return PosedView(camera, np.ascontiguousarray(small[top : top + kept], dtype=np.uint8), file.stem)
