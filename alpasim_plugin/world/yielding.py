"""Who will come into a driver's way within the next seconds, and how to stay behind them."""

from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.types import F64, Bool, Box
from alpasim_plugin.world.idm import BEHIND_M, Bodies, bodies_from, spans
from alpasim_plugin.world.path import Lines

TIMES_S = np.arange(0.0, 4.01, 0.5)  # now and ahead
HORIZON_M = 80.0
SIDE_M = 0.3
MIN_GAP_M = 2.5


@dataclass(frozen=True)
class PredictedBodies:
    """Road users now (first row) and after each further time of `TIMES_S`."""

    xy: F64  # (1 + n, K, 2)
    yaw: F64  # (1 + n, K)
    velocity: F64  # (1 + n, K, 2)
    present: Bool  # (1 + n, K)
    boxes: tuple[Box, ...]
    z: F64  # (1 + n, K) of the centre
    yields: Bool  # (K,) reactive: it lets the ego go first when it is behind

    def now(self) -> Bodies:
        """Return the road users that are there now."""
        columns = np.flatnonzero(self.present[0])
        boxes = [self.boxes[k] for k in columns]
        return bodies_from(
            self.xy[0, columns],
            self.yaw[0, columns],
            boxes,
            self.velocity[0, columns],
            self.z[0, columns],
        )


def yielding_acceleration(
    line: Lines,
    front_s: float,
    speed_mps: float,
    box: Box,
    ahead: PredictedBodies,
) -> float:
    """Return the largest acceleration that keeps behind everyone who will come into the corridor;
    infinite without such a one.

    `MIN_GAP_M` is kept from a standing body; half a second is added for a moving one. For a body that
    will be in the corridor after ``tau`` seconds with its rear at ``r``, the own
    front must then not be beyond ``r - gap``: with constant acceleration ``a <= 2 (r - gap - front
    - v tau) / tau^2``. Not counted are bodies that are in the corridor already (they are followed,
    or come from behind), bodies that the ego will have passed by then, and reactive cars that are
    behind the own front now (they are the ones to yield).

    Args:
        line: The ego's line, alone.
        front_s: Arc length of the front bumper.
        speed_mps: Own speed.
        box: Ego body.
        ahead: Everyone who moves.
    """
    n, k = ahead.yaw.shape
    if k == 0:
        return float("inf")
    everybody = bodies_from(
        ahead.xy.reshape(-1, 2),
        ahead.yaw.reshape(-1),
        ahead.boxes * n,
        ahead.velocity.reshape(-1, 2),
        ahead.z,
    )
    window = np.array([front_s - BEHIND_M, front_s + HORIZON_M])
    row = np.arange(n * k)
    low, high = line.stations(0 * row, np.repeat(window[0], n * k), np.repeat(window[1], n * k))
    span = spans(line, 0 * row, everybody, row, low, high)
    half = box.width_m / 2 + SIDE_M
    rear, front, speed = (array.reshape(n, k) for array in (span.rear, span.front, span.speed))
    inside = ((span.low < half) & (span.high > -half)).reshape(n, k) & ahead.present
    inside &= span.on_level.reshape(n, k)
    inside &= (rear > window[0]) & (rear < window[1])
    tau = TIMES_S[:, None]
    passed = front < front_s + speed_mps * tau - box.length_m - 1.0
    behind = ahead.yields & (rear[0] < front_s + 0.5)
    counts = inside & ~passed & (front >= front_s) & ~inside[0] & ~behind & ahead.present[0]
    counts[0] = False
    if not counts.any():
        return float("inf")
    allowed = rear - (MIN_GAP_M + 0.5 * speed) - front_s - speed_mps * tau
    return float(np.min(2.0 * allowed[counts] / np.broadcast_to(tau, counts.shape)[counts] ** 2))
