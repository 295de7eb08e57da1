"""Register the renderers."""

from alpasim_plugin.core.parts.registry import RegisteredPart

PARTS = (
    RegisteredPart(
        kind="renderer",
        name="clean",
        target="alpasim_plugin.renderers.gaussian:CleanRenderer",
        help="the Gaussian scene as built",
    ),
    RegisteredPart(
        kind="renderer",
        name="3dgs",
        target="alpasim_plugin.renderers.reconstruction:reconstruction_renderer",
        help="a reconstruction of the logged drive: error grows with the distance from its path",
    ),
    RegisteredPart(
        kind="renderer",
        name="broken-black",
        target="alpasim_plugin.renderers.broken:black_renderer",
        help="deliberate fault: black frames",
    ),
    RegisteredPart(
        kind="renderer",
        name="broken-mirrored",
        target="alpasim_plugin.renderers.broken:mirrored_renderer",
        help="deliberate fault: left and right swapped",
    ),
    RegisteredPart(
        kind="renderer",
        name="broken-blurred",
        target="alpasim_plugin.renderers.broken:blurred_renderer",
        help="deliberate fault: strong blur",
    ),
    RegisteredPart(
        kind="renderer",
        name="broken-shifted",
        target="alpasim_plugin.renderers.broken:shifted_renderer",
        help="deliberate fault: seen from 0.5 m to the right",
    ),
    RegisteredPart(
        kind="renderer",
        name="broken-frozen",
        target="alpasim_plugin.renderers.broken:frozen_renderer",
        help="deliberate fault: the first frame for ever",
    ),
    RegisteredPart(
        kind="renderer",
        name="broken-late",
        target="alpasim_plugin.renderers.broken:late_renderer",
        help="deliberate fault: images 1 s old",
    ),
)
