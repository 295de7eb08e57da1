"""The policy `learned-three` with one camera black: what that camera is worth.

    simrun --renderer clean data/scenes/three/test \\
        --policy learned-three,alpasim_plugin.lab.bench.black_camera:BlackLeft
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np

from alpasim_plugin.core.types import Observation, Plan
from policies.learned import LearnedThree


class BlackLeft(LearnedThree):
    """`learned-three` whose left camera shows black."""

    view: ClassVar[str] = "left"

    def act(self, observation: Observation) -> Plan:
        """Return the plan made of the other cameras' frames and a black one."""
        names = [view.name for view in self.net.views]
        camera = self.cameras[names.index(self.view)].name
        frame = observation.frames[camera]
        black = replace(frame, rgb=np.zeros_like(frame.rgb))
        return super().act(observation.with_frames({**observation.frames, camera: black}))


class BlackRight(BlackLeft):
    """`learned-three` whose right camera shows black."""

    view: ClassVar[str] = "right"
