"""Render on a GPU through gsplat, where it works.

gsplat compiles CUDA code on first use, so a successful import does not show that it works. The
backend first draws one Gaussian and checks the result. It never falls back to another backend; the
error says what is missing.

State of testing: arguments and results have been checked against a stand-in for gsplat on the CPU;
the path has not been run on a GPU. Difference to the CPU: gsplat up to 1.5.3 saturates alpha at
0.999, this package and gsplat 1.6 at 0.99.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch

from alpasim_plugin.core.errors import RendererError
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.constants import EPS2D_PX2, FAR_M, NEAR_M
from alpasim_plugin.gaussians.raster.output import Background, RasterOutput, background_image


def gsplat_arguments(
    cloud: GaussianCloud, camera: PinholeCamera, near_m: float, device: str
) -> dict[str, Any]:
    """Return the keyword arguments of ``gsplat.rasterization`` for one view of a cloud.

    Means are given relative to the camera centre, subtracted in float64, and the view matrix only
    rotates: gsplat computes in float32, where UTM-sized coordinates would move by centimetres. View
    directions, and so colours, stay those of the world's axes.
    """
    quats = cloud.quats.astype(np.float64)
    view = np.eye(4)
    view[:3, :3] = camera.T_camera_world[:3, :3]
    return {
        "means": _tensor(cloud.means.astype(np.float64) - camera.centre_world, device),
        "quats": _tensor(quats / np.linalg.norm(quats, axis=1, keepdims=True), device),
        "scales": _tensor(cloud.scales, device),
        "opacities": _tensor(cloud.opacities, device),
        "colors": _tensor(cloud.sh, device),
        "sh_degree": cloud.sh_degree,
        "viewmats": _tensor(view, device)[None],
        "Ks": _tensor(camera.K, device)[None],
        "width": camera.width,
        "height": camera.height,
        "near_plane": near_m,
        "far_plane": FAR_M,
        "radius_clip": 0.0,
        "eps2d": EPS2D_PX2,
        "packed": True,
        "tile_size": 16,
        "render_mode": "RGB+ED",
        "rasterize_mode": "classic",
    }


def _tensor(array: np.ndarray[Any, Any], device: str) -> torch.Tensor:
    return torch.as_tensor(np.array(array, dtype=np.float32), device=device)


def _draw(
    gsplat: Any,
    cloud: GaussianCloud,
    camera: PinholeCamera,
    background: Background,
    near_m: float,
    device: str,
) -> RasterOutput:
    """Call gsplat and put the background behind its image; gsplat takes one colour only."""
    with torch.no_grad():
        colours, alphas, _ = gsplat.rasterization(**gsplat_arguments(cloud, camera, near_m, device))
    image, alpha = colours[0].float().cpu().numpy(), alphas[0, ..., 0].float().cpu().numpy()
    rgb = np.clip(
        image[..., :3] + (1 - alpha[..., None]) * background_image(background, camera), 0, 1
    ).astype(np.float32)
    depth = np.where(alpha > 0, image[..., 3], 0).astype(np.float32)
    return RasterOutput(rgb, alpha, depth, {"gaussians": len(cloud)})


@lru_cache(maxsize=4)
def require_gsplat(device: str = "cuda") -> Any:
    """Return the gsplat module after it has drawn one Gaussian correctly on the device.

    Raises:
        RendererError: gsplat or the device is missing, or the test image is wrong.
    """
    try:
        import gsplat
    except ImportError as error:
        raise RendererError(
            f"the package gsplat: it does not import ({error})",
            "install the extra [gpu], or choose --device cpu (backend='cpu' in code)",
        ) from error
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise RendererError(
            f"device {device!r}: torch sees no CUDA device",
            "run on a machine with an NVIDIA GPU, or choose --device cpu (backend='cpu' in code)",
        )
    cloud = GaussianCloud(
        np.array([[0, 0, 5.0]]),
        np.array([[1.0, 0, 0, 0]]),
        np.array([[0.5, 0.5, 0.5]]),
        np.array([0.9]),
        np.zeros((1, 1, 3)),
    )
    K = np.array([[20.0, 0, 8.5], [0, 20, 8.5], [0, 0, 1]])
    try:
        out = _draw(
            gsplat, cloud, PinholeCamera(17, 17, K, np.eye(4)), (0.0, 0.0, 0.0), NEAR_M, device
        )
    # Whatever a compiler, driver or CUDA kernel can raise is reported as one error with its cause
    # attached.
    except Exception as error:
        raise RendererError(
            f"a test image of one Gaussian: {type(error).__name__}: {error}",
            "check that gsplat's CUDA kernels match torch and the driver, or choose --device cpu (backend='cpu' in code)",
        ) from error
    centre = (float(out.alpha[8, 8]), float(out.rgb[8, 8, 0]), float(out.depth[8, 8]))
    if not np.allclose(centre, (0.9, 0.45, 5.0), atol=0.01):
        raise RendererError(
            f"a test image of one Gaussian: alpha, red and depth {centre} at its centre instead of (0.9, 0.45, 5.0)",
            "install a gsplat build that matches this GPU, or choose --device cpu (backend='cpu' in code)",
        )
    return gsplat


def rasterize_gsplat(
    cloud: GaussianCloud,
    camera: PinholeCamera,
    background: Background = (0.0, 0.0, 0.0),
    *,
    near_m: float = NEAR_M,
    device: str = "cuda",
) -> RasterOutput:
    """Render a cloud on the GPU.

    Raises:
        InputError: The cloud cannot be drawn.
        RendererError: gsplat does not work here.
    """
    gsplat = require_gsplat(device)
    cloud.require_drawable()
    if len(cloud) == 0:
        shape = (camera.height, camera.width)
        rgb = np.broadcast_to(
            np.clip(background_image(background, camera), 0, 1), (*shape, 3)
        ).copy()
        return RasterOutput(
            rgb, np.zeros(shape, np.float32), np.zeros(shape, np.float32), {"gaussians": 0}
        )
    return _draw(gsplat, cloud, camera, background, near_m, device)
