"""Renderers by name."""

from __future__ import annotations

from alpasim_plugin.registry import Registry
from alpasim_plugin.types import Renderer, Scenario

RENDERERS: Registry[Renderer] = Registry("renderer", "simrun.renderers")


def make_renderer(name: str, scenario: Scenario, seed: int = 0, device: str = "cpu", threads: int | None = None) -> Renderer:
    """Make one rollout's renderer.

    A factory takes ``(scenario, seed, device, threads)``; scenes are built once per process and shared between renderers.

    Args:
        name: A registered renderer.
        scenario: What is rendered.
        seed: The rollout's seed: what wanders from frame to frame depends on it, the scene does not.
        device: ``cpu`` or ``cuda``.
        threads: Threads of the CPU rasteriser; None leaves numba's number.

    Raises:
        InputError: Unknown name or device.
        RendererError: The device does not work.
    """
    return RENDERERS.get(name)(scenario, seed, device, threads)
