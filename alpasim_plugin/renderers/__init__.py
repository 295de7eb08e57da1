"""From a scene and a camera pose to a frame."""

from alpasim_plugin.renderers import broken as broken
from alpasim_plugin.renderers import gaussian as gaussian
from alpasim_plugin.renderers import reconstruction as reconstruction
from alpasim_plugin.renderers.base import RENDERERS, make_renderer

__all__ = ["RENDERERS", "make_renderer"]
