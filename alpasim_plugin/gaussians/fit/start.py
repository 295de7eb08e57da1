"""Draw the Gaussians that a fit starts from: sparse, noisy surface points from depth.

Published fits start from LiDAR returns (driving) or structure-from-motion points. Rendered views
carry depth; points sampled from it, evenly over the image, with a range error along the ray, stand
for LiDAR returns accumulated over the drive. Returns inside an actor's box are carried to the
actor's frame and belong to it, as in Street Gaussians. Photographs without depth are matched
(SIFT).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import scipy

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse, transform_points
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64, Box
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.gaussians.sh import dc_from_rgb

RANGE_ERROR_M = 0.03  # spread of a point along its ray
RANGE_ERROR_SHARE = 0.004  # further spread, as a share of its distance
# points this far outside an actor's sides still belong to it; below, its box ends this far above
# the ground
BOX_MARGIN_M = 0.1
START_OPACITY = 0.3
SMALLEST_M = 0.01
LARGEST_M = 3.0
FEWEST_POINTS = 4  # an actor seen less often gets no model
# an actor's points are sampled this many times as densely as the background, because they are few
# and seen from near
DENSER = 8
NEIGHBOURS = 4  # of the next photographs
FEATURES = 2500  # SIFT keypoints
RATIO = 0.75  # Lowe's ratio test
_Points = tuple[F64, F64]  # (N, 3) places, metres; (N, 3) colours 0..1


@dataclass(frozen=True, eq=False)
class Start:
    """What a fit begins with.

    Attributes:
        background: World coordinates.
        actors: Actor id to Gaussians in its box frame.
    """

    background: GaussianCloud
    actors: Mapping[str, GaussianCloud]


def start_from_depth(
    views: Sequence[PosedView],
    boxes: Mapping[str, Box],
    count: int,
    scene_id: str,
    seed: int,
    actor_points: int = 400,
) -> Start:
    """Sample ``count`` surface points from the views' depth, and more on actors.

    Args:
        views: With depth.
        boxes: Size of each actor that a view may show.
        count: Points of the background, shared evenly by the views.
        scene_id, seed: Key of the sample.
        actor_points: Most points of an actor.

    Raises:
        InputError: No view has depth.
    """
    owned: dict[str, list[_Points]] = {name: [] for name in sorted(boxes)}
    background = []
    for i, view in enumerate(views):
        share = count * (i + 1) // len(views) - count * i // len(views)
        points, rgb = _sample(
            view, DENSER * share, stream(scene_id, seed, f"fit.start.view.{view.name}")
        )
        free = np.ones(len(points), dtype=bool)
        for actor_id in sorted(set(view.actors) & set(boxes)):
            local = transform_points(inverse(view.actors[actor_id]), points)
            box = boxes[actor_id]
            half = np.array(box.size_m) / 2 + BOX_MARGIN_M
            above_ground = local[:, 2] > -box.height_m / 2 + BOX_MARGIN_M / 2
            in_box = free & (np.all(np.abs(local) <= half, axis=1) & above_ground)
            owned[actor_id].append((local[in_box], rgb[in_box]))
            free &= ~in_box
        free[share:] = False  # the sample is in random order: its first part is a sample too
        background.append((points[free], rgb[free]))
    if not sum(len(points) for points, _ in background):
        raise InputError(
            f"{len(views)} views: no pixel with depth",
            "give views with depth, or a file of points to start from",
        )
    actors = {}
    for name, pieces in owned.items():
        points, rgb = _joined(pieces)
        rng = stream(scene_id, seed, f"fit.start.{name}")
        chosen = rng.permutation(len(points))[:actor_points]
        if len(chosen) >= FEWEST_POINTS:
            actors[name] = cloud_from_points(points[chosen], rgb[chosen])
    return Start(cloud_from_points(*_joined(background)), actors)


def start_from_maps(
    views: Sequence[PosedView],
    more: Sequence[PosedView],
    count: int,
    scene_id: str,
    seed: int,
    size: float = 1.0,
) -> GaussianCloud:
    """Draw ``count`` points, the same number from each view, from depth that was measured in
    photographs.

    Args:
        views: With depth where it was measured.
        more: The same views with depth where it can only be guessed: one point in six comes from
            there.
        count: Points in all.
        scene_id, seed: Key of the sample.
        size: See `cloud_from_points`.
    """
    parts = []
    for view, guess in zip(views, more, strict=True):
        rng = stream(scene_id, seed, f"fit.start.view.{view.name}")
        share = count // len(views)
        parts += [_drawn(view, share - share // 6, rng), _drawn(guess, share // 6, rng)]
    return cloud_from_points(*_joined(parts), size)


def _drawn(view: PosedView, count: int, rng: np.random.Generator) -> _Points:
    """Return measured points as they are, ``(n, 3)``, world, and the model's colours there."""
    points, rgb = _sample(view, count, rng, noise=False)
    return points, (rgb / np.array(view.gain)).clip(0, 1)


