"""Render splats for training: one `torch.autograd.Function` whose forward and backward passes are
compiled CPU kernels.

`rasterize_reference` is the definition.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.constants import (
    BUNDLE,
    GEO_SIZE,
    NEAR_M,
    POSE_CENTRE,
    RADIUS_X,
    RADIUS_Y,
    RECORD,
)
from alpasim_plugin.gaussians.raster.gradient_kernels import PAIR, colour_splats, tile_gradients
from alpasim_plugin.gaussians.raster.gradient_project import pack, splat_gradients, sum_pairs
from alpasim_plugin.gaussians.raster.gradient_types import GradientOutput, ScreenStatistics, Splats
from alpasim_plugin.gaussians.raster.output import Background, RasterOutput, background_image
from alpasim_plugin.gaussians.raster.raster_kernels import KEPT
from alpasim_plugin.gaussians.raster.rasterize_cpu import (
    WORTH_THREADS,
    TileLists,
    camera_numbers,
    composite,
    depth_order,
    list_per_tile,
    node_poses,
    project_parts,
    run_on_threads,
    thread_count,
)

_LANES = 16
F32 = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class _View:
    """One camera as the kernels read it."""

    camera: PinholeCamera
    numbers: F32
    pose: F64
    threads: int


@dataclass(frozen=True, eq=False)
class _Parameters:
    """The splats' parameters as arrays that share memory with the tensors where types allow."""

    means: F64
    log_scales: F32
    quaternions: F32
    logits: F32
    sh: F32

    @classmethod
    def of(cls, *tensors: Tensor) -> _Parameters:
        means, *rest = tensors
        arrays = (t.detach().to(torch.float32).contiguous().numpy() for t in rest)
        return cls(means.detach().to(torch.float64).contiguous().numpy(), *arrays)


@dataclass(frozen=True, eq=False)
class _Kept:
    """What the forward pass keeps for the backward pass."""

    tiles: TileLists
    records: F32  # RECORD per rank
    gaussian: npt.NDArray[np.int64]  # (M,) which Gaussian each rank shows
    pixels: F32  # per tile, see gradient_kernels


