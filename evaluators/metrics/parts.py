"""Register the evaluators."""

from alpasim_plugin.core.parts.registry import RegisteredPart

PARTS = (
    RegisteredPart(
        kind="evaluator",
        name="collision",
        target="evaluators.metrics.collision:FACTORY",
        help="contact with other actors by class, and the distance to them",
    ),
    RegisteredPart(
        kind="evaluator",
        name="offroad",
        target="evaluators.metrics.offroad:FACTORY",
        help="off-road, wrong lane and the distance to the lanes' border",
    ),
    RegisteredPart(
        kind="evaluator",
        name="route",
        target="evaluators.metrics.route:FACTORY",
        help="distance from the recorded drive, progress and distance driven",
    ),
    RegisteredPart(
        kind="evaluator",
        name="outcomes",
        target="evaluators.metrics.outcomes:FACTORY",
        help="standstill and braking without a cause, and leaving the route",
    ),
    RegisteredPart(
        kind="evaluator",
        name="motion",
        target="evaluators.metrics.motion:FACTORY",
        help="comfort, hard braking, time to collision, safe distance, wrong way and red light",
    ),
    RegisteredPart(
        kind="evaluator",
        name="protocols",
        target="evaluators.metrics.protocols:FACTORY",
        help="scores of nuPlan and NAVSIM",
    ),
    RegisteredPart(
        kind="evaluator",
        name="plan",
        target="evaluators.metrics.plan:FACTORY",
        help="plan deviation, open-loop collision and minADE of the plans",
    ),
    RegisteredPart(
        kind="evaluator",
        name="image_health",
        target="evaluators.metrics.image_health:FACTORY",
        help="black and frozen camera images",
    ),
    RegisteredPart(
        kind="evaluator",
        name="measured",
        target="evaluators.metrics.measured:FACTORY",
        help="steps beyond where what a renderer shows was compared with the truth",
    ),
)
