"""What a fixer gets of a lens whose renderer draws pinholes alone: the frame and its references, and on
a device the semantic map, are joined of those that cover it.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from alpasim_plugin.cameras import lens
from alpasim_plugin.cameras.lens import Lens
from alpasim_plugin.core.types import Frame


def joined(camera: str, sides: Sequence[Lens], frames: Sequence[Frame]) -> Frame:
    """Return the frame of a camera's lens, with its references; see `cameras.lens.joined`. Planes that
    are on a device stay there.
    """
    planes = [frame.pending for frame in frames]
    if planes[0] is None or sides[0].resample is None:
        return lens.joined(camera, sides, frames)
    from alpasim_plugin.fixers.device_lenses import joined_planes  # loads torch

    events = dict.fromkeys(event for frame in frames for event in frame.events)
    whole = joined_planes(sides, planes)
    return frames[0].changed(camera=camera, events=tuple(events), on_device=whole)


def joined_image(sides: Sequence[Lens], images: Sequence[Any]) -> Any:
    """Return the lens's image of those of its pinholes ``(h, w, C)``, arrays or tensors; see
    `cameras.lens.joined_image`.
    """
    if isinstance(images[0], np.ndarray) or sides[0].resample is None:
        return lens.joined_image(sides, images)
    from alpasim_plugin.fixers.device_lenses import joined_tensor  # loads torch

    return joined_tensor(sides, images)
