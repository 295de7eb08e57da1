"""3D Gaussians: clouds, files, cameras and rasterisers."""

from typing import TYPE_CHECKING

from alpasim_plugin.core.lazy import lazy_names

if TYPE_CHECKING:
    from alpasim_plugin.gaussians.camera import PinholeCamera as PinholeCamera
    from alpasim_plugin.gaussians.cloud import CleanReport as CleanReport
    from alpasim_plugin.gaussians.cloud import GaussianCloud as GaussianCloud
    from alpasim_plugin.gaussians.files import read_gaussians as read_gaussians
    from alpasim_plugin.gaussians.files.ply import read_ply as read_ply
    from alpasim_plugin.gaussians.files.ply import write_ply as write_ply
    from alpasim_plugin.gaussians.raster.output import RasterOutput as RasterOutput
    from alpasim_plugin.gaussians.raster.prepared import PreparedCloud as PreparedCloud
    from alpasim_plugin.gaussians.raster.prepared import prepare as prepare
    from alpasim_plugin.gaussians.raster.rasterize import rasterize as rasterize
    from alpasim_plugin.gaussians.raster.rasterize_cpu import (
        rasterize_prepared as rasterize_prepared,
    )

__all__ = [
    "CleanReport",
    "GaussianCloud",
    "PinholeCamera",
    "PreparedCloud",
    "RasterOutput",
    "prepare",
    "rasterize",
    "rasterize_prepared",
    "read_gaussians",
    "read_ply",
    "write_ply",
]

__getattr__ = lazy_names(
    __name__,
    {
        "CleanReport": ".cloud",
        "GaussianCloud": ".cloud",
        "PinholeCamera": ".camera",
        "PreparedCloud": ".raster.prepared",
        "RasterOutput": ".raster.rasterize",
        "prepare": ".raster.prepared",
        "rasterize": ".raster.rasterize",
        "rasterize_prepared": ".raster.rasterize_cpu",
        "read_gaussians": ".files",
        "read_ply": ".files.ply",
        "write_ply": ".files.ply",
    },
)
