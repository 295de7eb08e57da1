"""Numbers of a page: whole centimetres, milliseconds and milliradians, counted from the scene's own origin and first frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.geometry import yaw_from_quat
from alpasim_plugin.core.types import F64, I64, Trajectory

METRIC_DIGITS = 5


@dataclass(frozen=True)
class Place:
    """Where and when a scene's page counts from.

    Attributes:
        origin: ``(2,)`` metres, world: the first point of the recorded drive.
        zero_us: The first camera frame (`evaluators.report.rollouts.clock_zero_us`), on the scene's clock.
    """

    origin: F64
    zero_us: int

    def cm(self, xy: npt.ArrayLike) -> list[list[int]]:
        """Return ``(N, 2)`` world metres as x and y in whole centimetres."""
        scaled = np.rint((np.asarray(xy, dtype=np.float64).reshape(-1, 2) - self.origin) * 100.0).astype(int)
        return [scaled[:, 0].tolist(), scaled[:, 1].tolist()]

    def ms(self, t_us: I64 | Sequence[int]) -> list[int]:
        """Return times ``(N,)`` in whole milliseconds."""
        ms: list[int] = np.rint((np.asarray(t_us, dtype=np.int64) - self.zero_us) / 1000.0).astype(int).tolist()
        return ms

    def track(self, trajectory: Trajectory) -> dict[str, list[int]]:
        """Return a trajectory as t (ms), x, y (cm) and a (heading, mrad; continuous, so that it can be interpolated)."""
        x, y = self.cm(trajectory.xyz[:, :2])
        return {"t": self.ms(trajectory.t_us), "x": x, "y": y, "a": mrad(yaw_from_quat(trajectory.quat))}


def mrad(yaw: npt.ArrayLike) -> list[int]:
    """Return headings ``(N,)`` in radians as continuous whole milliradians."""
    out: list[int] = np.rint(np.unwrap(np.asarray(yaw, dtype=np.float64)) * 1000.0).astype(int).tolist()
    return out


def rounded(values: F64) -> list[float | None]:
    """Return values with `METRIC_DIGITS` digits; None where not finite.

    Example:
        >>> rounded(np.array([0.123456789, np.nan, 3.0]))
        [0.12346, None, 3.0]
    """
    return [float(f"{v:.{METRIC_DIGITS}g}") if np.isfinite(v) else None for v in values.tolist()]
