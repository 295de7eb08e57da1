"""Do the work that does not depend on the camera once, so that repeated frames only pay for what changes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.constants import ALPHA_MIN
from alpasim_plugin.types import F64

ShFrame = Literal["object", "world"]


@dataclass(frozen=True, eq=False)
class PreparedCloud:
    """A cloud ready for repeated rendering. Build it with `prepare`; the fields are private to the rasteriser.

    Attributes:
        cloud: The Gaussians that can reach the alpha cut, in input order.
        sh_frame: Axes in which view directions meet the colour coefficients.
    """

    cloud: GaussianCloud
    sh_frame: ShFrame

    def __len__(self) -> int:
        """Return the number of Gaussians kept."""
        return len(self.cloud)


def prepare(cloud: GaussianCloud, *, sh_frame: ShFrame = "object") -> PreparedCloud:
    """Prepare a cloud for `rasterize_prepared`.

    Args:
        cloud: Gaussians in their own frame (the world for a background, the box of an actor).
        sh_frame: ``object`` turns view-dependent colour with the node, which is right for poses that were not trained; ``world``
            evaluates world directions, as checkpoints of Street Gaussians, drivestudio and MTGS were optimised.

    Raises:
        InputError: The cloud holds Gaussians that cannot be drawn.
    """
    cloud.require_drawable("preparing a Gaussian cloud")
    return PreparedCloud(cloud.take(np.flatnonzero(cloud.opacities >= ALPHA_MIN)), sh_frame)


Node = tuple[PreparedCloud, F64 | npt.NDArray[np.floating] | None]
