"""Render splats through a lens for training, on the CPU: the image of `rasterize_lens`, and its gradient.

Kernels project, composite and take the image's gradient to nine sums a splat (`lens_gradient_kernels`); torch
takes these to the means, shapes, opacities and colours. Neither the order of drawing nor what decides
whether a Gaussian is drawn as an ellipse of the image has a gradient.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F32, F64
from alpasim_plugin.gaussians.cloud import logit
from alpasim_plugin.gaussians.constants import ALPHA_MIN, EPS2D_PX2
from alpasim_plugin.gaussians.lens_camera import LensCamera
from alpasim_plugin.gaussians.raster.gradient_kernels import add_pairs
from alpasim_plugin.gaussians.raster.lens_gradient_kernels import (
    LENS_PAIR,
    PAIR_COLOUR,
    PAIR_DEPTH,
    PAIR_H,
    PAIR_PRODUCTS,
    PAIR_RESIDUAL,
    lens_tile_gradients,
)
from alpasim_plugin.gaussians.raster.lens_map_gradient import LensPlace, lens_place
from alpasim_plugin.gaussians.raster.lens_rays import tile_rays
from alpasim_plugin.gaussians.raster.lens_records import INVERSE_O2, ROW_A, SHORT
from alpasim_plugin.gaussians.raster.prepared import PreparedCloud, packed
from alpasim_plugin.gaussians.raster.raster_kernels import KEPT
from alpasim_plugin.gaussians.raster.rasterize_lens import (
    DrawnTiles,
    composite_lens,
    drawn_splats,
)
from alpasim_plugin.gaussians.raster.splats import (
    GradientOutput,
    Splats,
    colours_of,
    screen_covariance,
)
from alpasim_plugin.gaussians.raster.stages import run_on_threads, thread_count


def rasterize_lens_gradient(
    splats: Splats,
    camera: LensCamera,
    *,
    background: Tensor | None,
    near_m: float,
    threads: int | None,
) -> GradientOutput:
    """Render splats through a lens; see `rasterize_gradient.rasterize_gradient`.

    Returns:
        The image with its graph; ``depth`` is the mean distance from the camera's centre. Where the
        lens sees nothing it is black and opaque.

    Raises:
        InputError: The camera has a rolling shutter.
    """
    if camera.rolling is not None:
        raise InputError(
            "a camera with a rolling shutter: a fit knows none", "give it a global shutter"
        )
    workers = thread_count(threads)
    with torch.no_grad():
        tile_splats = drawn_splats(
            [(_prepared(splats), None)], camera, near_m=near_m, threads=workers
        )
    view = _LensView(tile_splats, camera, workers)
    index = torch.from_numpy(tile_splats.splats.ids)
    chosen = Splats(*(tensor.index_select(0, index) for tensor in splats))
    projected, uv = _projected(chosen, camera, tile_splats)
    images = view.images()
    colour_sum, alpha, depth_sum = _CompositeLens.apply(*projected, images, view)  # type: ignore[no-untyped-call]
    rgb = colour_sum
    if background is not None:
        rgb = rgb + (1 - alpha)[..., None] * background.float()
    depth = torch.where(alpha > 0, depth_sum / torch.where(alpha > 0, alpha, 1.0), 0.0)
    on_screen = torch.ones_like(index, dtype=torch.bool)
    pairs = torch.tensor(len(tile_splats.tiles.lists))
    return GradientOutput(rgb, alpha, depth, index, uv, on_screen, pairs)


def _prepared(splats: Splats) -> PreparedCloud:
    """Return splats as the kernels read them; those below the alpha cut are left out."""
    index = torch.nonzero(splats.logit_opacities >= float(logit(np.array(ALPHA_MIN))))[:, 0]
    chosen = Splats(*(tensor.index_select(0, index) for tensor in splats))
    return packed(
        len(splats.means),
        index.numpy(),
        chosen.means.double().numpy(),
        _factors(chosen).permute(2, 0, 1).numpy(),
        chosen.logit_opacities.double().sigmoid().numpy(),
        chosen.sh.numpy(),
    )


def _factors(splats: Splats) -> Tensor:
    """Return ``R_q diag(s)`` ``(3, 3, N)`` float64, whose product with its transpose is the
    covariance.
    """
    w, x, y, z = torch.nn.functional.normalize(splats.quaternions.double(), dim=1).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    rotation = torch.stack([torch.stack(row) for row in rows])
    return rotation * splats.log_scales.double().T.exp()


class _Projected(NamedTuple):
    """What the image depends on, of M drawn splats: L along the pixels' rays and the others as
    ellipses.

    Attributes:
        p: ``(3, L)`` means in the camera's axes.
        V: ``(3, 3, L)`` factors of the covariances, in the camera's axes.
        E: ``(3, 3, L)`` factors of the low-pass: steps of the size of a pixel.
        uv: ``(2, M - L)`` centres of ellipses, pixels.
        m, n: ``(3, M - L)`` rows of ``J R diag(s)``.
        log_opacity: ``(M,)``.
        colour: ``(M, 3)``.
        distance: ``(M,)`` metres.
    """

    p: Tensor
    V: Tensor
    E: Tensor
    uv: Tensor
    m: Tensor
    n: Tensor
    log_opacity: Tensor
    colour: Tensor
    distance: Tensor


def _projected(
    splats: Splats, camera: LensCamera, tile_splats: DrawnTiles
) -> tuple[_Projected, Tensor]:
    """Return the projection of drawn splats with its graph, and the places of their means in the image
    ``(M, 2)``, whose gradient is that of moving the splats across the lines of sight.
    """
    T = torch.from_numpy(camera.T_camera_world)
    centre = torch.from_numpy(camera.centre_world)
    p = T[:3, :3] @ (splats.means.double() - centre).T
    V = torch.einsum("ij,jkn->ikn", T[:3, :3], _factors(splats))
    place = lens_place(tile_splats.lens, p)
    uv = place.uv.detach().T.float().contiguous().requires_grad_(p.requires_grad)
    moved = (uv - uv.detach()).double().T  # zero, for its gradient
    steps = _pixel_steps(place)
    is_ray = torch.from_numpy(_is_along_ray(tile_splats))
    rays = torch.nonzero(is_ray)[:, 0]
    ellipses = torch.nonzero(~is_ray)[:, 0]

    # A mean moves with its pixel by the steps of a pixel; these are constants of this identity.
    across = torch.einsum("ijn,jn->in", steps.detach()[:, :2].index_select(2, rays), moved[:, rays])
    J = torch.einsum("ijn,jkn->ikn", place.slopes, torch.stack([place.right, place.down]))
    rows = torch.einsum("ijn,jkn->ikn", J / place.distance, V).index_select(2, ellipses)
    projected = _Projected(
        p.index_select(1, rays) + across,
        V.index_select(2, rays),
        (np.sqrt(EPS2D_PX2) * steps).index_select(2, rays),
        (place.uv + moved).index_select(1, ellipses),
        rows[0],
        rows[1],
        torch.nn.functional.logsigmoid(splats.logit_opacities),
        colours_of(p.float(), splats.sh, camera),
        place.distance.float(),
    )
    return projected, uv


def _is_along_ray(tile_splats: DrawnTiles) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Return which drawn splats ``(M,)`` are evaluated along the rays of pixels."""
    count = len(tile_splats.splats.ids)
    return tile_splats.splats.records[: count * SHORT].reshape(count, SHORT)[:, INVERSE_O2] >= 0


