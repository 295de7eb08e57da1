"""Correct the poses of a drive by its own photographs, before anything is measured with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F64
from alpasim_plugin.drives.source import SourceDrive
from alpasim_plugin.gaussians.fit.adjust import corrected
from alpasim_plugin.gaussians.fit.photographs import Picture, resized
from alpasim_plugin.gaussians.fit.views import PosedView

WIDTH_PX = 640  # corners are followed at a tenth of a pixel: more is not needed
LEAST_GAIN = 0.9  # the error must fall below this share of what it was
FARTHEST_M, FARTHEST_RAD = 0.5, 0.05  # of a correction; more is another fault than a recorder's noise


def with_corrected_poses(drive: SourceDrive) -> SourceDrive:
    """Return the drive with the front camera's poses adjusted to its photographs, and its other cameras moved along, as a rig is rigid.

    Poses in metres are held to what they were; a drive whose points or ego poses were measured apart keeps its own.
    """
    if drive.metric is None or drive.points is not None or drive.ego is not None or drive.kind in ("colmap", "sfm"):
        return drive
    front = drive.of(drive.front)
    found = corrected([_view(picture) for picture in front])
    if not found.after_px < LEAST_GAIN * found.before_px:  # also where there is nothing to say: NaN
        return drive
    poses = np.array([inverse(camera.T_camera_world) for camera in found.cameras])
    moves = [new @ inverse(old.T_world_camera) for new, old in zip(poses, front, strict=True)]
    turned = [np.arccos(np.clip((np.trace(move[:3, :3]) - 1) / 2, -1, 1)) for move in moves]
    shifted = [float(np.linalg.norm(new[:3, 3] - old.T_world_camera[:3, 3])) for new, old in zip(poses, front, strict=True)]
    if max(shifted) > FARTHEST_M or max(turned) > FARTHEST_RAD:
        return drive
    at = {picture.t_us: move for picture, move in zip(front, moves, strict=True)}
    pictures = tuple(_moved(picture, at.get(picture.t_us)) for picture in drive.pictures)
    note = (
        f"poses were corrected by the photographs, by up to {100 * max(shifted):.0f} cm and {np.degrees(max(turned)):.2f} degrees: "
        f"points are met to {found.after_px:.2f} instead of {found.before_px:.2f} pixels"
    )
    return replace(drive, pictures=pictures, notes=(*drive.notes, note))


def _view(picture: Picture) -> PosedView:
    full = picture.view()
    return resized(full, WIDTH_PX) if full.camera.width > WIDTH_PX else full


def _moved(picture: Picture, move: F64 | None) -> Picture:
    return picture if move is None else replace(picture, T_world_camera=move @ picture.T_world_camera)
