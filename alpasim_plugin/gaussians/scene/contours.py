"""Follow level lines of a plan raster: the lines along which kerbs, trees, poles and facades stand."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from alpasim_plugin.core.geometry import arc_lengths, resample
from alpasim_plugin.core.types import F64, Bool
from alpasim_plugin.gaussians.scene.site import CELL_M, Site

SMOOTH = 9  # points of the moving average that takes the raster's steps out of a contour


class Roadside(NamedTuple):
    """Places along a line beside the road, ground coordinates."""

    xy: F64  # (N, 2) metres
    along: F64  # (N, 2) unit, road on the left
    away: F64  # (N, 2) unit, from the road


def contours(site: Site, beyond_m: float, within_path_m: float) -> list[F64]:
    """Return the lines ``(N, 2)`` where the distance to the road is ``beyond_m``, in ground coordinates, the road on their left.

    Args:
        site: What lies where.
        beyond_m: Distance from the road's edge, metres.
        within_path_m: Lines are cut where they are farther than this from the path.
    """
    off = site.off_road_m if beyond_m > 0 else site.off_road_m - site.inside_m
    mask = (off > beyond_m).astype(np.uint8)
    found, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    near = site.path_m < within_path_m
    lines: list[F64] = []
    for ring in found:
        pixels = ring[:, 0, :]
        if len(pixels) < 4 * SMOOTH:
            continue
        plan = site.low + (pixels + 0.5) * CELL_M
        wrapped = np.concatenate([plan[-SMOOTH:], plan, plan[:SMOOTH]])
        kernel = np.ones(SMOOTH) / SMOOTH
        smooth = np.stack([np.convolve(wrapped[:, d], kernel, mode="same") for d in range(2)], axis=1)[SMOOTH:-SMOOTH]
        h, w = mask.shape
        inner = (pixels[:, 0] > 1) & (pixels[:, 0] < w - 2) & (pixels[:, 1] > 1) & (pixels[:, 1] < h - 2)
        keep = inner & near[pixels[:, 1], pixels[:, 0]]
        lines += [_road_on_left(site, part) for part in _runs(smooth, keep) if len(part) > 8]
    return lines


def _runs(points: F64, keep: Bool) -> list[F64]:
    """Cut a closed line into the pieces where ``keep`` holds."""
    if keep.all():
        return [np.concatenate([points, points[:1]])]
    start = int(np.argmin(keep))
    points, keep = np.roll(points, -start, axis=0), np.roll(keep, -start)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], keep.astype(np.int8), [0]])))
    return [points[a:b] for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _road_on_left(site: Site, line: F64) -> F64:
    """Turn a line so that the road lies to its left; which side it is on is voted by all points."""
    d = np.gradient(line, axis=0)
    left = np.stack([-d[:, 1], d[:, 0]], axis=1) / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-9)
    signed = site.off_road_m - site.inside_m
    nearer = site.look_up(signed, line + left).astype(np.float64) < site.look_up(signed, line - left).astype(np.float64)
    return line if np.mean(nearer) >= 0.5 else line[::-1].copy()


def places(line: F64, spacing_m: float, first_m: float = 0.0) -> Roadside:
    """Return places every ``spacing_m`` along a line that has the road on its left."""
    s = np.arange(first_m, float(arc_lengths(line)[-1]), spacing_m)
    xy = resample(line, s)
    d = resample(line, s + 0.5) - resample(line, s - 0.5)
    along = d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-9)
    return Roadside(xy, along, np.stack([along[:, 1], -along[:, 0]], axis=1))
