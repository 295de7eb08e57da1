"""Sources of ``alpasim-onefixer-bridge``: Hydra presets for AlpaSim's own environment.

The distribution is put together by `build.py`. Nothing here imports the rest of the project.
"""
