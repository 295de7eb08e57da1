"""Compose a renderer and a fixer into a renderer."""

from __future__ import annotations

from collections.abc import Callable

from alpasim_plugin.core.types import BlockRule, Fixer, Frame, RenderRequest, Scenario
from alpasim_plugin.fixers.block_runner import BlockRunner
from alpasim_plugin.fixers.chunk import ChunkRenderer
from alpasim_plugin.fixers.per_frame import PerFrameRenderer
from alpasim_plugin.fixers.settings import FixerSettings
from alpasim_plugin.fixers.speculation import SpeculativeRenderer
from alpasim_plugin.plugins.parts import complete
from alpasim_plugin.semantic_map.prepare import prepare_map

FixedRenderer = PerFrameRenderer | SpeculativeRenderer | ChunkRenderer
ONE_BY_ONE = BlockRule(1, 1)


def fixed_renderer(
    render: Callable[[RenderRequest], Frame],
    make_fixer: Callable[[], Fixer],
    settings: FixerSettings,
    scenario: Scenario,
    threads: int | None = None,
) -> FixedRenderer:
    """Return one rollout's renderer whose frames are fixed.

    A fixer of single frames fixes each as it is rendered (`alpasim_plugin.fixers.per_frame`). Others work in blocks (5 frames first, then
    8), but the poses of a block's later frames are not known when its first frame falls due: ``settings.mode`` chooses between
    ``speculative`` (`alpasim_plugin.fixers.speculation`) and ``chunk`` (`alpasim_plugin.fixers.chunk`).

    Args:
        render: The base renderer of the same rollout; its frames are checked.
        make_fixer: Makes a fixer without history; called once, and again for every further group of cameras with other frame times.
        settings: Mode, tolerances, and whether the fixer wants semantic maps.
        scenario: Its map and its actors' boxes are what the semantic map shows.
        threads: Threads of the map rasteriser; None leaves numba's number.
    """
    scene_map = prepare_map(scenario.lane_map) if settings.uses_map else None
    runner = BlockRunner(render, scene_map, scenario.actors, threads)

    def make() -> Fixer:
        return complete(make_fixer(), Fixer)

    first = make()
    if first.blocks == ONE_BY_ONE:
        return PerFrameRenderer(runner, first)
    if settings.mode == "chunk":
        return ChunkRenderer(runner, first)
    return SpeculativeRenderer(runner, make, settings, first)
