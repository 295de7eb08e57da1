"""Build a rollout's renderer: the base renderer, with a fixer applied to its frames where one is named."""

from __future__ import annotations

from collections.abc import Sequence

from alpasim_plugin.core.types import Frame, RenderRequest, Scenario
from alpasim_plugin.plugins.interfaces import Renderer
from alpasim_plugin.plugins.parts import RendererSpec, build, resolve_renderer
from alpasim_plugin.runtime.guards import checked_frames


def make_renderer(
    name: str | RendererSpec,
    scenario: Scenario,
    seed: int = 0,
    device: str = "cpu",
    threads: int | None = None,
    overrides: Sequence[str] = (),
) -> Renderer:
    """Build one rollout's renderer.

    Args:
        name: A renderer, or a fixer over one, as `alpasim_plugin.plugins.parts.resolve_renderer` takes it; or its resolved spec.
        scenario: What is rendered.
        seed: The rollout's seed, for temporal noise and the fixer's noise.
        device: ``cpu`` or ``cuda``.
        threads: Threads of the CPU rasteriser and of torch; None keeps their settings.
        overrides: ``KEY=VALUE`` of the fixer's settings, where ``name`` is a string.

    Raises:
        InputError: Unknown name, device or setting, or weights that are missing or wrong.
        RendererError: The device does not work.
    """
    spec = resolve_renderer(name, overrides) if isinstance(name, str) else name
    session = {"seed": seed, "device": device, "threads": threads}
    base: Renderer = build(spec.base, scenario=scenario, **session)
    if spec.fixer is None:
        return base
    from alpasim_plugin.fixers.loop import fixed_renderer
    from alpasim_plugin.fixers.settings import FixerSettings

    fixer, settings = spec.fixer, spec.fixer.settings
    assert isinstance(settings, FixerSettings), "the settings of a fixer derive from FixerSettings"

    def render(request: RenderRequest) -> Frame:
        return checked_frames(base, [request])[0]

    return fixed_renderer(render, lambda: build(fixer, scene_id=scenario.scene_id, **session), settings, scenario, threads)
