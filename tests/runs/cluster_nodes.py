"""A Ray cluster of several nodes on this machine, for tests."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from alpasim_plugin.runs.executors.choice import Executor

# Set before Ray is imported. Otherwise a driver that finds a cluster by itself asks it for the
# token of an earlier one (~/.ray/auth_token).
os.environ["RAY_AUTH_MODE"] = "disabled"

LIGHT = {"include_log_monitor": False}  # fewer processes of Ray's own
LIGHT_HEAD = {"include_dashboard": False, "no_monitor": True, **LIGHT}
SYSTEM = {
    "health_check_initial_delay_ms": 0,
    "health_check_period_ms": 500,
    "health_check_failure_threshold": 4,
}


def patiently(start: Callable[[], Any], times: int = 4) -> Any:
    """Start a node of Ray, which gives it 30 s to come up; on a busy machine it is started
    again.
    """
    for left in reversed(range(times)):
        try:
            return start()
        except Exception as error:  # Ray has no class of its own for it
            if left == 0 or "timed out during startup" not in str(error):
                raise
    raise AssertionError("not started once")


class Nodes:
    """A cluster on this machine, a core a node; its raylets can be killed."""

    def __init__(self, number: int, **more: Any) -> None:
        from ray.cluster_utils import Cluster

        head = {"num_cpus": 1, "_system_config": SYSTEM, **LIGHT_HEAD, **more}
        self.cluster = patiently(lambda: Cluster(initialize_head=True, head_node_args=head))
        for _ in range(number - 1):
            self.add()

    @property
    def address(self) -> str:
        return str(self.cluster.address)

    def add(self, **more: Any) -> Any:
        return patiently(lambda: self.cluster.add_node(**{"num_cpus": 1, **LIGHT, **more}))

    def close(self) -> None:
        self.cluster.shutdown()


def on(nodes: Nodes) -> Executor:
    return Executor("ray", nodes.address)
