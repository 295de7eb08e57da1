"""Detect a semantic map that does not match the rendered image.

A fixer draws what a map shows, so a wrong map would make it draw a wrong road.

Lane markings are brighter than the road on both sides of them. The lines of the drawn map are laid
over the image, and each piece of a line in a row of pixels is compared with equal pieces to its
left and right: how often is it the brighter one in the image's white top hat, which keeps what is
narrower than `MARKING_SHARE` of the width? By chance in half of the comparisons, nearly always
where the line is in the image. That share is the *agreement* of a map.

An image without lane markings (an unmarked street, glare, a poor reconstruction) is no evidence
against the map. A map is contradicted where its agreement is below `DOUBT` and the same lines,
shifted by one of `LATERAL_OFFSETS_M`, reach `FITS`: then the image shows the markings elsewhere. A
map of another street whose lines fit nowhere cannot be distinguished from a street without
markings. A blurred reconstruction keeps lane markings at their recorded pixels when the camera
moves sideways; a shift within `UNMOVED_M` of the camera's own lateral offset is therefore ignored.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from alpasim_plugin.core.geometry import project
from alpasim_plugin.core.types import F64, U8, Bool, CameraSpec, LaneMap
from alpasim_plugin.fixers.semantic_map.draw import draw_map
from alpasim_plugin.fixers.semantic_map.prepare import ActorBox, PreparedMap, prepare_map

WIDTH_PX = 480  # images are compared at this width
MARKING_SHARE = 0.035  # of the width: what is broader is no lane marking
# of the width: a run of line colour that is broader is a line across the view, without sides
WIDEST_SHARE = 0.08
NEIGHBOURS = (-4, -3, -2, 2, 3, 4)  # pieces beside a line, in its own widths
LEAST_PIECES = 40  # of lines in rows; fewer say nothing
DOUBT = 0.56
FITS = 0.64
NOTHING = prepare_map(LaneMap({}))
LATERAL_OFFSETS_M = (-2.2, -1.75, -1.3, -0.9, 0.9, 1.3, 1.75, 2.2)
UNMOVED_M = 0.45


@dataclass(frozen=True)
class Pieces:
    """Where lines of a drawn map cross rows of pixels: row, first column and one past the last,
    ``(N,)`` each.
    """

    row: np.ndarray
    first: np.ndarray
    end: np.ndarray


@dataclass(frozen=True)
class Contradiction:
    """An image that shows a map's lines beside where the map has them.

    Attributes:
        unmoved, best: Agreement where the map has its lines, and at the place that fits best.
        offset_m: How far that is to the left, metres.
    """

    unmoved: float
    best: float
    offset_m: float


def contradiction(
    scene_map: PreparedMap,
    camera: CameraSpec,
    T_world_camera: F64,
    boxes: Sequence[ActorBox],
    rgb: U8,
    camera_offset_m: float = 0.0,
) -> Contradiction | None:
    """Compare an image with the map; None: they do not contradict each other.

    Args:
        scene_map: The map.
        camera: The pinhole that made the image.
        T_world_camera: ``(4, 4)``.
        boxes: Road users, which hide lines.
        rgb: ``(H, W, 3)`` the image.
        camera_offset_m: How far to the left of the recorded path the camera stands (`beside`).
    """
    small = shrunk(camera)
    markings = top_hat(cv2.resize(rgb, (small.width, small.height), interpolation=cv2.INTER_AREA))
    open_road = ~draw_map(NOTHING, small, T_world_camera, boxes).any(axis=2)

    def agreement_at(offset_m: float) -> float | None:
        T = T_world_camera.copy()
        # who stands to the right sees the lines to the left
        T[:3, 3] -= offset_m * leftwards(T_world_camera)
        return agreement(
            pieces_of(line_pixels(draw_map(scene_map, small, T)) & open_road),
            markings,
        )

    return decided(agreement_at, camera_offset_m)


def decided(
    agreement_at: Callable[[float], float | None], camera_offset_m: float
) -> Contradiction | None:
    """Decide from the agreement of a map's lines, moved to the left by some metres, and where the
    camera stands.
    """
    unmoved = agreement_at(0.0)
    if unmoved is None or unmoved >= DOUBT:
        return None
    best, offset_m = max(
        (agreement_at(offset_m) or 0.0, offset_m)
        for offset_m in LATERAL_OFFSETS_M
        if abs(offset_m - camera_offset_m) > UNMOVED_M
    )
    return Contradiction(unmoved, best, offset_m) if best >= FITS else None


def shrunk(camera: CameraSpec) -> CameraSpec:
    """Return the camera of an image `WIDTH_PX` wide, or of the image itself where it is no
    wider.
    """
    if camera.width <= WIDTH_PX:
        return camera
    size = WIDTH_PX, max(round(camera.height * WIDTH_PX / camera.width), 1)
    return replace(
        camera,
        width=size[0],
        height=size[1],
        K=np.diag([size[0] / camera.width, size[1] / camera.height, 1.0]) @ camera.K,
    )


def leftwards(T_world_camera: F64) -> F64:
    """Return the horizontal direction ``(3,)`` to the left of a camera."""
    ahead = T_world_camera[:2, 2]
    left = np.array([-ahead[1], ahead[0], 0.0])
    return left / max(float(np.linalg.norm(left)), 1e-9)


def beside(path: F64, T_world_rig: F64, T_world_camera: F64) -> float:
    """Return how far a rig stands beside the recorded path ``(N, 2+)``, metres along the camera's
    left.

    Example:
        >>> ahead = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
        >>> beside(np.array([[0.0, 0], [9, 0]]), np.array([[1.0, 0, 0, 4], [0, 1, 0, 2], [0, 0, 1, 0], [0, 0, 0, 1]]), ahead)
        2.0
    """
    rig = T_world_rig[:2, 3]
    _, left_of_path_m = project(path, rig)
    # How far one metre to the camera's left goes to the path's left.
    _, moved_m = project(path, rig + leftwards(T_world_camera)[:2])
    return left_of_path_m * (moved_m - left_of_path_m)


def line_pixels(image: U8) -> Bool:
    """Return the pixels ``(H, W)`` of a drawn map that are lane markings: white or yellow, however
    faded.
    """
    red, green, blue = (image[..., channel].astype(np.int16) for channel in range(3))
    top = np.maximum(np.maximum(red, green), blue)
    is_bright = (top >= 60) & (red * 10 >= top * 9) & (green * 10 >= top * 9)
    return is_bright & ((blue * 10 >= top * 9) | (blue * 10 <= top * 2))


def top_hat(rgb: U8) -> U8:
    """Return how much brighter ``(H, W)`` each pixel is than what lies on both sides of it in its
    row.
    """
    side = max(5, int(rgb.shape[1] * MARKING_SHARE) | 1)
    bright = np.ascontiguousarray(rgb[..., :2].max(axis=2))  # white and yellow markings alike
    return cv2.morphologyEx(bright, cv2.MORPH_TOPHAT, np.ones((1, side), dtype=np.uint8))


def pieces_of(lines: Bool) -> Pieces:
    """Return the runs of line pixels, row by row."""
    step = np.diff(np.pad(lines.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    (row, first), (_, end) = np.nonzero(step == 1), np.nonzero(step == -1)
    fits = (end - first >= 2) & (end - first <= WIDEST_SHARE * lines.shape[1])
    return Pieces(row[fits], first[fits], end[fits])


def agreement(pieces: Pieces, markings: U8) -> float | None:
    """Return how often a piece of a line is brighter than a piece beside it, 0 to 1; ties count
    half. None: too few pieces.

    Example:
        >>> markings = np.zeros((60, 90), np.uint8)
        >>> markings[:, 41] = 9
        >>> rows, ones = np.arange(60), np.ones(60, int)
        >>> agreement(Pieces(rows, 40 * ones, 43 * ones), markings), agreement(Pieces(rows, 50 * ones, 53 * ones), markings)
        (1.0, 0.4166666666666667)
    """
    if len(pieces.row) < LEAST_PIECES:
        return None
    width = markings.shape[1]
    size = pieces.end - pieces.first
    line_peak = _brightest(markings, pieces.row, pieces.first, pieces.end)
    wins = compared = 0.0
    for times in NEIGHBOURS:
        first = pieces.first + times * size
        end = pieces.end + times * size
        inside = (first >= 0) & (end <= width)
        beside = _brightest(markings, pieces.row[inside], first[inside], end[inside])
        wins += float(
            np.sum(line_peak[inside] > beside) + 0.5 * np.sum(line_peak[inside] == beside)
        )
        compared += float(inside.sum())
    return wins / compared if compared else None


def _brightest(markings: U8, row: np.ndarray, first: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the largest value of each run."""
    if not len(row):
        return np.zeros(0, dtype=np.uint8)
    flat = np.append(markings.ravel(), np.uint8(0))  # so that a run may end with the image
    places = np.stack(
        [row * markings.shape[1] + first, row * markings.shape[1] + end], axis=1
    ).ravel()
    return np.maximum.reduceat(flat, places)[::2]