def start_in_boxes(
    boxes: Mapping[str, Box], count: int, scene_id: str, seed: int
) -> dict[str, GaussianCloud]:
    """Return ``count`` grey Gaussians spread over each actor's box, in its frame: a start where no
    depth says where its surface is.
    """
    clouds = {}
    for name, box in boxes.items():
        half = np.array(box.size_m) / 2
        points = stream(scene_id, seed, f"fit.start.{name}").uniform(-half, half, (count, 3))
        clouds[name] = cloud_from_points(points, np.full((count, 3), 0.5))
    return clouds


def cloud_from_points(points: F64, rgb: F64, size: float = 1.0) -> GaussianCloud:
    """Return round Gaussians at points ``(N, 3)`` of colours ``(N, 3)`` 0..1.

    Their standard deviation is ``size`` times the root mean square distance to three neighbours: 1
    is that of 3D Gaussian Splatting, whose opacity of 0.1 is too slow a start for some hundred
    steps.
    """
    n = len(points)
    if n > 1:
        distance, _ = scipy.spatial.KDTree(points).query(points, k=min(4, n))
        sigma = (size * np.sqrt(np.mean(distance[:, 1:] ** 2, axis=1))).clip(SMALLEST_M, LARGEST_M)
    else:
        sigma = np.full(n, LARGEST_M / 10)
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    return GaussianCloud(
        points,
        quats,
        np.repeat(sigma[:, None], 3, axis=1),
        np.full(n, START_OPACITY),
        dc_from_rgb(rgb)[:, None, :],
    )


def _sample(view: PosedView, count: int, rng: np.random.Generator, noise: bool = True) -> _Points:
    """Return points in random order, ``(n, 3)``, world, and their colours ``(n, 3)``."""
    if view.depth is None:
        return np.zeros((0, 3)), np.zeros((0, 3))
    good = (view.depth > 0) & (True if view.mask is None else view.mask)
    pixels = np.flatnonzero(good)
    pixels = pixels[rng.permutation(len(pixels))[:count]]
    rows, columns = np.divmod(pixels, view.camera.width)
    z = view.depth[rows, columns].astype(np.float64)
    if noise:
        z += rng.standard_normal(len(z)) * (RANGE_ERROR_M + RANGE_ERROR_SHARE * z)
    local = view.camera.unprojected(rows, columns, z)
    return transform_points(inverse(view.camera.T_camera_world), local), view.rgb[
        rows, columns
    ] / 255.0


def _joined(parts: Sequence[_Points]) -> _Points:
    none = np.zeros((0, 3))
    return np.concatenate([none, *(points for points, _ in parts)]), np.concatenate(
        [none, *(rgb for _, rgb in parts)]
    )


class Match(NamedTuple):
    """A point that two photographs show: their indices, and where, in pixels of their views
    ``(2,)``.
    """

    first: int
    second: int
    at_first: F64
    at_second: F64


def matches(views: Sequence[PosedView]) -> list[Match]:
    """Match points between each view and the next `NEIGHBOURS`: SIFT, nearest neighbours in both
    directions, ratio test.
    """
    # Without the precise scaling every point lies a quarter of a pixel too far right and down.
    sift = cv2.SIFT_create(FEATURES, enable_precise_upscale=True)  # type: ignore[attr-defined]
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    features = []
    for view in views:
        points, described = sift.detectAndCompute(cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY), None)
        features.append((np.array([point.pt for point in points]).reshape(-1, 2) + 0.5, described))
    out = []
    for i in range(len(views)):
        for j in range(i + 1, min(i + 1 + NEIGHBOURS, len(views))):
            (at_i, describes_i), (at_j, describes_j) = features[i], features[j]
            if describes_i is None or describes_j is None or len(at_i) < 2 or len(at_j) < 2:
                continue
            back = {
                match.queryIdx: match.trainIdx
                for (match,) in matcher.knnMatch(describes_j, describes_i, k=1)
            }
            for best, second in matcher.knnMatch(describes_i, describes_j, k=2):
                if best.distance < RATIO * second.distance and back[best.trainIdx] == best.queryIdx:
                    out.append(Match(i, j, at_i[best.queryIdx], at_j[best.trainIdx]))
    return out
