"""Register the controllers, and the policy that is a control unit."""

from alpasim_plugin.core.parts.registry import RegisteredPart

PARTS = (
    RegisteredPart(
        kind="policy",
        name="can://",
        target="alpasim_plugin.control.can_policy:CanPolicy",
        help="a control unit on a CAN bus: can://INTERFACE:CHANNEL[?map=NAME&dbc=FILE]",
    ),
    RegisteredPart(
        kind="controller",
        name="bicycle",
        target="alpasim_plugin.control.tracker:PlanTracker",
        help="kinematic bicycle that follows the plan with preview, within the vehicle's limits",
    ),
    RegisteredPart(
        kind="controller",
        name="perfect",
        target="alpasim_plugin.control.tracker:PerfectController",
        help="the ego is exactly where its plan says",
    ),
)
