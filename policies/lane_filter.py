"""Lane tracking: a Kalman filter whose measurements are points of lane markings.

In the rig frame the lane's centre is ``y(x) = offset + heading x + curvature x^2 / 2 + bend x^3 /
6`` (the cubic of a clothoid for small angles; Dickmanns and Mysliwetz 1992) and its two painted
borders lie half a width to either side, measured across the lane. All five numbers are carried with
their covariance: the ego's own motion predicts them, every point of a marking near a border
corrects them, and a frame with many points therefore counts for more than a frame with little.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.types import F64, Bool
from policies.road_vision import PaintPoints

OFFSET, HEADING, CURVATURE, BEND, WIDTH = range(5)
MEAN_WIDTH_M = 3.5
# Histograms of lane-marking pixels over the lateral position.
HALF_M = 7.0
CELL_M = 0.1
CELLS = round(2 * HALF_M / CELL_M)
WIDTH_MEMORY_M = (
    40.0  # a border that is not seen is assumed at the mean width again after some such lengths
)
ONE_SIDED_M = 1.0
START_SIGMA = np.array([0.3, 0.05, 0.02, 1e-3, 0.3])
# Standard deviations per square root of a metre driven: how fast roads change.
DRIFT_PER_SQRT_M = np.array([0.03, 0.01, 0.004, 4e-4, 0.03])
CORRELATION = (
    4.0  # neighbouring points of one stroke share their error; this many of them are worth one
)
SHAPE_ERROR_1PM = 0.0008  # a cubic misses a real road by about this times x^2
GATE_M = (0.3, 0.7)
ITERATIONS = 3
MAX_RANGE_M = 45.0


@dataclass(frozen=True)
class LaneState:
    """An estimate of the ego's lane in the rig frame."""

    mean: F64  # (5,): offset m, heading rad, curvature 1/m, bend 1/m^2, width m
    cov: F64  # (5, 5)
    left_m: float = 0.0  # metres of lane markings seen in the newest frame on the left border
    right_m: float = 0.0
    seen_to_m: float = 0.0  # distance up to which lane markings support the shape
    blind_m: float = 0.0  # metres driven since lane markings were last seen

    def centre(self, x_m: F64) -> F64:
        """Return the lateral position (K,) of the lane's centre at distances (K,)."""
        return _basis(x_m) @ self.mean[:4]

    def sigma(self, x_m: F64) -> F64:
        """Return the standard deviation (K,) of `centre`, growing beyond the lane markings that
        were seen.
        """
        basis = _basis(x_m)
        var = np.einsum("ki,ij,kj->k", basis, self.cov[:4, :4], basis)
        beyond = np.maximum(x_m - self.seen_to_m, 0.0)
        return np.sqrt(
            np.maximum(var, 0.0) + (SHAPE_ERROR_1PM * x_m**2) ** 2 + (0.06 * beyond) ** 2
        )

    def slope(self, x_m: F64 | float) -> F64:
        """Return dy/dx (K,) of the centre, or () at one distance."""
        _, heading, curvature, bend, _ = self.mean.tolist()
        return heading + curvature * x_m + 0.5 * bend * (x_m * x_m)


def start(
    offset_m: float, heading_rad: float, curvature_1pm: float, width_m: float = MEAN_WIDTH_M
) -> LaneState:
    """Return a fresh estimate with the starting uncertainty."""
    return LaneState(
        np.array([offset_m, heading_rad, curvature_1pm, 0.0, width_m]), np.diag(START_SIGMA**2)
    )


def predict(lane: LaneState, forward_m: float, left_m: float, turn_rad: float) -> LaneState:
    """Move the estimate into the rig frame after the ego moved by (forward, left) and turned by
    ``turn_rad``.
    """
    d = forward_m
    transition = np.eye(5)
    transition[OFFSET, :4] = [1.0, d, d * d / 2, d**3 / 6]
    transition[HEADING, 1:4] = [1.0, d, d * d / 2]
    transition[CURVATURE, 2:4] = [1.0, d]
    mean = transition @ lane.mean
    mean[OFFSET] -= left_m
    mean[HEADING] -= turn_rad
    mean[WIDTH] = MEAN_WIDTH_M + (mean[WIDTH] - MEAN_WIDTH_M) * np.exp(-abs(d) / WIDTH_MEMORY_M)
    noise = DRIFT_PER_SQRT_M**2 * abs(d) + np.array([0.003, 0.0005, 0, 0, 0]) ** 2
    cov = transition @ lane.cov @ transition.T + np.diag(noise)
    return replace(
        lane,
        mean=mean,
        cov=cov,
        left_m=0.0,
        right_m=0.0,
        seen_to_m=max(lane.seen_to_m - d, 0.0),
        blind_m=lane.blind_m + abs(d),
    )


