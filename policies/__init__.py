"""Policies: from observations to plans."""

from __future__ import annotations

from typing import TYPE_CHECKING

from alpasim_plugin.core.lazy import lazy_names

if TYPE_CHECKING:
    from policies.base import make_policy as make_policy
    from policies.conformance import Check as Check
    from policies.conformance import Report as Report
    from policies.conformance import canned_scenario as canned_scenario
    from policies.conformance import check_policy as check_policy
    from policies.lane_camera import LaneCamera as LaneCamera
    from policies.learned import Learned as Learned
    from policies.simple import ConstantVelocity as ConstantVelocity
    from policies.simple import LogReplay as LogReplay
    from policies.simple import PurePursuit as PurePursuit

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

__getattr__ = lazy_names(
    __name__,
    {
        "Check": ".conformance",
        "ConstantVelocity": ".simple",
        "LaneCamera": ".lane_camera",
        "Learned": ".learned",
        "LogReplay": ".simple",
        "PurePursuit": ".simple",
        "Report": ".conformance",
        "canned_scenario": ".conformance",
        "check_policy": ".conformance",
        "make_policy": ".base",
    },
)
