"""Render splats for training: torch projects them, compiled kernels composite the tiles and take the
image's gradient back to the projected splats, on the CPU or on a GPU.

`rasterize_reference` is the definition.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.core.devices import upload
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud, logit
from alpasim_plugin.gaussians.constants import (
    ALPHA_MIN,
    BLOCK_REACH,
    EPS2D_PX2,
    EXPONENT_SCALE,
    EXTENT_MAX_SIGMA,
    NEAR_M,
    PEAK,
    RADIUS_X,
    RADIUS_Y,
    RECORD,
    TILE,
    U,
    V,
    Z,
)
from alpasim_plugin.gaussians.lens_camera import LensCamera
from alpasim_plugin.gaussians.raster.gradient_kernels import (
    PAIR,
    PAIR_H,
    PAIR_R,
    PAIR_S,
    PAIR_SS,
    PAIR_ST,
    PAIR_T,
    PAIR_TT,
    PAIR_Z,
    add_pairs,
    tile_gradients,
)
from alpasim_plugin.gaussians.raster.output import Background, RasterOutput, background_image
from alpasim_plugin.gaussians.raster.project_kernels import BLOCK_HALF, MARGIN_PX
from alpasim_plugin.gaussians.raster.raster_kernels import CUT, KEPT
from alpasim_plugin.gaussians.raster.rasterize_cpu import composite, list_per_tile
from alpasim_plugin.gaussians.raster.rasterize_triton import (
    ProjectedSplats,
    TileCompositor,
    tile_grid,
)
from alpasim_plugin.gaussians.raster.splats import (
    GradientOutput,
    Splats,
    colours_of,
    cross3,
    screen_covariance,
)
from alpasim_plugin.gaussians.raster.stages import depth_order, run_on_threads, thread_count


def rasterize_gradient(
    splats: Splats,
    camera: PinholeCamera | LensCamera,
    *,
    background: Tensor | None = None,
    near_m: float = NEAR_M,
    threads: int | None = None,
    compositor: TileCompositor | None = None,
) -> GradientOutput:
    """Render splats by the rule of `rasterize_reference`, with gradients of every parameter and of
    the background.

    What ends the gradient is what ends the splat's part in the image: the alpha cut, the largest
    alpha (for opacity and shape, not for colour and depth), the stop, the clamped slope in the
    covariance's Jacobian, a colour clamped at 0.

    Args:
        splats: What to draw; tensors of the compositor's device.
        camera: From where; through a lens by the rule of `rasterize_lens`, on the CPU alone.
        background: ``(3,)`` or ``(H, W, 3)``, 0..1; None is black. May require gradients.
        near_m: Gaussians whose centre is nearer are left out.
        threads: CPU threads; None takes ``numba.get_num_threads()``. Neither image nor gradients
            depend on it.
        compositor: Of a GPU; None composites on the CPU.

    Returns:
        The image with its graph; second derivatives are not available.

    Raises:
        InputError: A lens on a GPU, or one with a rolling shutter.

    Example:
        >>> import numpy as np, torch
        >>> from alpasim_plugin.gaussians import GaussianCloud
        >>> cloud = GaussianCloud([[0, 0, 5.0]], [[1.0, 0, 0, 0]], [[0.5, 0.5, 0.5]], [0.9], np.zeros((1, 1, 3)))
        >>> splats = Splats.from_cloud(cloud)
        >>> _ = splats.means.requires_grad_(True)
        >>> K = np.array([[30.0, 0, 16], [0, 30, 8], [0, 0, 1]])
        >>> out = rasterize_gradient(splats, PinholeCamera(32, 16, K, np.eye(4)))
        >>> out.alpha[:, :16].sum().backward()
        >>> bool(splats.means.grad[0, 0] < 0), out.uv.grad.shape
        (True, torch.Size([1, 2]))
    """
    if isinstance(camera, LensCamera):
        return _through_lens(splats, camera, background, near_m, threads, compositor)
    candidates = _candidates_of(splats, camera, near_m, all_of_them=compositor is not None)
    local = candidates.local
    uv, m, n = _ellipses(local, candidates.splats, camera)
    if uv.requires_grad:
        uv.retain_grad()
    log_opacity = torch.nn.functional.logsigmoid(candidates.splats.logit_opacities)
    colours = colours_of(local, candidates.splats.sh, camera)
    projected = (uv, m, n, log_opacity, colours, local[2])
    with torch.no_grad():
        scale = EXPONENT_SCALE if compositor is None else 1.0
        records = _records(*projected, scale)
        on_screen = candidates.is_drawn & _reaches_the_image(records, camera)
        if compositor is None:
            images, sums, pairs = _on_cpu(records, camera, thread_count(threads))
        else:
            images, sums, pairs = _on_gpu(records, log_opacity, on_screen, camera, compositor)
    colour_sum, alpha, depth_sum = _Composite.apply(*projected, images, sums, scale)  # type: ignore[no-untyped-call]
    rgb = colour_sum
    if background is not None:
        rgb = rgb + (1 - alpha)[..., None] * background.float()
    depth = torch.where(alpha > 0, depth_sum / torch.where(alpha > 0, alpha, 1.0), 0.0)
    return GradientOutput(rgb, alpha, depth, candidates.index, uv, on_screen, pairs)


def _through_lens(
    splats: Splats,
    camera: LensCamera,
    background: Tensor | None,
    near_m: float,
    threads: int | None,
    compositor: TileCompositor | None,
) -> GradientOutput:
    if compositor is not None:
        raise InputError(
            "a camera with a lens: a GPU fits to images of pinholes alone",
            "fit on the cpu, or free the photographs of their distortion first",
        )
    # Its kernels are looked up only where somebody fits through a lens.
    from alpasim_plugin.gaussians.raster.rasterize_lens_gradient import rasterize_lens_gradient

    return rasterize_lens_gradient(
        splats, camera, background=background, near_m=near_m, threads=threads
    )


@dataclass(frozen=True)
class _CandidateSplats:
    """Splats that may reach the image.

    Attributes:
        index: ``(M,)`` which of all splats they are.
        splats: The ``M`` splats.
        local: ``(3, M)`` their centres in the camera.
        is_drawn: ``(M,)`` bool; the others have no part in the image.
    """

    index: Tensor
    splats: Splats
    local: Tensor
    is_drawn: Tensor


def _candidates_of(
    splats: Splats, camera: PinholeCamera, near_m: float, all_of_them: bool
) -> _CandidateSplats:
    """Return the splats that may reach the image, nearest first; or all of them with what says
    which are drawn, where the host must not wait for their number.
    """
    if not all_of_them:
        with torch.no_grad():
            index = _indices_in_view(splats, camera, near_m)
        chosen = Splats(*(tensor.index_select(0, index) for tensor in splats))
        is_drawn = torch.ones_like(index, dtype=torch.bool)
        return _CandidateSplats(index, chosen, _in_camera(chosen.means, camera), is_drawn)
    local = _in_camera(splats.means, camera)
    is_drawn = _is_drawn(local, splats, near_m)
    index = torch.arange(len(is_drawn), device=is_drawn.device)
    # What is behind the camera has no projection: its gradient would be 0 times infinity.
    return _CandidateSplats(index, splats, torch.where(is_drawn, local, 1.0), is_drawn)


def _reaches_the_image(records: Tensor, camera: PinholeCamera) -> Tensor:
    """Return ``(M,)`` whether the box around a projected splat meets the middle of a pixel."""
    centre = records[:, U : V + 1]
    reach = records[:, RADIUS_X : RADIUS_Y + 1]
    last = upload([camera.width - 0.5, camera.height - 0.5], records.device)
    return ((centre + reach >= 0.5) & (centre - reach <= last)).all(dim=1)


def rasterize_torch(
    cloud: GaussianCloud,
    camera: PinholeCamera,
    background: Background = (0.0, 0.0, 0.0),
    *,
    near_m: float = NEAR_M,
) -> RasterOutput:
    """Render a cloud by `rasterize_gradient`, without gradients.

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
    behind = torch.as_tensor(background_image(background, camera))
    out = rasterize_gradient(Splats.from_cloud(cloud), camera, background=behind, near_m=near_m)
    return RasterOutput(out.rgb.clamp(0, 1).numpy(), out.alpha.numpy(), out.depth.numpy())


