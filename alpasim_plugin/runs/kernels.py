"""Which kernels a run needs, by subject, and the tiny case that compiles each.

Numba keeps what it compiled (``njit(cache=True)``) and names it by the kernel's own file: remove
`__pycache__` after editing a constant that a kernel of another file reads.
"""

from __future__ import annotations

import importlib

# Subject -> tiny case. Compiled two at a time, in this order, they leave no core idle for long.
SUBJECTS = {
    "map": "alpasim_plugin.fixers.pixel_network:draw_and_warp",
    "rasteriser": "alpasim_plugin.gaussians.sample_scene:rasterise",
    "network": "alpasim_plugin.fixers.pixel_network:gather_and_mix",
    # last: it calls much of what the rasteriser has compiled by then
    "gradient": "alpasim_plugin.gaussians.sample_scene:fit",
}


def call(subject: str) -> None:
    """Run the tiny case of a subject: the kernels that it calls are compiled, or loaded."""
    module, _, case = SUBJECTS[subject].partition(":")
    getattr(importlib.import_module(module), case)()