def _pixel_steps(place: LensPlace) -> Tensor:
    """Return by what means move where their image moves by one pixel to the right and down, metres, and
    a step of that size along the line of sight ``(3, 3, N)``, step by step in the second axis.
    """
    (k00, k01), (k10, k11) = place.slopes
    scale = place.distance / (k00 * k11 - k01 * k10)
    to_right = scale * (place.right * k11 - place.down * k10)
    to_down = scale * (place.down * k00 - place.right * k01)
    size = (0.5 * (to_right.square().sum(dim=0) + to_down.square().sum(dim=0))).sqrt()
    along = torch.linalg.cross(place.right, place.down, dim=0) * size
    return torch.stack([to_right, to_down, along], dim=1)


Images = tuple[
    Tensor, Tensor, Tensor
]  # sums of weighted colours, alpha, sums of weighted distances


class _LensView:
    """One image through a lens, and what takes its gradient back to the splats."""

    def __init__(self, tile_splats: DrawnTiles, camera: LensCamera, threads: int) -> None:
        self.tile_splats = tile_splats
        self.camera = camera
        self.threads = threads
        tiles = len(tile_splats.tiles.starts) - 1
        self.kept: F32 = np.empty(tiles * 16 * KEPT, dtype=np.float32)

    def images(self) -> Images:
        """Draw the images; they have a graph that holds this view, which therefore does not hold them."""
        colour, alpha, depth = composite_lens(
            self.tile_splats, self.camera, self.kept, None, self.threads
        )
        return torch.from_numpy(colour), torch.from_numpy(alpha), torch.from_numpy(depth)

    def sums(self, *gradients: Tensor) -> Tensor:
        """Return what each splat receives ``(LENS_PAIR, M)`` float64 of the gradients of the images."""
        tile_splats = self.tile_splats
        tiles = tile_splats.tiles
        table = tile_rays(self.camera)
        pairs = np.zeros(len(tiles.lists) * LENS_PAIR, dtype=np.float32)
        run_on_threads(
            self.threads,
            lens_tile_gradients,
            np.zeros(1, dtype=np.int64),
            tiles.columns,
            tiles.starts,
            tiles.lists,
            tile_splats.splats.records,
            table.rays,
            table.blocks,
            self.kept,
            *(gradient.to(torch.float32).contiguous().numpy() for gradient in gradients),
            pairs,
        )
        rows: F64 = np.zeros((len(tile_splats.splats.ids), LENS_PAIR))
        add_pairs(tiles.lists, pairs, rows)
        return torch.from_numpy(rows).T.contiguous()