def _indices_in_view(splats: Splats, camera: PinholeCamera, near_m: float) -> Tensor:
    """Return the Gaussians ``(M,)`` that can reach the image, nearest first; equal depths keep
    their order.

    The rows of J R_camera have the lengths ``focal / z sqrt(1 + slope^2)``, so the largest scale
    bounds the ellipse.
    """
    local = _in_camera(splats.means, camera)
    index = torch.nonzero(_is_drawn(local, splats, near_m))[:, 0]
    x, y, z = local[:, index]
    low_x, high_x, low_y, high_y = camera.slope_limits()
    largest = splats.log_scales.index_select(0, index).amax(dim=1).exp() / z
    slope_x = x / z
    slope_y = y / z
    steep_x = slope_x.clamp(low_x, high_x)
    steep_y = slope_y.clamp(low_y, high_y)
    inside = torch.ones(len(index), dtype=torch.bool)
    for slope, steep, focal, middle, size in (
        (slope_x, steep_x, camera.fx, camera.cx, camera.width),
        (slope_y, steep_y, camera.fy, camera.cy, camera.height),
    ):
        square = (focal * largest).square() * (1 + steep.square()) + EPS2D_PX2
        reach = EXTENT_MAX_SIGMA * square.sqrt() + MARGIN_PX
        inside &= (slope * focal + middle - 0.5 + reach >= 0) & (
            slope * focal + middle + 0.5 - reach <= size
        )
    index = index[inside]
    return index[torch.from_numpy(depth_order(z[inside].numpy(), index.numpy()))]


