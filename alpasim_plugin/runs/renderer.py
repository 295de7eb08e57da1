"""One rollout's renderer: a renderer or a fixer over one, in the weather of the scene, through the
lenses of its cameras.
"""

from collections.abc import Sequence
from functools import partial

from alpasim_plugin.cameras.lens_cover import LensCover
from alpasim_plugin.core.errors import RendererFault
from alpasim_plugin.core.files.places import require_kernels
from alpasim_plugin.core.interfaces import Renderer, complete
from alpasim_plugin.core.parts import RendererSpec, build, resolve_renderer
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.runs.guards import calling, checked_frames
from alpasim_plugin.runs.lenses import LensRenderer


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
        name: A renderer, or a fixer over one, as `alpasim_plugin.core.parts.resolve_renderer` takes
            it; or its resolved spec.
        scenario: What is rendered.
        seed: The rollout's seed, for temporal noise and the fixer's noise.
        device: ``cpu`` or ``cuda``.
        threads: Threads of the CPU rasteriser and of a fixer's torch; None keeps their settings.
        overrides: ``KEY=VALUE`` of the fixer's settings, where ``name`` is a string.

    Raises:
        InputError: Unknown name, device or setting, or weights that are missing or wrong.
        RendererError: The device does not work.
        InfrastructureError: Kernels cannot be compiled: no folder can be written.
    """
    require_kernels()
    spec = resolve_renderer(name, overrides) if isinstance(name, str) else name
    cover = LensCover(scenario.cameras)
    pinhole_scenario = cover.drawn(scenario)
    session = {"seed": seed, "device": device, "threads": threads}
    arguments = {"scenario": pinhole_scenario, "cameras": scenario.cameras}
    built: Renderer = complete(build(spec.base, **arguments, **session), Renderer)
    from alpasim_plugin.renderers.weather import in_weather  # loads the builders of streets

    cameras = scenario.cameras if built.draws_lenses else pinhole_scenario.cameras
    base = in_weather(built, pinhole_scenario, seed, device, threads, cameras)
    if spec.fixer is None:
        has_lens = any(camera.lens is not None for camera in scenario.cameras)
        return LensRenderer(base, cover) if has_lens and not base.draws_lenses else base
    from alpasim_plugin.fixers.loop import fixed_renderer
    from alpasim_plugin.fixers.settings import FixerSettings

    fixer = spec.fixer
    settings = spec.fixer.settings
    assert isinstance(settings, FixerSettings), "the settings of a fixer derive from FixerSettings"

    with calling(base, "recorded", RendererFault):
        recorded = base.recorded() if settings.references else ()
    return fixed_renderer(
        partial(checked_frames, base, on_device=True),
        lambda: build(fixer, scene_id=scenario.scene_id, **session),
        settings,
        scenario,
        threads,
        recorded,
        cover,
        base.draws_lenses,
    )
