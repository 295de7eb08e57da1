"""The CPU rasteriser against gsplat's own code in torch: the same scene, image beside time.

    pip install gsplat==1.5.3 nerfacc==0.5.3 jaxtyping && python docs/scripts/gsplat_reference.py

gsplat computes projection, colours, tiles and compositing (`gsplat.cuda._torch_impl`). Two steps of
it need a GPU and are done here: which splats of a tile touch which pixel, which is not timed, and
the product of what lets light through along a ray, where nerfacc calls a CUDA kernel. So its time
is a lower bound; it is given without its tiles too, a loop of Python. Its alphas end at 0.999, ours
and those of gsplat 1.6 at 0.99: they are cut at ours.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from typing import Any

import nerfacc
import numpy as np
import torch
from gsplat.cuda import _torch_impl as gsplat

from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    NEAR_M,
    TILE,
    TRANSMITTANCE_STOP,
)
from alpasim_plugin.gaussians.raster.prepared import prepare
from alpasim_plugin.gaussians.raster.rasterize_cpu import rasterize_prepared
from alpasim_plugin.gaussians.raster.rasterize_gsplat import gsplat_arguments
from alpasim_plugin.gaussians.sample_scene import driving_camera, driving_like_scene

HEAD = (
    "| Gaussians | image | blends, million | ours, ms | gsplat, ms | its tiles, ms | ratio | with its tiles |"
    " error, 1/255: median | largest | above 1, of a million |"
)
Arguments = dict[str, Any]
Splats = tuple[
    torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor
]  # radii, means2d, depths, conics


def weights_along_rays(
    alphas: torch.Tensor, ray_indices: torch.Tensor, n_rays: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Do what `nerfacc.render_weight_from_alpha` does on a GPU, for pairs in the order of rays and,
    within one, of depth.
    """
    alphas = alphas.clamp_max(ALPHA_MAX)
    log_through = torch.log1p(-alphas.double())
    before = torch.cumsum(log_through, 0) - log_through
    first = torch.ones_like(ray_indices, dtype=torch.bool)
    first[1:] = ray_indices[1:] != ray_indices[:-1]
    start = torch.zeros(n_rays, dtype=torch.float64).index_put_(
        (ray_indices[first],), before[first]
    )
    trans = torch.exp(before - start[ray_indices]).float()
    return trans * alphas, trans


def project(given: Arguments) -> Splats:
    """Give gsplat's projection of one view."""
    covars, _ = gsplat._quat_scale_to_covar_preci(
        given["quats"], given["scales"], compute_preci=False
    )
    radii, means, depths, conics, _ = gsplat._fully_fused_projection(
        given["means"],
        covars,
        given["viewmats"],
        given["Ks"],
        given["width"],
        given["height"],
        given["eps2d"],
        given["near_plane"],
    )
    return radii[0], means[0], depths[0], conics[0]


def colours_of(given: Arguments) -> torch.Tensor:
    """Give gsplat's colours; the camera is at the origin."""
    return torch.clamp_min(
        gsplat._spherical_harmonics(given["sh_degree"], given["means"], given["colors"]) + 0.5, 0.0
    )


