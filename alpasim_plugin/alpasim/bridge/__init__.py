"""Sources of ``alpasim-onefixer-bridge``: what AlpaSim's own environment needs of this project,
without torch, numba or PyAV.

The distribution is put together by `build.py`, under the name ``alpasim_onefixer_bridge``: the wire
messages, Hydra presets, and ``onefixer-bridge``, which asks a renderer service what it is. Nothing
here imports the rest of the project.
"""
