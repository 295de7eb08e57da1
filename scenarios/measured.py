"""How far from the recorded path a reconstruction was compared with photographs."""

from collections.abc import Sequence

import numpy as np
import shapely

from alpasim_plugin.core.geometry import interpolate, wrap_angle
from alpasim_plugin.core.types import F64, CameraSpec, MeasuredRange, Photograph
from scenarios.recorded import RecordedLog

MOST_TURN_DEG = 20.0  # between cameras that show nearly the same


def measured_range(drive: RecordedLog, cameras: Sequence[CameraSpec]) -> MeasuredRange | None:
    """Return the range of an imported drive; None where nothing is reconstructed.

    Photographs along the path that were held out compare it at a distance of 0; those of a camera
    that no fit saw at that camera's distance from the path of the fitted photographs, the median of
    its photographs. A camera that looks aside compares no view ahead, so that it says nothing of the
    distance.

    Args:
        drive: The drive.
        cameras: Of the scenario; the axis of the first is that from which turns are counted.
    """
    if drive.model is None:
        return None
    unseen = [photograph for photograph in drive.recording if photograph.use != "fitted"]
    fitted = [photograph for photograph in drive.recording if photograph.use == "fitted"]
    if not unseen or len(fitted) < 2:
        return MeasuredRange(0.0, 0.0, 0)
    paths = _paths(fitted)
    cameras_beside = _by_camera(
        [photograph for photograph in unseen if photograph.use == "never-fitted"]
    )
    turn_deg = [
        float(np.median([_turn_deg(drive, cameras[0], photograph) for photograph in photographs]))
        for photographs in cameras_beside
    ]
    lateral_m = [
        float(np.median(shapely.distance(paths, shapely.points(_places(photographs)))))
        for photographs, turned_deg in zip(cameras_beside, turn_deg, strict=True)
        if turned_deg <= MOST_TURN_DEG
    ]
    return MeasuredRange(
        round(max(lateral_m, default=0.0), 3), round(max(turn_deg, default=0.0), 1), len(unseen)
    )


def _by_camera(photographs: Sequence[Photograph]) -> list[list[Photograph]]:
    """Return the photographs of each camera, in order of time."""
    by_camera: dict[str, list[Photograph]] = {}
    for photograph in sorted(photographs, key=lambda photograph: photograph.t_us):
        by_camera.setdefault(photograph.camera, []).append(photograph)
    return list(by_camera.values())


def _paths(photographs: Sequence[Photograph]) -> shapely.MultiLineString:
    """Return the way of each camera in plan view."""
    return shapely.MultiLineString(
        [_places(taken) for taken in _by_camera(photographs) if len(taken) > 1]
        or [_places(photographs)[:2]]
    )


def _places(photographs: Sequence[Photograph]) -> F64:
    """Return where photographs were taken in plan view ``(N, 2)``, metres."""
    return np.array([photograph.T_world_camera[:2, 3] for photograph in photographs])


def _turn_deg(drive: RecordedLog, camera: CameraSpec, photograph: Photograph) -> float:
    """Return the angle in plan view between the axis of a photograph and that of the camera on the
    recorded drive at the same time.
    """
    log = drive.ego_log
    t_us = int(np.clip(photograph.t_us, log.t_us[0], log.t_us[-1]))
    axis = (interpolate(log, t_us) @ camera.T_rig_camera)[:2, 2]
    taken = photograph.T_world_camera[:2, 2]
    turn = wrap_angle(np.arctan2(taken[1], taken[0]) - np.arctan2(axis[1], axis[0]))
    return abs(float(np.degrees(turn)))