def pairs(
    splats: Splats, opacities: torch.Tensor, width: int, height: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the splats and pixels of all pairs that are blended, in the order of pixels and,
    within one, of depth.
    """
    radii, means, depths, conics = (tensor.double().numpy() for tensor in splats)
    peak = opacities.double().numpy()
    order = np.argsort(depths, kind="stable")
    order = order[(radii[order] > 0).all(1)]
    low = np.clip(np.floor(means[order] - radii[order]), 0, [width, height]).astype(np.int64)
    size = np.clip(np.ceil(means[order] + radii[order]), 0, [width, height]).astype(np.int64) - low
    found_splats, found_pixels = [], []
    for some in np.array_split(np.arange(len(order)), max(1, int(size.prod(1).sum() // 4_000_000))):
        count = size[some].prod(1)
        mine = np.repeat(some, count)
        within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        x, y = low[mine, 0] + within % size[mine, 0], low[mine, 1] + within // size[mine, 0]
        splat = order[mine]
        dx, dy = x + 0.5 - means[splat, 0], y + 0.5 - means[splat, 1]
        sigma = (
            0.5 * (conics[splat, 0] * dx**2 + conics[splat, 2] * dy**2) + conics[splat, 1] * dx * dy
        )
        drawn = (sigma >= 0) & (np.minimum(peak[splat] * np.exp(-sigma), ALPHA_MAX) >= ALPHA_MIN)
        found_splats.append(splat[drawn])
        found_pixels.append((y * width + x)[drawn])
    splat, pixel = np.concatenate(found_splats), np.concatenate(found_pixels)
    by_pixel = np.argsort(pixel, kind="stable")
    splat, pixel = splat[by_pixel], pixel[by_pixel]
    delta = np.stack([pixel % width, pixel // width], 1) + 0.5 - means[splat]
    c = conics[splat]
    alpha = peak[splat] * np.exp(
        -0.5 * (c[:, 0] * delta[:, 0] ** 2 + c[:, 2] * delta[:, 1] ** 2)
        - c[:, 1] * delta[:, 0] * delta[:, 1]
    )
    _, through = weights_along_rays(
        torch.from_numpy(alpha), torch.from_numpy(pixel), width * height
    )
    after = through.numpy() * (1 - np.minimum(alpha, ALPHA_MAX))
    kept = (
        after > TRANSMITTANCE_STOP
    )  # the stop: the splat that would fall to it is not drawn, and no later one
    return torch.from_numpy(splat[kept]), torch.from_numpy(pixel[kept])


def median_ms(call: Callable[[], object], repeats: int) -> float:
    """Return the median time that passed, milliseconds."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - began))
    return float(np.median(times))


def compare(cloud: GaussianCloud, camera: PinholeCamera, threads: int, repeats: int) -> str:
    """Draw one scene both ways and return its row of the table."""
    given = gsplat_arguments(cloud, camera, NEAR_M, "cpu")
    width, height = camera.width, camera.height
    splats = project(given)
    ids, pixels = pairs(splats, given["opacities"], width, height)

    def theirs() -> torch.Tensor:
        _, means, _, conics = project(given)
        image, _ = gsplat.accumulate(
            means[None],
            conics[None],
            given["opacities"][None],
            colours_of(given)[None],
            ids,
            pixels,
            torch.zeros_like(ids),
            width,
            height,
        )
        return image[0]

    nodes = [(prepare(cloud), None)]

    def mine() -> np.ndarray[Any, Any]:
        return rasterize_prepared(nodes, camera, (0.0, 0.0, 0.0), threads=threads).rgb

    error = 255 * np.abs(mine() - theirs().clamp(0, 1).numpy()).max(2)
    radii, means, depths, _ = splats
    tiles_ms = median_ms(
        lambda: gsplat._isect_tiles(
            means[None], radii[None], depths[None], TILE, -(-width // TILE), -(-height // TILE)
        ),
        1,
    )
    # In turns: other work on the machine then slows both.
    before_ms = median_ms(mine, 10 * repeats)
    theirs_ms = median_ms(theirs, repeats)
    after_ms = median_ms(mine, 10 * repeats)
    ours_ms = min(before_ms, after_ms)
    cells = (
        len(cloud),
        f"{width}x{height}",
        f"{len(ids) / 1e6:.2f}",
        f"{ours_ms:.1f}",
        f"{theirs_ms:.0f}",
        f"{tiles_ms:.0f}",
        f"{theirs_ms / ours_ms:.0f}",
        f"{(theirs_ms + tiles_ms) / ours_ms:.0f}",
        f"{np.median(error):.4f}",
        f"{error.max():.2f}",
        f"{1e6 * np.mean(error > 1):.0f}",
    )
    return f"| {' | '.join(map(str, cells))} |"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="Of both.")
    parser.add_argument(
        "--repeats",
        type=int,
        default=5,
        help="Images of gsplat; ten times as many of ours before, and after.",
    )
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    nerfacc.render_weight_from_alpha = weights_along_rays  # what gsplat imports at each call
    print(HEAD)
    print(f"|{'---:|' * 11}")
    with torch.no_grad():
        for n, width, height in ((100_000, 256, 144), (100_000, 480, 272), (500_000, 960, 540)):
            print(
                compare(
                    driving_like_scene(n),
                    driving_camera(width, height),
                    options.threads,
                    options.repeats,
                ),
                flush=True,
            )
