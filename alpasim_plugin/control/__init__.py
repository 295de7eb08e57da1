"""Vehicle and controllers: from a plan to motion."""

from __future__ import annotations

from alpasim_plugin.control.base import Controller
from alpasim_plugin.control.bicycle import BicycleState, Command
from alpasim_plugin.control.perfect import PerfectController
from alpasim_plugin.control.tracker import PlanTracker
from alpasim_plugin.registry import Registry
from alpasim_plugin.types import Vehicle

CONTROLLERS: Registry[Controller] = Registry("controller", "simrun.controllers")
CONTROLLERS.register("bicycle", "kinematic bicycle that follows the plan with preview, within the vehicle's limits")(PlanTracker)
CONTROLLERS.register("perfect", "the ego is exactly where its plan says")(PerfectController)

__all__ = ["CONTROLLERS", "BicycleState", "Command", "Controller", "PerfectController", "PlanTracker", "make_controller"]


def make_controller(name: str, vehicle: Vehicle) -> Controller:
    """Return the controller of a name for a vehicle.

    Raises:
        InputError: No controller has that name.
    """
    return CONTROLLERS.get(name)(vehicle)