class _CompositeLens(torch.autograd.Function):
    """Colour sum, alpha and depth sum of one view; the background is added outside."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Images:
        *tensors, images, view = inputs
        ctx.save_for_backward(*tensors)
        ctx.view = view
        output_images: Images = images
        return output_images

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """With r the whitened residuals of `lens_gradient_kernels` and W the whitening that they are in:
        ``dL/dp = W^T sum h r`` and ``dL/dV = W^T (sum h r r^T) W V``, of ellipses with the pixel in place of p.
        ``W V`` has entries of at most 1, so that needles lose nothing.
        """
        projected = _Projected(*ctx.saved_tensors)
        view: _LensView = ctx.view
        sums = view.sums(*gradients)
        is_ray = torch.from_numpy(_is_along_ray(view.tile_splats))
        first, products = _moments(sums)
        of_rays = _to_rays(projected, view.tile_splats, first[:, is_ray], products[..., is_ray])
        of_ellipses = _to_ellipses(projected, first[:2, ~is_ray], products[:2, :2][..., ~is_ray])
        by_colour = sums[PAIR_COLOUR : PAIR_COLOUR + 3].T
        by_colour = torch.where(projected.colour > 0, by_colour, 0.0)
        return (
            *of_rays,
            *of_ellipses,
            sums[PAIR_H].float(),
            by_colour.float(),
            sums[PAIR_DEPTH].float(),
            None,
            None,
        )


def _moments(sums: Tensor) -> tuple[Tensor, Tensor]:
    """Return the sums of ``h r`` ``(3, M)`` and of ``h r r^T`` ``(3, 3, M)``."""
    first = sums[PAIR_RESIDUAL : PAIR_RESIDUAL + 3]
    m11, m12, m13, m22, m23, m33 = sums[PAIR_PRODUCTS : PAIR_PRODUCTS + 6]
    rows = (m11, m12, m13), (m12, m22, m23), (m13, m23, m33)
    return first, torch.stack([torch.stack(row) for row in rows])


def _to_rays(
    projected: _Projected, tile_splats: DrawnTiles, first: Tensor, products: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients of p, V and E of splats along rays."""
    W = _whitening(projected, _first_rows(tile_splats))
    V = projected.V
    E = projected.E
    by_p = torch.einsum("ijn,in->jn", W, first)
    half = torch.einsum("ijn,ikn->jkn", W, products)  # W^T products

    def by_factor(factor: Tensor) -> Tensor:
        return torch.einsum("ijn,jkn->ikn", half, torch.einsum("ijn,jkn->ikn", W, factor))

    return by_p, by_factor(V), by_factor(E)


