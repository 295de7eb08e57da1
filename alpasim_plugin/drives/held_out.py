"""Which photographs of a drive judge its model. No pixel of theirs reaches the import but to be
compared with what the finished model shows.

Poses are no pixels: those of the photographs that are held out count as the others' do. What the
photographs say of poses, points, ground, depth, sky and exposure is measured in the others alone.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from alpasim_plugin.core.types import Bool
from alpasim_plugin.drives.placing import PlacedDrive
from alpasim_plugin.drives.source import SourceDrive

# One photograph of so many is held out.
EVERY = 8
# The same for a drive in which no road was found below the path.
EVERY_STILL = 5

Measure = Callable[[int], tuple[SourceDrive, PlacedDrive]]


def held_out(drive: SourceDrive, camera: str, stride: int) -> Bool:
    """Return which photographs ``(N,)`` of a camera are held out, in the order of time: the middle
    one of ``stride``; none of a camera that took fewer than `EVERY`, or that is never fitted.
    """
    count = len(drive.of(camera))
    if count < EVERY or camera in drive.never_fitted:
        return np.zeros(count, dtype=np.bool_)
    return np.asarray(np.arange(count) % stride == stride // 2, dtype=np.bool_)


def fitted_part(drive: SourceDrive, stride: int) -> SourceDrive:
    """Return the drive without the photographs that are held out."""
    kept = []
    for camera in drive.cameras:
        held = held_out(drive, camera, stride)
        kept += [
            photograph
            for photograph, is_held in zip(drive.of(camera), held, strict=True)
            if not is_held
        ]
    return replace(drive, photographs=tuple(kept))


def measured(measure: Measure) -> tuple[SourceDrive, PlacedDrive, int]:
    """Measure a drive with every eighth photograph held out; where that finds no road below the
    path, measure it again with every fifth.

    Args:
        measure: Corrects and places the drive with one photograph of so many held out.

    Returns:
        The drive, its place in the world, and one photograph of how many is held out.
    """
    drive, placed = measure(EVERY)
    if placed.strip is not None:
        return drive, placed, EVERY
    return *measure(EVERY_STILL), EVERY_STILL
