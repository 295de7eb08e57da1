"""`serve_policy`: a policy in a Python environment of its own, which `simrun --policy "exec:..."` starts and drives.

Of this project only light modules are imported, and of other packages numpy, grpc, protobuf and OpenCV: the environment needs neither torch
nor the rest. A test holds it to that.
"""

from __future__ import annotations

import hashlib
import inspect
import os
import traceback
from collections.abc import Callable
from typing import Any

import numpy as np

from alpasim_plugin.alpasim.server.driver_service import DriverService
from alpasim_plugin.alpasim.server.hosting import Host
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.plan_check import blank_scenario
from alpasim_plugin.core.types import Scenario, Trajectory
from alpasim_plugin.plugins.interfaces import Policy, complete

ADDRESS = "SIMRUN_POLICY_ADDRESS"


def serve_policy(factory: Callable[..., Any], address: str | None = None) -> None:
    """Serve a policy as AlpaSim's EgodriverService until the process is ended.

    Args:
        factory: The policy's class, or a function that makes one; called for every rollout, with the scenario if it has a parameter of that
            name. Of the scenario only the cameras are true. What is costly to load belongs outside of it.
        address: ``HOST:PORT`` or ``unix:PATH``; by default what the environment variable ``SIMRUN_POLICY_ADDRESS`` says.

    Raises:
        InputError: There is no address.
        InfrastructureError: The address cannot be had.

    Example:
        >>> serve_policy(Mine)  # doctest: +SKIP
    """
    place = address or os.environ.get(ADDRESS, "")
    if not place:
        do_this = f"start the script by simrun --policy 'exec:python SCRIPT.py', or set {ADDRESS}=127.0.0.1:6000"
        raise InputError("serving a policy", f"environment variable {ADDRESS}", "it is not set", do_this)
    takes_scenario = "scenario" in inspect.signature(factory).parameters
    name = getattr(factory, "__name__", type(factory).__name__)

    def make(scenario: Scenario) -> Policy:
        made: Policy = complete(factory(scenario=scenario) if takes_scenario else factory(), Policy, f"policy {name!r}")
        return made

    service = _Serving(name, _file_digest(factory), make, _unknown_scene)
    with Host({"EgodriverService": service}, place, every=service.sessions.expire) as host:
        host.wait()


class _Serving(DriverService):
    """The service, which prints the tracebacks of its policy: they end up in the run's output."""

    def failed(self, call: str, code: Any, text: str, error: Exception) -> None:
        super().failed(call, code, text, error)
        traceback.print_exception(error)


def _unknown_scene(scene_id: str) -> Scenario:
    standing = Trajectory(np.zeros(1, np.int64), np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]]))
    return blank_scenario(scene_id, standing)


def _file_digest(factory: Callable[..., Any]) -> str | None:
    """Return the SHA-256 of the file that defines the policy, for `get_version`."""
    try:
        file = inspect.getsourcefile(factory)
    except (TypeError, OSError):  # no Python source: a built-in, or typed after -c
        return None
    if file is None or not os.path.isfile(file):
        return None
    with open(file, "rb") as source:
        return hashlib.file_digest(source, "sha256").hexdigest()