def _to_ellipses(
    projected: _Projected, first: Tensor, products: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients of uv, m and n of ellipses."""
    m = projected.m
    n = projected.n
    _, c12, c22, det = screen_covariance(m, n)
    w11 = (c22 / det).sqrt()
    w22 = c22.rsqrt()
    w12 = -w11 * c12 / c22
    s = w11 * m + w12 * n
    t = w22 * n
    a = products[0, 0] * s + products[0, 1] * t
    b = products[0, 1] * s + products[1, 1] * t
    by_uv = torch.stack([w11 * first[0], w12 * first[0] + w22 * first[1]])
    return by_uv, w11 * a, w12 * a + w22 * b


def _first_rows(tile_splats: DrawnTiles) -> Tensor:
    """Return the rows A of the records along rays ``(3, L)``."""
    count = len(tile_splats.splats.ids)
    records = tile_splats.splats.records[: count * SHORT].reshape(count, SHORT)
    return torch.from_numpy(
        records[_is_along_ray(tile_splats), ROW_A : ROW_A + 3].T.astype(np.float64)
    )


def _whitening(projected: _Projected, first_rows: Tensor) -> Tensor:
    """Return ``Q L^-1`` ``(3, 3, L)`` with ``V V^T + E E^T = L L^T`` and Q the basis of the records,
    whose last row is the direction of the whitened mean. It is made here in float64.

    The basis jumps where the last part of that direction is 0, and rounding may put a record on the
    other side: the one that the record's first row is of is taken.
    """
    inverse = _inverse_cholesky(projected.V, projected.E)
    w = torch.einsum("ijn,jn->in", inverse, projected.p)
    w = w / w.square().sum(dim=0).sqrt()
    upper, lower = (_basis(w, sign) for sign in (1.0, -1.0))
    n = projected.p.square().sum(dim=0).sqrt()

    def missed(basis: Tensor) -> Tensor:
        rows = n * torch.einsum("jn,jkn->kn", basis[0], inverse)
        return (rows - first_rows).square().sum(dim=0)

    sign = torch.where(w[2] >= 0, 1.0, -1.0)
    is_near = w[2].abs() < 1e-3
    is_upper = torch.where(is_near, missed(upper) <= missed(lower), sign > 0)
    basis = torch.where(is_upper, upper, lower)
    return torch.einsum("ijn,jkn->ikn", basis, inverse)


def _basis(w: Tensor, sign: float) -> Tensor:
    """Return the basis ``(3, 3, L)`` of `lens_project_kernels`, row by row, for a sign of the last part
    of unit vectors w ``(3, L)``; it means nothing near the other pole.
    """
    x, y, z = w
    below = sign + z
    a = -1 / torch.where(below.abs() < 1e-9, 1e-9, below)
    b = x * y * a
    q1 = torch.stack([1 + sign * x * x * a, sign * b, -sign * x])
    q2 = torch.stack([b, sign + y * y * a, -y])
    return torch.stack([q1, q2, w])


def _inverse_cholesky(V: Tensor, E: Tensor) -> Tensor:
    """Return ``L^-1`` ``(3, 3, N)`` of ``V V^T + E E^T = L L^T``."""
    S = torch.einsum("ijn,kjn->ikn", V, V) + torch.einsum("ijn,kjn->ikn", E, E)
    i1 = S[0, 0].rsqrt()
    l21 = S[1, 0] * i1
    l31 = S[2, 0] * i1
    i2 = torch.maximum(S[1, 1] - l21 * l21, 1e-14 * S[1, 1]).rsqrt()
    l32 = (S[2, 1] - l31 * l21) * i2
    i3 = torch.maximum(S[2, 2] - l32 * l32 - l31 * l31, 1e-14 * S[2, 2]).rsqrt()
    zero = torch.zeros_like(i1)
    m21 = -l21 * i1 * i2
    m31 = -(l31 * i1 + l32 * m21) * i3
    m32 = -l32 * i2 * i3
    rows = (i1, zero, zero), (m21, i2, zero), (m31, m32, i3)
    return torch.stack([torch.stack(row) for row in rows])
