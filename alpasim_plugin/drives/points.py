"""Triangulate surface points from photographs with known poses: matched along epipolar lines, joined to tracks, placed by all rays."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
import scipy

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F32, F64, I64, U8, Bool
from alpasim_plugin.drives.source import DOING, Points
from alpasim_plugin.gaussians.fit.lens import Lens
from alpasim_plugin.gaussians.fit.photographs import Picture

WIDTH_PX = 1280  # matching needs no more
FEATURES, CONTRAST = 3000, 0.02  # of a photograph; asphalt has little contrast
APART = (1, 2)  # a photograph is matched with these next ones
EPIPOLAR_PX, RATIO = 2.0, 0.8
ERROR_PX = 1.2  # of a point in each photograph that places it
PIXEL_SPREAD = 0.3  # of a keypoint, pixels
FEWEST_VIEWS = 3
LEAST_ANGLE_RAD = np.radians(0.7)  # between a point's outermost rays
FEWEST_POINTS = 60
STEPS = 4


class Matched:
    """A photograph ready to be matched: its pinhole, its pose, its keypoints.

    Attributes:
        at: ``(N, 2)`` rays ``x / z, y / z`` of the keypoints.
        described: ``(N, 128)`` root-SIFT, unit length.
        colour: ``(N, 3)`` 0..1.
        focal: Pixels.
    """

    def __init__(self, picture: Picture, rgb: U8) -> None:
        lens, rgb = pinhole(picture, rgb)
        sift = cv2.SIFT_create(FEATURES, contrastThreshold=CONTRAST)  # type: ignore[attr-defined]
        found, described = sift.detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), None)
        pixels = np.array([p.pt for p in found]).reshape(-1, 2) + 0.5
        root = np.sqrt(described / np.maximum(described.sum(axis=1, keepdims=True), 1e-9)) if len(pixels) else np.zeros((0, 128))
        self.described: F32 = np.asarray(root, dtype=np.float32)
        self.focal = float(lens.K[0, 0])
        self.at: F64 = (pixels - lens.K[:2, 2]) / [lens.K[0, 0], lens.K[1, 1]]
        cells = np.minimum(pixels.astype(np.int64), [lens.width - 1, lens.height - 1])
        self.colour: F64 = rgb[cells[:, 1], cells[:, 0]] / 255.0
        self.T_camera_world: F64 = inverse(picture.T_world_camera)


def pinhole(picture: Picture, rgb: U8) -> tuple[Lens, U8]:
    """Return the lens and the pixels of a photograph without distortion, at most `WIDTH_PX` wide."""
    lens = Lens(picture.lens.width, picture.lens.height, picture.lens.straight_K())
    if lens.width <= WIDTH_PX:
        return lens, rgb
    lens = lens.resized(WIDTH_PX)
    return lens, np.asarray(cv2.resize(rgb, (lens.width, lens.height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def triangulated(pictures: Sequence[Picture], report: Callable[[int, int], None] | None = None, folder: str = "") -> Points:
    """Return the points that at least three photographs place alike.

    Args:
        pictures: Of one camera, in order along the way.
        report: Called with photographs done and all.
        folder: For messages.

    Raises:
        InputError: Fewer than `FEWEST_POINTS` points: the photographs do not overlap, or their poses are not theirs.
    """
    seen: list[Matched] = []
    links: list[tuple[int, int, I64, I64]] = []
    for i, picture in enumerate(pictures):
        seen.append(Matched(picture, picture.rgb()))
        links += [(i - k, i, *matched(seen[i - k], seen[i])) for k in APART if i >= k]
        if i >= max(APART):
            seen[i - max(APART)].described = np.zeros((0, 128), np.float32)
        if report is not None:
            report(i + 1, len(pictures))
    track, view, at = _tracks(seen, links)
    rays = np.array([seen[v].at[k] for v, k in zip(view, at, strict=True)]).reshape(-1, 2)
    colours = np.array([seen[v].colour[k] for v, k in zip(view, at, strict=True)]).reshape(-1, 3)
    points = placed(np.array([one.T_camera_world for one in seen]), np.array([one.focal for one in seen]), track, view, rays, colours)
    if len(points) < FEWEST_POINTS:
        found = f"{len(points)} points that {FEWEST_VIEWS} of {len(pictures)} photographs place alike"
        do = "give photographs that overlap, in order along the way, with their own poses and lens"
        raise InputError(DOING, folder or pictures[0].where, found, do)
    return points


def matched(one: Matched, other: Matched) -> tuple[I64, I64]:
    """Return indices of the keypoints that two photographs share: nearest to each other, in both directions, near the epipolar line."""
    if not len(one.at) or not len(other.at):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    alike = one.described @ other.described.T
    alike[~near_epipolar(one, other)] = -1.0
    rows, columns = alike.argmax(axis=1), alike.argmax(axis=0)
    best = alike[np.arange(len(rows)), rows]
    mutual = (columns[rows] == np.arange(len(rows))) & (best > 0.5)
    first = np.nonzero(mutual)[0]
    rest = alike[first]
    rest[np.arange(len(first)), rows[first]] = -1.0
    distance, next_one = np.sqrt(np.maximum(2 - 2 * best[first], 0)), np.sqrt(np.maximum(2 - 2 * rest.max(axis=1), 0))
    good = distance < RATIO * next_one
    return first[good], rows[first][good]


def near_epipolar(one: Matched, other: Matched) -> Bool:
    """Return ``(N, M)``: whether a keypoint of ``other`` lies near the epipolar line of one of ``one``."""
    T = other.T_camera_world @ inverse(one.T_camera_world)
    t = T[:3, 3]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    rays = np.column_stack([one.at, np.ones(len(one.at))])
    lines = rays @ (cross @ T[:3, :3]).T
    lines /= np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)
    away = lines.astype(np.float32) @ np.column_stack([other.at, np.ones(len(other.at))]).T.astype(np.float32)
    return np.asarray(np.abs(away) < EPIPOLAR_PX / other.focal)


def placed(T: F64, focal: F64, track: I64, view: I64, rays: F64, colours: F64) -> Points:
    """Place each track by all of its rays, robustly.

    Args:
        T: ``(V, 4, 4)`` world to camera.
        focal: ``(V,)`` pixels.
        track, view: ``(M,)`` of each observation, sorted by track, which are counted from 0.
        rays: ``(M, 2)`` x / z and y / z of each observation.
        colours: ``(M, 3)`` 0..1.

    Returns:
        The points that at least three views place alike.
    """
    if not len(track):
        return Points(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    alive = np.ones(len(track), dtype=bool)
    for _ in range(2):  # rays that do not fit are left out once, and the rest placed again
        xyz, covariance = _least_squares(T, track, view, rays, alive)
        error = _errors(T, xyz, track, view, rays) * focal[view]
        alive &= error < 3 * ERROR_PX
    count = np.bincount(track[alive], minlength=len(xyz))
    worst = np.zeros(len(xyz))
    np.maximum.at(worst, track[alive], error[alive])
    good = (count >= FEWEST_VIEWS) & (worst < ERROR_PX) & (_angles(T, xyz, track[alive], view[alive]) > LEAST_ANGLE_RAD)
    good &= np.isfinite(xyz).all(axis=1)
    first = np.unique(track, return_index=True)[1]
    return Points(xyz[good], colours[first][good], covariance[good] * (PIXEL_SPREAD / float(np.median(focal))) ** 2)


def _tracks(seen: Sequence[Matched], links: Sequence[tuple[int, int, I64, I64]]) -> tuple[I64, I64, I64]:
    """Return track, photograph and keypoint of every observation, sorted by track; a track that meets a photograph twice is left out."""
    starts = np.concatenate([[0], np.cumsum([len(one.at) for one in seen])]).astype(np.int64)
    a = np.concatenate([starts[i] + first for i, _, first, _ in links] or [np.zeros(0, np.int64)]).astype(np.int64)
    b = np.concatenate([starts[j] + second for _, j, _, second in links] or [np.zeros(0, np.int64)]).astype(np.int64)
    graph = scipy.sparse.coo_matrix((np.ones(len(a)), (a, b)), shape=(starts[-1], starts[-1]))
    _, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    used = np.unique(np.concatenate([a, b]))
    view = np.searchsorted(starts, used, side="right") - 1
    label = label[used]
    pairs = np.stack([label, view], axis=1)
    _, index, times = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    twice = np.unique(label[times[index.ravel()] > 1])
    sizes = np.bincount(label)
    keep = ~np.isin(label, twice) & (sizes[label] >= FEWEST_VIEWS)
    order = np.argsort(label[keep], kind="stable")
    _, track = np.unique(label[keep][order], return_inverse=True)
    kept = used[keep][order]
    return track.astype(np.int64), view[keep][order].astype(np.int64), (kept - starts[view[keep][order]]).astype(np.int64)


def _least_squares(T: F64, track: I64, view: I64, rays: F64, alive: Bool) -> tuple[F64, F64]:
    """Return points ``(N, 3)`` and their covariances for a ray error of 1: nearest to the rays, then by Gauss-Newton on the pictures."""
    n = int(track.max()) + 1
    track, view, rays = track[alive], view[alive], rays[alive]
    R, t = T[view, :3, :3], T[view, :3, 3]
    direction = np.einsum("nji,nj->ni", R, np.column_stack([rays, np.ones(len(rays))]))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    centre = -np.einsum("nji,nj->ni", R, t)
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    A, b = _summed(across, track, n), _summed(np.einsum("nij,nj->ni", across, centre), track, n)
    xyz = _solved(A, b)
    for _ in range(STEPS):
        local = np.einsum("nij,nj->ni", R, xyz[track]) + t
        z = np.where(np.abs(local[:, 2]) < 1e-6, 1e-6, local[:, 2])
        residual = local[:, :2] / z[:, None] - rays
        J = (R[:, :2] - (local[:, :2] / z[:, None])[:, :, None] * R[:, 2:3]) / z[:, None, None]
        A = _summed(np.einsum("nki,nkj->nij", J, J), track, n)
        xyz = xyz - _solved(A, _summed(np.einsum("nki,nk->ni", J, residual), track, n))
    return xyz, np.linalg.pinv(A, hermitian=True)


def _summed(values: F64, track: I64, n: int) -> F64:
    flat = values.reshape(len(values), -1)
    return np.stack([np.bincount(track, weights=column, minlength=n) for column in flat.T], axis=1).reshape(n, *values.shape[1:])


def _solved(A: F64, b: F64) -> F64:
    ridge = 1e-9 * (np.trace(A, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(3)
    return np.asarray(np.linalg.solve(A + ridge, b[..., None])[..., 0])


def _errors(T: F64, xyz: F64, track: I64, view: I64, rays: F64) -> F64:
    """Return by how much each ray ``(M,)`` misses its point; a point behind the camera misses by far."""
    local = np.einsum("nij,nj->ni", T[view, :3, :3], xyz[track]) + T[view, :3, 3]
    z = local[:, 2]
    off = np.linalg.norm(local[:, :2] / np.where(z > 1e-6, z, 1.0)[:, None] - rays, axis=1)
    return np.asarray(np.where(z > 1e-6, off, np.inf))


def _angles(T: F64, xyz: F64, track: I64, view: I64) -> F64:
    """Return the angle between each point's rays from the first and the last photograph that see it, radians."""
    centres = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    n = len(xyz)
    low, high = np.full(n, len(T)), np.full(n, -1)
    np.minimum.at(low, track, view)
    np.maximum.at(high, track, view)
    seen = high >= 0
    a, b = centres[np.where(seen, low, 0)] - xyz, centres[np.where(seen, high, 0)] - xyz
    cosine = np.einsum("ni,ni->n", a, b) / np.maximum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-12)
    return np.asarray(np.where(seen, np.arccos(np.clip(cosine, -1, 1)), 0.0))
