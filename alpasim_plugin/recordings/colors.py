"""Colours of recordings, the same in every viewer: each renderer has one, and so has each kind of line of the map."""

from __future__ import annotations

from alpasim_plugin.recordings.content import Kind

Rgba = tuple[float, float, float, float]

RENDERERS: tuple[Rgba, ...] = (
    (0.04, 0.42, 0.70, 1.0), (0.85, 0.40, 0.08, 1.0), (0.0, 0.60, 0.45, 1.0), (0.65, 0.33, 0.60, 1.0), (0.65, 0.52, 0.0, 1.0),
)  # fmt: skip
MAP: dict[Kind, Rgba] = {
    "lane border": (0.75, 0.75, 0.78, 1.0),
    "road edge": (0.45, 0.48, 0.52, 1.0),
    "crosswalk": (0.60, 0.62, 0.65, 1.0),
    "recorded drive": (0.95, 0.95, 0.95, 0.8),
}
ROAD_USER: Rgba = (0.55, 0.57, 0.60, 0.8)


def of_renderer(number: int) -> Rgba:
    """Return the colour of the n-th renderer."""
    return RENDERERS[number % len(RENDERERS)]


def fainter(rgba: Rgba, alpha: float) -> Rgba:
    """Return a colour that lets more through."""
    return (*rgba[:3], alpha)


def as_bytes(rgba: Rgba) -> tuple[int, int, int, int]:
    """Return the parts from 0 to 255."""
    red, green, blue, alpha = (round(255 * part) for part in rgba)
    return red, green, blue, alpha
