"""Register the sources of recorded drives."""

from alpasim_plugin.core.parts.registry import RegisteredPart

PARTS = (
    RegisteredPart(
        kind="source",
        name="argoverse",
        target="scenarios.sources:Argoverse",
        help="Argoverse 2 log folder",
    ),
    RegisteredPart(
        kind="source",
        name="commonroad",
        target="scenarios.sources:CommonRoad",
        help="CommonRoad XML",
    ),
    RegisteredPart(
        kind="source",
        name="drive",
        target="scenarios.sources:ImportedDrive",
        help="folder that simrun import has written",
    ),
    RegisteredPart(
        kind="source",
        name="osi",
        target="scenarios.sources:Osi",
        help="OSI trace",
    ),
    RegisteredPart(
        kind="source",
        name="usdz",
        target="scenarios.sources:Usdz",
        help="AlpaSim scene",
    ),
)
