"""Vehicle and controllers: from a plan to motion."""

from alpasim_plugin.core.interfaces import Controller
from alpasim_plugin.core.parts import build, unidentified
from alpasim_plugin.core.types import Vehicle

__all__ = ["Controller", "make_controller"]


def make_controller(name: str, vehicle: Vehicle) -> Controller:
    """Return a controller for a vehicle.

    Args:
        name: A controller as `alpasim_plugin.core.parts.resolve` takes it.
        vehicle: What it moves.

    Raises:
        InputError: No controller has that name.
    """
    return build(unidentified("controller", name), vehicle=vehicle)
