"""Policies that fail in the ways a third party's might."""

import os
import signal
import time

import numpy as np

from alpasim_plugin.core.types import Plan, SensorSpec
from policies.simple import LogReplay


class Raises:
    """Raises at the first question."""

    sensors: tuple[SensorSpec, ...] = ()

    def reset(self, seed, route):
        pass

    def act(self, observation):
        raise ValueError("no weights")


class ForgetsItsRoute(Raises):
    """Asks for what it never made: wrong code, which fails whenever it runs."""

    def act(self, observation):
        return self.route


class KillsItsProcess(Raises):
    """Dies as under the out-of-memory killer."""

    def act(self, observation):
        os.kill(os.getpid(), signal.SIGKILL)
        raise AssertionError("unreachable")


class MissesItsWeights(Raises):
    """Cannot be made."""

    def __init__(self):
        raise FileNotFoundError("weights.pt")


class RemembersEarlierRollouts(Raises):
    """Drives a little to the left after half a second, by how many rollouts its process has seen:
    no rollout can be repeated.
    """

    lives = 0

    def reset(self, seed, route):
        type(self).lives += 1
        self.start_us = None

    def act(self, observation):
        self.start_us = observation.t_us if self.start_us is None else self.start_us
        times = observation.t_us + np.arange(0, 2_000_001, 500_000, dtype=np.int64)
        seconds = (times - observation.t_us) * 1e-6
        left = (
            0.01 * self.lives * seconds
            if observation.t_us >= self.start_us + 500_000
            else 0.0 * seconds
        )
        return Plan(
            observation.t_us,
            times,
            np.stack([observation.ego.speed_mps * seconds, left], axis=1),
            np.zeros(len(times)),
        )


class ShiversByTheClock(LogReplay):
    """Drives the recording but for some millimetres to the side, by the clock: not repeatable."""

    def act(self, observation):
        plan = super().act(observation)
        lateral_m = np.array([0.0, 1e-3 * (time.monotonic_ns() % 11)])
        return Plan(plan.t_us, plan.times_us, plan.xy + lateral_m, plan.yaw)
