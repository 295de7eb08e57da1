"""Where a drive was before a frame, and how far another frame is from there."""

from __future__ import annotations

import cv2
import numpy as np

from alpasim_plugin.alpasim.server.views import View
from alpasim_plugin.core.types import F64

SLACK_M = 0.1  # error of a predicted pose that is always allowed ...
ACCEL_MPS2 = 10.0  # ... plus this times dt^2: twice the error of a constant speed under hard braking
SPEED_MPS = 70.0  # where there is no motion to continue, farther than this times dt is another place
LEVER_M = 2.0  # a turn by one radian counts as this distance


def distance(view: View, before: View, T_before: tuple[F64, int] | None) -> tuple[float, float]:
    """Return how far a frame is from where a view's drive was at its time, in metres, and how far it may be.

    Args:
        view: The later frame.
        before: The earlier one.
        T_before: Camera pose and time of the frame before that one, where known.
    """
    dt_us, shutter_us = view.t_us - before.t_us, view.t_us - view.start_us
    reach_m = SLACK_M + ACCEL_MPS2 * (dt_us / 1e6) ** 2
    start, end = view.T_world_camera
    here = before.T_world_camera[1]
    if shutter_us > 0:
        back = dt_us / shutter_us
        return apart(on_line(end, start, back), here) + _objects_apart(view, before, back), reach_m
    if T_before is not None:
        last, last_us = T_before
        return apart(end, on_line(last, here, 1 + dt_us / (before.t_us - last_us))), reach_m
    return apart(end, here), SLACK_M + SPEED_MPS * dt_us / 1e6


def on_line(a: F64, b: F64, s: float) -> F64:
    """Return the pose ``(4, 4)`` at ``s`` on the steady motion through ``a`` at 0 and ``b`` at 1; ``s`` may lie outside.

    Example:
        >>> a, b = np.eye(4), np.eye(4)
        >>> b[0, 3] = 2.0
        >>> on_line(a, b, 3.0)[0, 3].item()
        6.0
    """
    out = np.eye(4)
    turn, _ = cv2.Rodrigues(a[:3, :3].T @ b[:3, :3])
    out[:3, :3] = a[:3, :3] @ cv2.Rodrigues(turn * s)[0]
    out[:3, 3] = a[:3, 3] + s * (b[:3, 3] - a[:3, 3])
    return out


def apart(a: F64, b: F64) -> float:
    """Return the distance of two poses in metres, a radian counting as `LEVER_M`."""
    cosine = np.clip((np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2, -1.0, 1.0)
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3]) + LEVER_M * np.arccos(cosine))


def _objects_apart(view: View, before: View, back: float) -> float:
    """Return the mean distance of the dynamic objects that both frames show: it tells drives apart whose traffic differs."""
    shared = [track for track in view.objects if track in before.objects]
    if not shared:
        return 0.0
    then = np.array([before.objects[track][1, :3, 3] for track in shared])
    start, end = (np.array([view.objects[track][i, :3, 3] for track in shared]) for i in (0, 1))
    return float(np.linalg.norm(end + back * (start - end) - then, axis=1).mean())
