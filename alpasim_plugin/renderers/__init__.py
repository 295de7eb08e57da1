"""From a scene and a camera pose to a frame."""

from alpasim_plugin.renderers.base import make_renderer

__all__ = ["make_renderer"]
