"""Render splats for training on a GPU, through gsplat's own forward and backward kernels.

State of testing: arguments, results and gradients have been checked against a stand-in for gsplat on the CPU; the path has not been run on
a GPU. Differences to the CPU: gsplat up to 1.5.3 saturates alpha at 0.999 instead of 0.99, and its kernels sum in an order that changes
from run to run.
"""

from __future__ import annotations

import torch
from torch import Tensor

from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.raster.gradient_types import GradientOutput, ScreenStatistics, Splats
from alpasim_plugin.gaussians.raster.rasterize_gsplat import require_gsplat, view_arguments
from alpasim_plugin.gaussians.sh import SH_SIZES


def rasterize_gradient_gsplat(splats: Splats, camera: PinholeCamera, background: Tensor | None, near_m: float) -> GradientOutput:
    """Render splats whose tensors lie on one GPU; see `rasterize_gradient`, which calls this.

    Raises:
        RendererError: gsplat does not work on that device.
    """
    device = str(splats.means.device)
    gsplat = require_gsplat(device)
    centre = torch.as_tensor(camera.centre_world, device=device)
    image, alphas, meta = gsplat.rasterization(
        means=(splats.means.double() - centre).float(),
        quats=torch.nn.functional.normalize(splats.quaternions, dim=1),
        scales=splats.log_scales.exp(),
        opacities=splats.logit_opacities.sigmoid(),
        colors=splats.sh,
        sh_degree=SH_SIZES.index(splats.sh.shape[1]),
        **{**view_arguments(camera, near_m, device), "packed": False},  # so that what is returned per Gaussian has N rows
    )
    rgb, alpha, depth = image[0, ..., :3], alphas[0, ..., 0], image[0, ..., 3]
    radii = meta["radii"][0]
    screen = ScreenStatistics((radii if radii.ndim == 1 else radii.amax(dim=1)).int())
    if meta["means2d"].requires_grad:

        def keep_norm(gradient: Tensor) -> None:
            screen.gradient_norm = gradient[0].norm(dim=1)

        meta["means2d"].register_hook(keep_norm)
    if background is not None:
        rgb = rgb + (1 - alpha)[..., None] * background
    return GradientOutput(rgb, alpha, depth, screen)
