"""Other road users seen from above: where each is when the picture was taken, and the way it goes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]
LEAST_PATH_M = 1.0
MAX_ACTORS = 60  # the nearest ones to the logged drive


@dataclass(frozen=True)
class RoadUser:
    """One road user, in drawing units.

    Attributes:
        text: For the hover.
        body: Its box at the picture's time, as SVG path data.
        way: The path that it goes during the scene; empty if it stands.
    """

    text: str
    body: str
    way: str


def road_users(content: Mapping[str, Any], at_us: int, log: F64, draw: Callable[[F64, bool], str]) -> list[RoadUser]:
    """Lay out the road users of a scene; empty for scene files of earlier versions, which have no tracks.

    Args:
        content: ``scenes/SCENE.json``.
        at_us: Time of the picture; a road user that is not there then is drawn at its nearest time.
        log: ``(N, 2)`` the logged drive, metres, world.
        draw: From ``(N, 2)`` world metres and whether the line is closed to SVG path data; empty where nothing of it is in the picture.
    """
    known = [actor for actor in content.get("actors") or [] if actor.get("x_m") and actor.get("length_m")]
    nearest = sorted(known, key=lambda actor: _distance(actor, log))[:MAX_ACTORS]
    found = (_road_user(actor, at_us, draw) for actor in nearest)
    return [one for one in found if one.body or one.way]


def _distance(actor: Mapping[str, Any], log: F64) -> float:
    xy = np.column_stack([actor["x_m"], actor["y_m"]])
    return float(np.min(np.hypot(*(xy[:, None] - log[None, ::10]).transpose(2, 0, 1))))


def _road_user(actor: Mapping[str, Any], at_us: int, draw: Callable[[F64, bool], str]) -> RoadUser:
    xy = np.column_stack([actor["x_m"], actor["y_m"]]).astype(float)
    moves = float(np.ptp(xy, axis=0).max()) > LEAST_PATH_M
    k = int(np.argmin(np.abs(np.asarray(actor["t_us"]) - at_us)))
    body = draw(corners(xy[k], float(actor["yaw_rad"][k]), actor["length_m"], actor["width_m"]), True)
    how = ("reacts once the policy drives" if actor.get("reacts") else "as recorded or scripted") if moves else "stands"
    return RoadUser(f"{actor.get('label') or 'road user'} {actor.get('id') or ''}, {how}".strip(), body, draw(xy, False) if moves else "")


def corners(centre: F64 | Sequence[float], yaw_rad: float, length_m: float, width_m: float) -> F64:
    """Return the corners ``(4, 2)`` of a box seen from above."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    half, wide = length_m / 2, width_m / 2
    local = np.array([[-half, -wide], [half, -wide], [half, wide], [-half, wide]])
    return np.asarray(local @ np.array([[c, s], [-s, c]]) + centre)
