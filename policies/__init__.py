"""Policies: from observations to plans."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from policies.base import make_policy
    from policies.conformance import Check, Report, canned_scenario, check_policy
    from policies.constant_velocity import ConstantVelocity
    from policies.lane_camera import LaneCamera
    from policies.learned import Learned
    from policies.log_replay import LogReplay
    from policies.pure_pursuit import PurePursuit

_HOMES = {
    "Check": "policies.conformance",
    "ConstantVelocity": "policies.constant_velocity",
    "LaneCamera": "policies.lane_camera",
    "Learned": "policies.learned",
    "LogReplay": "policies.log_replay",
    "PurePursuit": "policies.pure_pursuit",
    "Report": "policies.conformance",
    "canned_scenario": "policies.conformance",
    "check_policy": "policies.conformance",
    "make_policy": "policies.base",
}

__all__ = [
    "Check",
    "ConstantVelocity",
    "LaneCamera",
    "Learned",
    "LogReplay",
    "PurePursuit",
    "Report",
    "canned_scenario",
    "check_policy",
    "make_policy",
]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