def update(lane: LaneState, points: PaintPoints, row_m: F64) -> LaneState:
    """Correct the estimate by points of lane markings.

    Each point belongs to the nearer border if it lies within a gate; inside the gate a Cauchy
    weight lets outliers fade. A few rounds, as association and weights depend on the estimate.

    Args:
        lane: The predicted estimate.
        points: Lane markings in the rig frame.
        row_m: (N,) length of road that each point covers.
    """
    near = points.x_m < MAX_RANGE_M
    x = points.x_m[near]
    y = points.y_m[near]
    if not len(x):
        return lane
    var = CORRELATION * (points.sigma_m[near] ** 2 + (SHAPE_ERROR_1PM * x**2) ** 2)
    basis = _basis(x)
    jacobian = np.empty((len(x), 5))
    jacobian[:, :4] = basis
    information = np.linalg.inv(lane.cov)
    mean = lane.mean
    for iteration in range(ITERATIONS):
        residual, jacobian[:, WIDTH], _ = _residuals(mean, x, y, basis)
        gate = GATE_M[0] + (GATE_M[1] - GATE_M[0]) / (1 + iteration)
        spread = 0.1 + np.sqrt(var / CORRELATION)
        weight = (
            np.where(np.abs(residual) < gate, 1.0 / (1.0 + (residual / spread) ** 2), 0.0) / var
        )
        weighted = jacobian * weight[:, None]
        # Gauss-Newton on prior and points together: the information form of the Kalman update.
        total = information + jacobian.T @ weighted
        mean = mean + np.linalg.solve(
            total, weighted.T @ residual + information @ (lane.mean - mean)
        )
    residual, _, side = _residuals(mean, x, y, basis)
    used = np.abs(residual) < GATE_M[0]
    rows = row_m[near]
    left = _length(x, rows, used & (side > 0))
    right = _length(x, rows, used & (side < 0))
    is_seen = left + right > 2.0
    far = float(np.percentile(x[used], 95)) if is_seen else lane.seen_to_m
    return LaneState(
        mean,
        np.asarray(np.linalg.inv(total)),
        left,
        right,
        max(far, 0.0),
        0.0 if is_seen else lane.blind_m,
    )


def shift(lane: LaneState, lanes_left: int) -> LaneState:
    """Return the estimate of a neighbouring lane of the same width, positive to the left."""
    mean = lane.mean.copy()
    cov = lane.cov.copy()
    mean[OFFSET] += lanes_left * mean[WIDTH]
    cov[OFFSET, OFFSET] += 0.3**2
    return replace(lane, mean=mean, cov=cov)


def _cells(lateral_m: F64) -> npt.NDArray[np.intp]:
    """Return the numbers of histogram cells at lateral positions; those outside have none of it."""
    return np.floor((lateral_m + HALF_M) / CELL_M).astype(np.intp)


def _paint_histograms(lateral_m: F64, paint: F64) -> F64:
    """Return how much paint ``(S, CELLS)`` lies at each lateral position under each shape of the
    lane, smoothed over neighbouring cells.

    Args:
        lateral_m: ``(S, N)`` of points under each shape.
        paint: ``(N,)`` weight of the points.
    """
    bins = _cells(lateral_m)
    valid = (bins >= 0) & (bins < CELLS)
    flat = (np.arange(len(bins))[:, None] * CELLS + bins)[valid]
    weights = np.broadcast_to(paint, bins.shape)[valid]
    histogram = np.bincount(flat, weights, len(bins) * CELLS).reshape(len(bins), CELLS)
    padded = np.pad(histogram, ((0, 0), (1, 1)))
    return histogram + 0.5 * (padded[:, :-2] + padded[:, 2:])


