"""3D Gaussians: clouds, files, cameras and rasterisers."""

from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import CleanReport, GaussianCloud
from alpasim_plugin.gaussians.files.formats import read_gaussians
from alpasim_plugin.gaussians.files.ply import read_ply, write_ply
from alpasim_plugin.gaussians.raster.output import RasterOutput
from alpasim_plugin.gaussians.raster.prepared import PreparedCloud, prepare
from alpasim_plugin.gaussians.raster.rasterize import rasterize
from alpasim_plugin.gaussians.raster.rasterize_cpu import rasterize_prepared

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
