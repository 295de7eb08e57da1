"""Measure what photographs along a way say of every pixel: how far away it is, by optical flow to
neighbours, and whether it is sky.

A neighbour is first warped by the depth that tracks give (inverse depth is linear in the image on
every plane, so it is interpolated linearly between the tracks' points); flow (dense inverse search,
Kroeger et al. 2016) then finds the little that is left, also where the road under the bonnet moves
by a hundred pixels. The inverse depth of a pixel is the one that explains all neighbours best
(Gauss-Newton, Huber weights); it is kept where neighbours agree and the parallax is large enough to
say.

Sky is smooth, reaches to the top, has no parallax, and is of one colour by direction over the whole
drive. No network is needed for a layer that a fit must not fill: what is called sky here is sky
almost surely; the ring around leaves and wires is left to the fit, which may put Gaussians there or
not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import scipy

from alpasim_plugin.core.types import F32, U8, Bool
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.fit.tracks import Placed, Tracks
from alpasim_plugin.gaussians.fit.views import PosedView

GAPS = (-3, -2, -1, 1, 2, 3)
SQUARE_PX = 4  # depth is interpolated between points at about every such pixel
STRIDE = 2  # every such pixel is measured, in rows and columns
RESIDUAL_PX = 0.7  # between flow and what the depth predicts
LEAST_SUPPORT = 3  # neighbours that agree; two at the ends of the way
NOISE_PX = 0.25  # of flow
LARGEST_SPREAD = 0.10  # of a depth, as a share of it
NEAR_M = 0.5
FAR_M = 300.0
LEAST_STEP = 1.2  # levels of brightness from pixel to pixel, within two pixels
ROUNDS = 3
FEWEST_POINTS = 12  # that tracks must place in a view
AGREE = 0.06  # share by which the depths of two views may differ


def depth_maps(views: Sequence[PosedView], tracks: Tracks, placed: Placed) -> list[F32]:
    """Return the depth ``(H, W)`` of every view, metres along the optical axis, 0 where unknown and
    between the pixels that are measured; nothing is known of a view in which tracks place too few
    points.

    Args:
        views: In the order of the way, of one size.
        tracks: Over the same views.
        placed: Their points.
    """
    greys = [cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY) for view in views]
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_FAST)  # type: ignore[attr-defined]
    flow.setFinestScale(1)
    out = []
    for i, view in enumerate(views):
        guess = between_points(view.pinhole, tracks, placed, i)
        near = [
            i + gap
            for gap in GAPS
            if 0 <= i + gap < len(views) and views[i + gap].camera.width == view.camera.width
        ]
        if guess is None or len(near) < 2:
            out.append(np.zeros(view.rgb.shape[:2], dtype=np.float32))
            continue
        neighbours = [
            _NeighbourFlow.by_flow(view.pinhole, views[j].pinhole, greys[i], greys[j], guess, flow)
            for j in near
        ]
        out.append(_depth(view, neighbours, guess))
    return [_agreed(views, out, i) for i in range(len(views))]


def between_points(camera: PinholeCamera, tracks: Tracks, placed: Placed, i: int) -> F32 | None:
    """Return inverse depth ``(H, W)`` interpolated between the points that view i shows; None where
    there are too few.
    """
    rows = np.flatnonzero(tracks.view == i)
    local = (
        placed.xyz[tracks.point[rows]] @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]
    )
    good = (placed.error_px[rows] < 1.5) & (local > NEAR_M)
    if good.sum() < FEWEST_POINTS:
        return None
    pixels = tracks.pixel[rows][good]
    q = 1 / local[good]
    # At the middles of the squares for which the enlarging takes them.
    columns = -(-camera.width // SQUARE_PX)
    rows_of_squares = -(-camera.height // SQUARE_PX)
    u, v = np.meshgrid(
        (np.arange(columns) + 0.5) * (camera.width / columns),
        (np.arange(rows_of_squares) + 0.5) * (camera.height / rows_of_squares),
    )
    inside = scipy.interpolate.LinearNDInterpolator(pixels, q)(u, v)
    outside = scipy.interpolate.NearestNDInterpolator(pixels, q)(u, v)
    coarse = np.where(np.isnan(inside), outside, inside).astype(np.float32)
    return cv2.resize(coarse, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)


@dataclass(frozen=True, eq=False)
class _NeighbourFlow:
    """The pixels of a neighbouring view that optical flow matches to the measured pixels.

    Depth 1/q of a measured pixel projects to ``pi(a + q b)`` in the neighbour.

    Attributes:
        a, b: The terms of that projection.
        uv: The matched pixel.
        ok: Whether the match lies in the neighbour's image and before its camera.
    """

    a: F32  # (h, w, 3)
    b: F32  # (3,)
    uv: F32  # (h, w, 2) pixels
    ok: Bool  # (h, w)

    @classmethod
    def by_flow(
        cls,
        camera: PinholeCamera,
        other: PinholeCamera,
        grey: U8,
        other_grey: U8,
        guess: F32,
        flow: cv2.DISOpticalFlow,
    ) -> _NeighbourFlow:
        """Warp the neighbour by the guess, find the rest by flow."""
        v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float32) + np.float32(0.5)
        T = other.T_camera_world @ np.linalg.inv(camera.T_camera_world)
        H = (other.K @ T[:3, :3] @ np.linalg.inv(camera.K)).astype(np.float32)
        b = (other.K @ T[:3, 3]).astype(np.float32)
        a = u[..., None] * H[:, 0] + v[..., None] * H[:, 1] + H[:, 2]
        p = a + guess[..., None] * b
        uv = p[..., :2] / np.maximum(p[..., 2:], 1e-3)
        warped = cv2.remap(
            other_grey,
            uv[..., 0] - 0.5,
            uv[..., 1] - 0.5,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        residual_flow = flow.calc(grey, warped, None)
        x = (u - 0.5 + residual_flow[..., 0])[::STRIDE, ::STRIDE]
        y = (v - 0.5 + residual_flow[..., 1])[::STRIDE, ::STRIDE]
        uv = cv2.remap(uv, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        h, w = other_grey.shape[:2]
        ok = (
            (uv[..., 0] >= 0)
            & (uv[..., 1] >= 0)
            & (uv[..., 0] <= w)
            & (uv[..., 1] <= h)
            & (p[::STRIDE, ::STRIDE, 2] > 0.1)
        )
        return cls(a[::STRIDE, ::STRIDE], b, uv, ok)

    def error(self, q: F32) -> tuple[F32, F32]:
        """Return projection minus flow ``(h, w, 2)`` and its derivative by q."""
        p = self.a + q[..., None] * self.b
        z = np.maximum(p[..., 2:], 1e-3)
        uv = p[..., :2] / z
        return np.asarray(uv - self.uv, dtype=np.float32), np.asarray(
            (self.b[:2] - uv * self.b[2]) / z, dtype=np.float32
        )


def _depth(view: PosedView, neighbours: Sequence[_NeighbourFlow], guess: F32) -> F32:
    """Find each measured pixel's inverse depth from where the neighbours see it, and how far they agree."""
    q = guess[::STRIDE, ::STRIDE].copy()
    for _ in range(ROUNDS):
        H = np.full(q.shape, 1e-9, dtype=np.float32)
        g = np.zeros_like(q)
        for other in neighbours:
            e, J = other.error(q)
            weight = other.ok / np.maximum(np.linalg.norm(e, axis=2), 0.5)
            H += weight * (J * J).sum(axis=2)
            g += weight * (J * e).sum(axis=2)
        q = np.clip(q - g / H, 0.0, 1 / NEAR_M).astype(np.float32)
    support = np.zeros(q.shape, dtype=np.int32)
    information = np.zeros_like(q)
    for other in neighbours:
        e, J = other.error(q)
        good = other.ok & (np.linalg.norm(e, axis=2) < RESIDUAL_PX)
        support += good
        information += good * (J * J).sum(axis=2)
    sigma = NOISE_PX / np.sqrt(np.maximum(information, 1e-12))  # of the inverse depth
    confident = (
        (support >= min(LEAST_SUPPORT, len(neighbours) - 1))
        & (q > 1 / FAR_M)
        & (sigma < LARGEST_SPREAD * q)
    )
    grey = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY)
    step = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)) / 8
    confident &= (cv2.dilate(step, np.ones((5, 5), dtype=np.uint8)) > LEAST_STEP)[
        ::STRIDE, ::STRIDE
    ]
    if view.mask is not None:
        confident &= view.mask[::STRIDE, ::STRIDE]
    depth = np.zeros(view.rgb.shape[:2], dtype=np.float32)
    depth[::STRIDE, ::STRIDE] = np.where(confident, 1 / np.maximum(q, 1e-6), 0)
    return depth


