"""Register the fixers."""

from alpasim_plugin.core.parts.registry import RegisteredPart

PARTS = (
    RegisteredPart(
        kind="fixer",
        name="onefixer",
        target="alpasim_plugin.fixers.identity:per_frame",
        help="one-step causal generator in pixels, frame by frame, for a CPU",
    ),
    RegisteredPart(
        kind="fixer",
        name="nearest",
        target="alpasim_plugin.fixers.nearest:NearestFixer",
        help="the nearest recorded frame, warped into the view, without a network",
    ),
    RegisteredPart(
        kind="fixer",
        name="identity",
        target="alpasim_plugin.fixers.identity:IdentityFixer",
        help="passes frames on unchanged",
    ),
)