def _is_drawn(local: Tensor, splats: Splats, near_m: float) -> Tensor:
    """Return which Gaussians ``(N,)`` are far and opaque enough."""
    least = float(logit(np.array(ALPHA_MIN)))
    return (local[2] >= near_m) & (splats.logit_opacities >= least)


def _in_camera(means: Tensor, camera: PinholeCamera) -> Tensor:
    """Return points ``(3, N)`` in the camera's axes; large coordinates cancel in float64."""
    relative = means.double() - upload(camera.centre_world, means.device)
    return (upload(camera.T_camera_world[:3, :3], means.device) @ relative.T).float()


def _ellipses(
    local: Tensor, splats: Splats, camera: PinholeCamera
) -> tuple[Tensor, Tensor, Tensor]:
    """Return centres ``(N, 2)``, pixels, and the rows m, n ``(3, N)`` of ``M = J R_camera R_q
    diag(s)``: the screen covariance is ``M M^T`` and the low-pass.
    """
    low_x, high_x, low_y, high_y = camera.slope_limits()
    right, down, ahead = upload(camera.T_camera_world[:3, :3, None], local.device).float()
    x, y, z = local
    slope_x = x / z
    slope_y = y / z
    uv = torch.stack([camera.fx * slope_x + camera.cx, camera.fy * slope_y + camera.cy], dim=1)
    j = camera.fx / z * (right - slope_x.clamp(low_x, high_x) * ahead)
    k = camera.fy / z * (down - slope_y.clamp(low_y, high_y) * ahead)
    w, *u = torch.nn.functional.normalize(splats.quaternions.double(), dim=1).T
    axis, scales = torch.stack(u), splats.log_scales.double().T.exp()

    def turned(row: Tensor) -> Tensor:
        """Return a row times R_q: the row turned by the inverse of q, whose vector part is -u."""
        across = cross3(axis, row)
        return row + 2 * (cross3(axis, across) - w * across)

    return uv, turned(j) * scales, turned(k) * scales


def _records(
    uv: Tensor,
    m: Tensor,
    n: Tensor,
    log_opacity: Tensor,
    colour: Tensor,
    depth: Tensor,
    scale: float,
) -> Tensor:
    """Return projected splats ``(M, RECORD)`` as the kernels read them: see `constants`; the
    whitening times a scale.
    """
    c11, c12, c22, det = screen_covariance(m, n)
    extent = (2 * (log_opacity - np.log(ALPHA_MIN))).clamp(min=0).sqrt().clamp(max=EXTENT_MAX_SIGMA)
    radius_x = extent * c11.sqrt()
    radius_y = extent * c22.sqrt()
    l11 = scale * (c22 / det).sqrt()
    l12 = -l11 * c12 / c22
    l22 = scale * c22.rsqrt()
    peak = (log_opacity / np.log(2) + 4) / 8
    corner = torch.hypot(BLOCK_HALF * (l11 + l12.abs()), BLOCK_HALF * l22)
    block = (peak - CUT).clamp(min=0).sqrt() + corner + 1e-3
    reach = radius_x + MARGIN_PX, radius_y + MARGIN_PX
    columns = [*uv.T, l11, l12, l22, peak, *colour.T, depth, *reach]
    records = torch.zeros(len(uv), RECORD, device=uv.device)
    records[:, : len(columns)] = torch.stack(columns, dim=1)
    records[:, BLOCK_REACH] = block.square()
    return records


Images = tuple[Tensor, Tensor, Tensor]  # sums of weighted colours, alpha, sums of weighted depths
# Their gradients to what a splat receives (M, PAIR)
Sums = Callable[[Tensor, Tensor, Tensor], Tensor]


