"""From a scene and a camera pose to a frame."""

from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.parts import build, unidentified
from alpasim_plugin.core.types import Scenario


def make_renderer(
    name: str, scenario: Scenario, seed: int = 0, device: str = "cpu", threads: int | None = None
) -> Renderer:
    """Make one rollout's renderer.

    Scenes are built once per process and shared between renderers.

    Args:
        name: A renderer as `alpasim_plugin.core.parts.resolve` takes it.
        scenario: What is rendered.
        seed: The rollout's seed: what wanders from frame to frame depends on it, the scene does
            not.
        device: ``cpu`` or ``cuda``.
        threads: Threads of the CPU rasteriser; None leaves numba's number.

    Raises:
        InputError: Unknown name or device.
        RendererError: The device does not work.
    """
    from alpasim_plugin.renderers.weather import in_weather  # loads the builders of streets

    renderer: Renderer = build(
        unidentified("renderer", name), scenario=scenario, seed=seed, device=device, threads=threads
    )
    return in_weather(renderer, scenario, seed, device, threads)
