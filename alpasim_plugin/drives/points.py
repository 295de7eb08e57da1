"""Triangulate surface points from photographs with known poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F64
from alpasim_plugin.drives.source import DOING, Points
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.fit.photographs import Picture, resized
from alpasim_plugin.gaussians.fit.start import matches
from alpasim_plugin.gaussians.fit.tracks import Tracks, follow, place, pose_arrays, residuals
from alpasim_plugin.gaussians.fit.views import PosedView

WIDTH_PX = 1280  # following and matching need no more
ERROR_PX, PIXEL_SPREAD = 1.2, 0.3  # of a point in each photograph that places it: largest, and usual
FEWEST_VIEWS, LEAST_ANGLE_RAD = 3, np.radians(0.7)  # that place a point; between its outermost rays
FEWEST_POINTS = 60


def small_view(picture: Picture) -> PosedView:
    """Return a photograph without distortion, at most `WIDTH_PX` wide."""
    view = picture.view()
    return resized(view, WIDTH_PX) if view.camera.width > WIDTH_PX else view


def triangulated(pictures: Sequence[Picture], folder: str) -> Points:
    """Return the points that at least three photographs place alike.

    Corners are followed from photograph to photograph; photographs too far apart for that are matched.

    Args:
        pictures: Of one camera, in order along the way.
        folder: For messages.

    Raises:
        InputError: Fewer than `FEWEST_POINTS` points: the photographs do not overlap, or their poses are not theirs.
    """
    views = [small_view(picture) for picture in pictures]
    points = placed(follow(views), views)
    if len(points) < 4 * FEWEST_POINTS:
        points = max(points, placed(_matched(views), views), key=len)
    if len(points) < FEWEST_POINTS:
        found = f"{len(points)} points that {FEWEST_VIEWS} of {len(pictures)} photographs place alike"
        do = "give photographs that overlap, in order along the way, with their own poses and lens"
        raise InputError(DOING, folder, found, do)
    return points


def placed(tracks: Tracks, views: Sequence[PosedView]) -> Points:
    """Place tracks, and return the points that at least three views place alike, with how well each is known."""
    if not tracks.count:
        return Points(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    cameras = [view.camera for view in views]
    first = place(tracks, cameras)
    tracks = tracks.only(np.asarray(first.error_px < 3 * ERROR_PX))  # observations that do not fit are left out once
    if not tracks.count:
        return Points(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    found = place(tracks, cameras)
    worst, count = np.zeros(tracks.count), np.bincount(tracks.point, minlength=tracks.count)
    np.maximum.at(worst, tracks.point, found.error_px)
    good = (count >= FEWEST_VIEWS) & (worst < ERROR_PX) & (found.angle_rad > LEAST_ANGLE_RAD) & np.isfinite(found.xyz).all(axis=1)
    begins = np.searchsorted(tracks.point, np.arange(tracks.count))
    colours = np.array([_colour(views[tracks.view[i]], tracks.at[i]) for i in begins]).reshape(-1, 3)
    return Points(found.xyz, colours, _covariance(found.xyz, tracks, cameras)).chosen(good)


def _colour(view: PosedView, at: F64) -> F64:
    row, column = np.clip(at[::-1].astype(np.int64), 0, [view.camera.height - 1, view.camera.width - 1])
    return np.asarray(view.rgb[row, column] / 255.0)


def _covariance(xyz: F64, tracks: Tracks, cameras: Sequence[PinholeCamera]) -> F64:
    """Return the covariance ``(P, 3, 3)`` of each point for a usual error in its photographs."""
    _, J, _ = residuals(xyz, tracks, *pose_arrays(cameras))
    H = np.zeros((tracks.count, 3, 3))
    np.add.at(H, tracks.point, J.transpose(0, 2, 1) @ J)
    return np.asarray(np.linalg.pinv(H, hermitian=True) * PIXEL_SPREAD**2)


def _matched(views: Sequence[PosedView]) -> Tracks:
    """Return tracks of features that were matched between near photographs; one that meets a photograph twice is left out."""
    found = matches(views)
    if not found:
        return Tracks(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)), 0)
    ends = np.array([[m.first, *m.at_first] for m in found] + [[m.second, *m.at_second] for m in found])
    seen, number = np.unique(ends, axis=0, return_inverse=True)
    number, n = number.ravel(), len(found)
    graph = scipy.sparse.coo_matrix((np.ones(n), (number[:n], number[n:])), shape=(len(seen), len(seen)))
    _, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    view = seen[:, 0].astype(np.int64)
    _, index, times = np.unique(np.stack([label, view], axis=1), axis=0, return_inverse=True, return_counts=True)
    twice = np.unique(label[times[index.ravel()] > 1])
    keep = ~np.isin(label, twice)
    order = np.argsort(label[keep], kind="stable")
    _, point = np.unique(label[keep][order], return_inverse=True)
    return Tracks(view[keep][order], point.astype(np.int64), seen[keep][order, 1:], int(point.max(initial=-1)) + 1)


def agreeing(one: Picture, other: Picture, turns: Sequence[F64]) -> list[int]:
    """Return for each turn of the camera's axes how many matches of two photographs lie before both, where both see them.

    Args:
        one, other: Photographs.
        turns: ``(4, 4)`` each, applied to the poses on the camera's side.
    """
    views = [small_view(picture) for picture in (one, other)]
    views = [resized(view, 640) if view.camera.width > 640 else view for view in views]
    found = matches(views)
    n = len(found)
    if not n:
        return [0 for _ in turns]
    at = np.array([[m.at_first, m.at_second] for m in found]).reshape(-1, 2)
    tracks = Tracks(np.tile([0, 1], n), np.repeat(np.arange(n), 2), at, n)
    counts = []
    for turn in turns:
        turned = [PinholeCamera(c.width, c.height, c.K, inverse(turn) @ c.T_camera_world) for c in (view.camera for view in views)]
        error = place(tracks, turned).error_px.reshape(-1, 2)
        counts.append(int((error < ERROR_PX).all(axis=1).sum()))
    return counts