def _chunk(count: int) -> int:
    """Return how many splats to take at once: at most 64 chunks, whatever the number of threads."""
    return max(512, -(-count // 64))


def _project(p: _Parameters, view: _View) -> tuple[TileLists, F32, npt.NDArray[np.int64]]:
    """Project, sort and list the splats, colours included; returns the lists, the records by rank
    and which Gaussian each shows.
    """
    n = len(p.means)
    groups = -(-n // _LANES)
    lane_means, geometry = (
        np.empty(groups * 3 * _LANES),
        np.zeros(groups * GEO_SIZE * _LANES, np.float32),
    )
    bad = pack(p.means, p.log_scales, p.quaternions, p.logits, lane_means, geometry)
    if bad >= 0:
        _refuse(p, bad)
    records, ids = np.empty(n * RECORD, np.float32), np.empty(n, np.int64)
    # Colours follow for the visible ones alone, and bundles in the optimiser's order have no
    # bounding spheres worth a test.
    plain = np.zeros(groups * 3 * _LANES, np.float32)
    everywhere = np.tile([0.0, 0.0, 0.0, np.inf, 0.0], -(-n // BUNDLE))
    index = np.arange(groups * _LANES)
    workers = view.threads if n > WORTH_THREADS else 1
    part = (lane_means, geometry, plain, 1, index, everywhere, np.int64(0), view.pose)
    count = project_parts(workers, [part], view.numbers, records, ids)
    cursor = np.zeros(2, np.int64)
    centre = view.pose[POSE_CENTRE : POSE_CENTRE + 3]
    run_on_threads(
        workers, colour_splats, cursor, _chunk(count), count, ids, p.means, centre, p.sh, records
    )
    if cursor[1]:
        _refuse(p, -1)
    order = depth_order(records[: count * RECORD], ids[:count])
    # In the order of depth, so that numbers ascend within a tile and the pairs of a range of splats
    # are found by bisection.
    ordered = records.reshape(n, RECORD)[order].reshape(-1)
    tiles = list_per_tile(np.arange(count), ordered, view.camera, view.threads)
    return tiles, ordered, ids[order]


def _refuse(p: _Parameters, bad: int) -> None:
    """Raise the error about Gaussian ``bad``, or about a colour where that is below zero.

    Raises:
        InputError: Always.
    """
    cause = "a mean, scale, opacity or quaternion that is not finite, a quaternion of length zero or a scale beyond exp(20) m"
    if bad < 0:
        bad, cause = (
            int(np.argmin(np.isfinite(p.sh).all(axis=(1, 2)))),
            "a colour that is not finite",
        )
    raise InputError(
        f"{len(p.means)} splats: number {bad} has {cause}",
        "lower the learning rate, or drop such splats",
    )


class _Rasterize(torch.autograd.Function):
    """Colour sum, alpha and depth sum of one view; the background is added outside."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        log_scales: Tensor,
        quaternions: Tensor,
        logits: Tensor,
        sh: Tensor,
        view: _View,
        screen: ScreenStatistics,
    ) -> tuple[Tensor, Tensor, Tensor]:
        p = _Parameters.of(means, log_scales, quaternions, logits, sh)
        tiles, records, gaussian = _project(p, view)
        pixels = np.empty((len(tiles.starts) - 1) * _LANES * KEPT, np.float32)
        images = composite(tiles, records, pixels, view.camera, view.threads)
        boxes = records.reshape(-1, RECORD)[:, [RADIUS_X, RADIUS_Y]]
        screen.radii[torch.from_numpy(gaussian)] = torch.from_numpy(
            np.ceil(boxes.max(axis=1, initial=0.0)).astype(np.int32)
        )
        ctx.save_for_backward(means, log_scales, quaternions, logits, sh)
        ctx.view, ctx.screen, ctx.kept = view, screen, _Kept(tiles, records, gaussian, pixels)
        colour, alpha, depth_sum = (torch.from_numpy(image) for image in images)
        return colour, alpha, depth_sum

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        view = ctx.view
        kept = ctx.kept
        tensors = ctx.saved_tensors
        p = _Parameters.of(*tensors)
        tiles = kept.tiles
        g_colour, g_alpha, g_depth = (g.to(torch.float32).contiguous().numpy() for g in gradients)
        pairs = np.zeros(len(tiles.lists) * PAIR, np.float32)
        lists = (np.zeros(1, np.int64), tiles.columns, tiles.starts, tiles.lists, kept.records)
        images = (kept.pixels, g_colour, g_alpha, g_depth)
        run_on_threads(view.threads, tile_gradients, *lists, *images, pairs)
        sums = np.empty(len(p.means) * PAIR, np.float32)
        workers = view.threads if len(kept.gaussian) > WORTH_THREADS else 1
        chunks = (np.zeros(1, np.int64), _chunk(len(kept.gaussian)), kept.gaussian)
        splats = (tiles.starts, tiles.lists, pairs, kept.records, sums)
        run_on_threads(workers, sum_pairs, *chunks, *splats)
        parameters = (p.means, p.log_scales, p.quaternions, p.logits, p.sh)
        out = [np.zeros(a.shape, a.dtype) for a in parameters]
        norm = np.zeros(len(p.means), np.float32)
        chunks = (np.zeros(1, np.int64), _chunk(len(p.means)), ctx.screen.radii.numpy())
        seen = (sums, view.pose, view.numbers)
        run_on_threads(workers, splat_gradients, *chunks, *seen, *parameters, *out, norm)
        ctx.screen.gradient_norm = torch.from_numpy(norm)
        return (
            *(torch.from_numpy(g).to(t.dtype) for g, t in zip(out, tensors, strict=True)),
            None,
            None,
        )


def rasterize_gradient(
    splats: Splats,
    camera: PinholeCamera,
    *,
    background: Tensor | None = None,
    near_m: float = NEAR_M,
    threads: int | None = None,
) -> GradientOutput:
    """Render splats by the rule of `rasterize_reference`, with gradients of every parameter and of
    the background.

    What ends the gradient is what ends the splat's part in the image: the alpha cut, the largest
    alpha (for opacity and shape, not for colour and depth), the stop, the clamped slope in the
    covariance's Jacobian, a colour clamped at 0.

    Args:
        splats: What to draw; tensors on the CPU.
        camera: From where.
        background: ``(3,)`` or ``(H, W, 3)``, 0..1; None is black. May require gradients.
        near_m: Gaussians whose centre is nearer are left out.
        threads: CPU threads; None takes ``numba.get_num_threads()``. Neither image nor gradients
            depend on it.

    Returns:
        The image with its graph. A second backward pass through the same graph needs
        ``retain_graph=True`` as usual; second derivatives are not available.

    Raises:
        InputError: A splat that cannot be drawn, or a background that does not fit.

    Example:
        >>> import numpy as np, torch
        >>> from alpasim_plugin.gaussians import GaussianCloud
        >>> cloud = GaussianCloud([[0, 0, 5.0]], [[1.0, 0, 0, 0]], [[0.5, 0.5, 0.5]], [0.9], np.zeros((1, 1, 3)))
        >>> splats = Splats.from_cloud(cloud)
        >>> _ = splats.means.requires_grad_(True)
        >>> K = np.array([[30.0, 0, 16], [0, 30, 8], [0, 0, 1]])
        >>> out = rasterize_gradient(splats, PinholeCamera(32, 16, K, np.eye(4)))
        >>> out.alpha[:, :16].sum().backward()
        >>> bool(splats.means.grad[0, 0] < 0), out.screen.gradient_norm.shape
        (True, torch.Size([1]))
    """
    size = (camera.height, camera.width, 3)
    if background is not None and background.shape not in ((3,), size):
        raise InputError(
            f"a background of shape {tuple(background.shape)}: a camera of {camera.width} x {camera.height} pixels",
            f"give a tensor of shape (3,) or {size}",
        )
    pose = node_poses([None], camera, near_m)[0]
    view = _View(camera, camera_numbers(camera), pose, thread_count(threads))
    screen = ScreenStatistics(torch.zeros(len(splats), dtype=torch.int32))
    colour, alpha, depth_sum = _Rasterize.apply(
        splats.means,
        splats.log_scales,
        splats.quaternions,
        splats.logit_opacities,
        splats.sh,
        view,
        screen,
    )  # type: ignore[no-untyped-call]
    rgb = colour if background is None else colour + (1 - alpha)[..., None] * background.float()
    depth = torch.where(alpha > 0, depth_sum / torch.where(alpha > 0, alpha, 1.0), 0.0)
    return GradientOutput(rgb, alpha, depth, screen)


def rasterize_torch(
    cloud: GaussianCloud,
    camera: PinholeCamera,
    background: Background = (0.0, 0.0, 0.0),
    *,
    near_m: float = NEAR_M,
) -> RasterOutput:
    """Render a cloud by `rasterize_gradient`, without gradients.

    Splats are float32, so the cloud and the camera are moved to the camera's centre first:
    UTM-sized coordinates cost no precision.

    Raises:
        InputError: The cloud holds Gaussians that cannot be drawn or was trained with antialiasing,
            or the background does not fit.
    """
    cloud.require_drawable()
    if cloud.antialias_px2:
        raise InputError(
            f"a cloud trained with antialiasing ({cloud.antialias_px2} px^2): a fit knows none",
            "draw it with another backend",
        )
    behind = torch.as_tensor(background_image(background, camera)).expand(
        camera.height, camera.width, 3
    )
    rotation = camera.T_camera_world[:3, :3]
    centre = -rotation.T @ camera.T_camera_world[:3, 3]
    T_camera_local = np.eye(4)
    T_camera_local[:3, :3] = rotation
    splats = Splats.from_cloud(replace(cloud, means=cloud.means - centre))
    local_camera = replace(camera, T_camera_world=T_camera_local)
    with torch.no_grad():
        out = rasterize_gradient(splats, local_camera, background=behind, near_m=near_m)
    return RasterOutput(
        out.rgb.clamp(0, 1).numpy(), out.alpha.numpy(), out.depth.numpy(), {"gaussians": len(cloud)}
    )
