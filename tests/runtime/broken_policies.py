"""Policies that fail in the ways a third party's might."""

from __future__ import annotations

import os
import signal

from alpasim_plugin.types import Observation, Plan, Route, SensorSpec


class Raises:
    """Raises at the first question."""

    sensors: tuple[SensorSpec, ...] = ()

    def reset(self, seed: int, route: Route) -> None:
        pass

    def act(self, observation: Observation) -> Plan:
        raise ValueError("no weights")


class KillsItsProcess(Raises):
    """Dies as under the out-of-memory killer."""

    def act(self, observation: Observation) -> Plan:
        os.kill(os.getpid(), signal.SIGKILL)
        raise AssertionError("unreachable")
