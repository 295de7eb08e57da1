"""Policies: from observations to plans."""

from __future__ import annotations

from policies.base import POLICIES, make_policy
from policies.conformance import Check, Report, canned_scenario, check_policy
from policies.constant_velocity import ConstantVelocity
from policies.lane_camera import LaneCamera
from policies.learned import Learned
from policies.log_replay import LogReplay
from policies.pure_pursuit import PurePursuit

__all__ = [
    "POLICIES",
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
