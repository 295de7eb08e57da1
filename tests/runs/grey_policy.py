"""A policy that drives by how bright its camera is: what a renderer shows decides where it goes."""

import numpy as np

from alpasim_plugin.core.types import Plan, SensorSpec

BY_GREY = "tests.runs.grey_policy:DrivesByGrey"


class DrivesByGrey:
    """Drives straight on, and to the left by as much as its camera is darker than grey level 90; a
    little at random by seed.
    """

    sensors = (SensorSpec("front", 300_000),)

    def reset(self, seed, route):
        self.seed = seed

    def act(self, observation):
        times = observation.t_us + np.arange(0, 2_000_001, 500_000, dtype=np.int64)
        seconds = (times - observation.t_us) * 1e-6
        dark = (
            (90.0 - float(next(iter(observation.frames.values())).rgb.mean())) / 60.0
            if observation.frames
            else 0.0
        )
        left = (0.8 * dark + 0.01 * self.seed) * seconds
        return Plan(
            observation.t_us,
            times,
            np.stack([observation.ego.speed_mps * seconds, left], axis=1),
            np.zeros(len(times)),
        )