def _agreed(views: Sequence[PosedView], maps: Sequence[F32], i: int) -> F32:
    """Return the depth map without values that neighbours see and none confirms within `AGREE`.

    A pixel that no neighbour's depth map covers keeps its value.
    """
    depth = maps[i]
    rows, columns = np.nonzero(depth)
    camera = views[i].pinhole
    z = depth[rows, columns].astype(np.float64)
    local = camera.unprojected(rows, columns, z)
    confirmed = np.zeros(len(z), dtype=bool)
    covered = np.zeros(len(z), dtype=bool)
    for gap in GAPS:
        if 0 <= i + gap < len(views):
            other = views[i + gap].pinhole
            T = other.T_camera_world @ np.linalg.inv(camera.T_camera_world)
            p = local @ T[:3, :3].T + T[:3, 3]
            ahead = np.maximum(p[:, 2], 1e-3)
            # The nearest measured pixel, whose middle is half a pixel from its corner
            u = p[:, 0] / ahead * other.fx + other.cx - 0.5
            v = p[:, 1] / ahead * other.fy + other.cy - 0.5
            x = np.rint(u / STRIDE).astype(np.int64)
            y = np.rint(v / STRIDE).astype(np.int64)
            small = maps[i + gap][::STRIDE, ::STRIDE]
            inside = (
                (p[:, 2] > 0.1) & (x >= 0) & (y >= 0) & (x < small.shape[1]) & (y < small.shape[0])
            )
            neighbour_depth = np.zeros(len(ahead))
            neighbour_depth[inside] = small[y[inside], x[inside]]
            confirmed |= (neighbour_depth > 0) & (
                np.abs(neighbour_depth - p[:, 2]) < AGREE * p[:, 2]
            )
            covered |= neighbour_depth > 0
    keep = np.zeros(depth.shape, dtype=bool)
    keep[rows, columns] = confirmed | ~covered
    return np.where(keep, depth, 0)