def search(
    points: PaintPoints, row_m: F64, offset_m: float, heading_rad: float, curvature_1pm: float
) -> LaneState | None:
    """Find the lane in one frame around a rough guess; None where lane markings do not show one.

    For every heading and curvature on a small grid lane markings are collapsed along the curve into
    a histogram over the lateral position; where the curve is right the piles are sharp. In the
    sharpest histogram the pair of piles that is a lane wide and nearest to the guess wins.
    """
    near = points.x_m < 30.0
    x = points.x_m[near]
    y = points.y_m[near]
    paint = row_m[near] * np.minimum(points.strength[near], 2.0) / 2.0
    if paint.sum() < 3.0:
        return None
    headings = heading_rad + np.linspace(-0.16, 0.16, 9)
    curvatures = curvature_1pm + np.array([-0.03, -0.015, -0.006, 0.0, 0.006, 0.015, 0.03])
    shapes = np.array([(h, c) for h in headings for c in curvatures])
    lateral = y[None, :] - shapes[:, :1] * x - shapes[:, 1:] * x**2 / 2
    histogram = _paint_histograms(lateral, paint)
    # Prefer the guess where lane markings are ambiguous.
    doubt = ((shapes[:, 0] - heading_rad) / 0.15) ** 2 + (
        (shapes[:, 1] - curvature_1pm) / 0.03
    ) ** 2
    best = int(np.argmax(np.sum(histogram**2, axis=1) / (1.0 + 0.1 * doubt)))
    pile = histogram[best]
    widths = np.arange(2.6, 4.7, 0.1)
    centres = np.arange(-4.0, 4.0 + 1e-9, CELL_M)
    left = pile[_cells(centres[:, None] + widths / 2).clip(0, CELLS - 1)]
    right = pile[_cells(centres[:, None] - widths / 2).clip(0, CELLS - 1)]
    score = (
        np.minimum(left, 6.0) + np.minimum(right, 6.0) + np.minimum(np.minimum(left, right), 3.0)
    )
    score = (
        score
        - 1.5 * ((centres[:, None] - offset_m) / 0.8) ** 2
        - 0.5 * ((widths - MEAN_WIDTH_M) / 0.4) ** 2
    )
    i, j = np.unravel_index(int(np.argmax(score)), score.shape)
    if left[i, j] + right[i, j] < 3.0 or abs(centres[i] - offset_m) > 2.0:
        return None
    centre = float(centres[i])
    width = float(widths[j])
    if min(left[i, j], right[i, j]) < ONE_SIDED_M:
        # One border does not determine the width: use the mean width from the border that is seen.
        side = 1.0 if left[i, j] > right[i, j] else -1.0
        centre = centre + side * (width - MEAN_WIDTH_M) / 2
        width = MEAN_WIDTH_M
    return start(centre, float(shapes[best, 0]), float(shapes[best, 1]), width)


def _residuals(mean: F64, x: F64, y: F64, basis: F64) -> tuple[F64, F64, F64]:
    """Return residual (N,), its derivative by the width (N,), and side (N,) of the points against
    the nearer border.
    """
    centre = basis @ mean[:4]
    slope = mean[HEADING] + mean[CURVATURE] * x + 0.5 * mean[BEND] * x**2
    stretch = np.sqrt(1 + slope**2)  # the width is measured across the lane, not across the rig
    away = y - centre
    side = np.copysign(1.0, away)
    half = 0.5 * side * stretch
    return away - half * mean[WIDTH], half, side


def _length(x: F64, rows: F64, used: Bool) -> float:
    """Return the metres of road over which at least one used point lies."""
    used_rows = x[used]
    is_new = np.ones(len(used_rows), dtype=bool)
    np.not_equal(used_rows[1:], used_rows[:-1], out=is_new[1:])
    return float(rows[used][is_new].sum())


def _basis(x: F64) -> F64:
    out = np.ones((*x.shape, 4))
    out[..., 1], out[..., 2], out[..., 3] = x, x**2 / 2, x**3 / 6
    return out