def _on_cpu(records: Tensor, camera: PinholeCamera, threads: int) -> tuple[Images, Sums, Tensor]:
    flat = records.numpy().reshape(-1)
    tiles = list_per_tile(np.arange(len(records)), flat, camera, threads)
    kept = np.empty((len(tiles.starts) - 1) * 16 * KEPT, dtype=np.float32)
    colour, alpha, depth = (
        torch.from_numpy(image) for image in composite(tiles, flat, kept, None, camera, threads)
    )

    def sums(*gradients: Tensor) -> Tensor:
        pairs = np.zeros(len(tiles.lists) * PAIR, dtype=np.float32)
        lists = (np.zeros(1, dtype=np.int64), tiles.columns, tiles.starts, tiles.lists, flat)
        images = (g.to(torch.float32).contiguous().numpy() for g in gradients)
        run_on_threads(threads, tile_gradients, *lists, kept, *images, pairs)
        rows = np.zeros((len(records), PAIR), dtype=np.float32)
        add_pairs(tiles.lists, pairs, rows)
        return torch.from_numpy(rows)

    return (colour, alpha, depth), sums, torch.tensor(len(tiles.lists))


def _on_gpu(
    records: Tensor,
    log_opacity: Tensor,
    on_screen: Tensor,
    camera: PinholeCamera,
    compositor: TileCompositor,
) -> tuple[Images, Sums, Tensor]:
    centre = records[:, U : V + 1]
    reach = records[:, RADIUS_X : RADIUS_Y + 1]
    tiles = upload(tile_grid(camera), records.device)
    first = ((centre - reach) / TILE).floor().clamp(min=0).minimum(tiles)
    end = ((centre + reach) / TILE).floor().clamp(min=-1).minimum(tiles - 1) + 1
    boxes = torch.stack([first, end], dim=2).nan_to_num().to(torch.int32).flatten(1)
    counts = ((end - first).clamp(min=0).prod(dim=1) * on_screen).to(torch.int32)
    rows = records[:, : compositor.kernels.RECORD].contiguous()
    rows[:, PEAK] = log_opacity.exp()
    depths = torch.where(on_screen, records[:, Z], torch.inf)
    view = compositor.composite(ProjectedSplats(rows, depths, boxes, counts), camera)

    def sums(by_colour: Tensor, by_alpha: Tensor, by_depth: Tensor) -> Tensor:
        by_pixel = torch.cat([by_colour, by_depth[..., None], by_alpha[..., None]], dim=2)
        return compositor.gradient(view, by_pixel, PAIR)

    (image,) = view.image
    return (image[..., :3], 1 - image[..., 4], image[..., 3]), sums, counts.sum()


class _Composite(torch.autograd.Function):
    """Colour sum, alpha and depth sum of one view; the background is added outside."""

    @staticmethod
    def forward(
        ctx: Any,
        uv: Tensor,
        m: Tensor,
        n: Tensor,
        log_opacity: Tensor,
        colour: Tensor,
        depth: Tensor,
        images: Images,
        sums: Sums,
        scale: float,
    ) -> Images:
        ctx.save_for_backward(m, n, colour)
        ctx.sums = sums
        ctx.scale = scale
        return images

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """With W the upper triangular whitening of the screen covariance ``C`` (``W^T W = C^-1``)
        and moments of ``h = alpha dL/dalpha`` over whitened coordinates w: ``dL/d(u, v) = W^T sum
        h w`` and ``dL/dM = W^T (sum h w w^T) W M``. ``W M`` has entries of at most 1, so that
        needles of thousands of pixels lose nothing.
        """
        m, n, colour = ctx.saved_tensors
        sums = ctx.sums(*gradients).T.contiguous()
        _, c12, c22, det = screen_covariance(m, n)
        # The moments are over whitened coordinates times the scale: each w holds one.
        w11 = (c22 / det).sqrt() / ctx.scale
        w22 = c22.rsqrt() / ctx.scale
        w12 = -w11 * c12 / c22
        by_u = w11 * sums[PAIR_S]
        by_v = w12 * sums[PAIR_S] + w22 * sums[PAIR_T]
        s = w11 * m + w12 * n
        t = w22 * n
        a = sums[PAIR_SS] * s + sums[PAIR_ST] * t
        b = sums[PAIR_ST] * s + sums[PAIR_TT] * t
        by_colour = torch.where(colour > 0, sums[PAIR_R : PAIR_R + 3].T, 0.0)
        return (
            torch.stack([by_u, by_v], dim=1).float(),
            w11 * a,
            w12 * a + w22 * b,
            sums[PAIR_H],
            by_colour,
            sums[PAIR_Z],
            None,
            None,
            None,
        )