I32 = npt.NDArray[np.int32]

SMOOTH_LEVELS = 5.0  # largest step of brightness to a neighbouring pixel
SMALLEST_SHARE = 0.002  # of the image, of a region
SOLID_SHARE = 0.25  # of a region's measured pixels that have a depth: then it is a wall
COLOUR_LEVELS = 40.0  # by which the sky's colour may differ from its median in all photographs


def sky_masks(views: Sequence[PosedView]) -> list[Bool]:
    """Return where each view shows sky, ``(H, W)`` bool.

    Args:
        views: With depth where it is known: a region that has one is no sky.
    """
    regions = [_regions(view) for view in views]
    sky_colours = [
        view.rgb[region > 0] for view, region in zip(views, regions, strict=True) if region.any()
    ]
    if not sky_colours:
        return [region > 0 for region in regions]
    # Every photograph counts alike, so that one wall that fills an image does not decide.
    usual = np.median([np.median(colours, axis=0) for colours in sky_colours], axis=0)
    return [_of_colour(view, region, usual) for view, region in zip(views, regions, strict=True)]


def _regions(view: PosedView) -> I32:
    """Label smooth regions that reach the top of the image and are not solid."""
    grey = cv2.GaussianBlur(
        cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32), (3, 3), 0
    )
    step = (
        np.maximum(
            np.abs(cv2.Sobel(grey, cv2.CV_32F, 1, 0)), np.abs(cv2.Sobel(grey, cv2.CV_32F, 0, 1))
        )
        / 4
    )
    smooth = (step < SMOOTH_LEVELS) & view.camera.above_horizon()
    if view.mask is not None:
        smooth &= view.mask
    _, label = cv2.connectedComponents(smooth.astype(np.uint8), connectivity=4)
    out = np.zeros(grey.shape, dtype=np.int32)
    measured = None if view.depth is None else view.depth > 0
    for i in set(np.unique(label[0])) - {0}:
        region = label == i
        # Flow spreads depth over the edges of trees into the sky: the inside of a region decides.
        inside = cv2.erode(region.astype(np.uint8), np.ones((9, 9), dtype=np.uint8)) > 0
        solid = (
            0.0
            if measured is None or not inside.any()
            else 4 * float((measured & inside).sum()) / float(inside.sum())
        )
        if region.mean() > SMALLEST_SHARE and solid < SOLID_SHARE:
            out[region] = i
    return out


def _of_colour(view: PosedView, label: I32, usual: F32) -> Bool:
    """Keep regions whose usual colour is that of the sky; a sky grows brighter towards the horizon,
    so single pixels may differ more.
    """
    out = np.zeros(label.shape, dtype=np.uint8)
    for i in set(np.unique(label)) - {0}:
        middle = np.median(view.rgb[label == i].astype(np.float32), axis=0)
        if np.abs(middle - usual).max() < COLOUR_LEVELS:
            out |= (
                (label == i) & (np.abs(view.rgb - middle).max(axis=2) < 1.5 * COLOUR_LEVELS)
            ).astype(np.uint8)
    return cv2.morphologyEx(out, cv2.MORPH_OPEN, np.ones((3, 3), dtype=np.uint8)) > 0
