"""Carry recorded frames into a view on a GPU: what `fixers.ground` does, with tensors, and without
waiting for them, from pinhole or lens to pinhole or lens. Only the first rows of the ground may differ, where a window ends at another row.

V views have P = H W pixels each, K recorded frames each, and N with the others of their lenses. Points are tensors ``(V, 3, P)`` float64.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.cameras.image_map import DEGREE
from alpasim_plugin.cameras.image_map_kernel import (
    BENT,
    LINEAR,
    MAP_SIZE,
    MIDDLE,
    POLYNOMIAL,
    S_MOST,
)
from alpasim_plugin.core.devices import upload, upload_together
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F64
from alpasim_plugin.fixers import ground
from alpasim_plugin.fixers.warp import (
    FREE_SHARE,
    INCONSISTENT,
    INFINITY_M,
    NEAREST_M,
    SLACK,
    SLACK_M,
    VALID,
    RecordedImage,
    WarpTarget,
)

HIDING_M = 1e-3
# Working memory of views that are carried together, and what a pixel of a view takes of it for each
# recorded frame: coordinates in float64, colours, and the images of both depths.
WORKING_BYTES = 1 << 30
PIXEL_BYTES = 240
LENS_PIXEL_BYTES = 300  # where the view or a recorded frame has a lens
ABSENT = np.full((4, 4), np.nan)


@dataclass(frozen=True, eq=False)
class UploadedImage:
    """A recorded frame on a device.

    Attributes:
        recorded: On the host.
        rgb: ``(3, H, W)`` float32 levels.
        depth: ``(H, W)`` metres.
        hidden: Depth, `HIDING_M` where a road user stands: it hides all ground behind it.
        project: ``(3, 4)`` of the host, from the world to its pixels times depth, through a lens to the
            camera's axes.
        visible: ``(H, W)`` 1 around where its lens sees something, else 0; None: it has none.
        others: See `RecordedImage`.
    """

    recorded: RecordedImage
    rgb: Tensor
    depth: Tensor
    hidden: Tensor
    project: F64
    visible: Tensor | None = None
    others: tuple[UploadedImage, ...] = ()


def upload_image(recorded: RecordedImage, device: torch.device) -> UploadedImage:
    """Send a recorded frame, as of `ground.with_users`, to a device."""
    rgb, depth = (upload(part, device) for part in (recorded.rgb, recorded.depth))
    hidden = depth
    if recorded.users is not None:
        hidden = torch.where(upload(recorded.users, device), HIDING_M, depth)
    project = inverse(recorded.T_world_camera)[:3]
    visible = None
    if recorded.lens is None:
        project = recorded.K @ project
    else:
        visible = upload(recorded.lens.visible.astype(np.float32), device)
    return UploadedImage(recorded, rgb.permute(2, 0, 1).float(), depth, hidden, project, visible)


class CarriedView(NamedTuple):
    """A view into which recorded frames are carried."""

    images: Sequence[UploadedImage]  # nearest first
    target: WarpTarget  # its depth is a tensor
    T_world_rig: F64  # (4, 4) of a rig near by

    @property
    def pinholes(self) -> list[UploadedImage]:
        """Return each image and the others of its lens."""
        return [part for image in self.images for part in (image, *image.others)]


class Users(NamedTuple):
    """The boxes of the road users of V views, at most B of each; a box that stands for none holds
    no point.
    """

    ray: Tensor  # (V, B, 3, 3), this and the next two: see `warp.SeenBoxes`
    eye: Tensor  # (V, B, 3, 1)
    walls: Tensor  # (V, B, 2, 3, 1)
    then: Tensor  # (V, B, 3 N, 4) from a box to the pixels of each recorded frame times depth


class Shown(NamedTuple):
    """The recorded frames of V views."""

    rgb: Tensor  # (V N, 3, h, w) levels, see `_stacked`
    sizes_px: Tensor  # (V N, 2) height and width of each
    from_view: Tensor  # (V, 3 N, 4) from a view's pixels times depth to those of each frame
    lenses: (
        Tensor | None
    )  # (V N, MAP_SIZE) `map_numbers` of each, 0 of pinholes; None: all are such
    visible: Tensor | None  # (V N, h, w) see `UploadedImage`, 1 of pinholes


class SharedSize(NamedTuple):
    """What views share that are carried together.

    Attributes:
        shape: Height and width.
        window_px: See `ground.window_px`.
        lenses: Of each recorded frame how many show its lens, itself among them.
        has_rays: Whether the views have a lens.
        through_lens: Whether recorded frames have one.
    """

    shape: tuple[int, ...]
    window_px: int
    lenses: tuple[int, ...]
    has_rays: bool
    through_lens: bool


def size_of(view: CarriedView) -> SharedSize:
    """Return what views share that are carried together."""
    return SharedSize(
        view.target.depth.shape,
        ground.window_px(view.target.K),
        tuple(1 + len(image.others) for image in view.images),
        view.target.rays is not None,
        any(image.visible is not None for image in view.pinholes),
    )


def carry_on_device(views: Sequence[CarriedView]) -> Tensor:
    """Return the recorded frames in views of one `size_of`, ``(V, K, H, W, 4)`` uint8; see
    `ground.carry`. Several views are carried together while `WORKING_BYTES` hold them.
    """
    shared = size_of(views[0])
    height, width = shared.shape
    lenses = shared.lenses
    pixel_bytes = LENS_PIXEL_BYTES if shared.has_rays or shared.through_lens else PIXEL_BYTES
    together = max(1, WORKING_BYTES // (pixel_bytes * height * width * sum(lenses)))
    starts = range(0, len(views), together)
    return torch.cat([_carry(views[i : i + together]) for i in starts])


def _carry(views: Sequence[CarriedView]) -> Tensor:
    depth = torch.stack([view.target.depth for view in views])  # type: ignore[misc]  # tensors here
    shared = size_of(views[0])
    height, width = shared.shape
    size = shared.window_px
    lenses = shared.lenses
    rays = _rays(views)
    flat = depth.flatten(1)
    images = [image for view in views for image in view.pinholes]
    lifted = np.array([_lifted(view) for view in views])
    project = np.array([image.project for image in images])
    T_world_rig = np.array([view.T_world_rig for view in views])
    sizes = np.array([image.depth.shape for image in images], dtype=np.float64)
    from_view, planes, sizes_px, numbers, *boxes = upload_together(
        [
            project.reshape(len(views), -1, 4) @ lifted,
            (inverse(T_world_rig) @ lifted)[:, 2],
            sizes,
            np.array([_lens_numbers(image) for image in images]),
            *_boxes(views),
        ],
        depth.device,
    )
    users = Users(*boxes)
    on_ground = _ground_depth(planes, rays, flat, users)
    recorded = Shown(
        _stacked([image.rgb for image in images]),
        sizes_px,
        from_view,
        numbers if shared.through_lens else None,
        _visible(images) if shared.through_lens else None,
    )
    surfaces, hidden = (
        _stacked([part[None] for part in parts])[:, 0]
        for parts in zip(*((image.depth, image.hidden) for image in images), strict=True)
    )
    by_depth, by_ground = (
        _filled(part, lenses).reshape(len(views), -1, height, width, 4)
        for part in (
            _warp(recorded, surfaces, rays, flat, users, np.inf),
            _warp(recorded, hidden, rays, on_ground, None, FREE_SHARE),
        )
    )
    chosen = on_ground.view_as(depth) > 0
    if len(lenses) > 1:
        step = ground.step_px(size)
        across = size // step | 1
        coarse = torch.cat([part[:, :2, ::step, ::step] for part in (by_ground, by_depth)])
        of_ground, of_depth = _disagreement(coarse, across).chunk(2)
        share = (depth / on_ground.view_as(depth).clamp(min=ground.NEAREST_M))[:, ::step, ::step]
        about = (share > ground.ABOUT[0]) & (share < ground.ABOUT[1])
        most = torch.where(about, ground.NEAR_PREFERENCE, ground.PREFERENCE) * across**2
        agrees = (of_ground - of_depth <= most).repeat_interleave(step, dim=1)
        agrees = agrees.repeat_interleave(step, dim=2)[:, :height, :width]
        chosen &= agrees | (depth <= 0)
    return torch.where(chosen[:, None, :, :, None], by_ground, by_depth)


def _filled(parts: Tensor, lenses: Sequence[int]) -> Tensor:
    """Return recorded frames ``(V, K, P, 4)``, each filled in by the others of its lens, of all parts
    ``(V, N, P, 4)``.
    """
    if len(lenses) == parts.shape[1]:
        return parts
    out = []
    for lens in torch.split(parts, list(lenses), dim=1):
        image, *others = lens.unbind(1)
        for other in others:
            image = torch.where(image[..., 3:] == 0, other, image)
        out.append(image)
    return torch.stack(out, dim=1)


def _rays(views: Sequence[CarriedView]) -> Tensor:
    """Return what the pixels of views see: of pinholes their middles ``(3, P)``, (u, v, 1), of lenses
    unit rays in the camera's axes ``(V, 3, P)``.
    """
    target = views[0].target
    if target.rays is not None:
        return torch.stack([view.target.rays_on_device.flatten(1) for view in views]).double()
    depth: Tensor = target.depth  # type: ignore[assignment]  # a tensor here
    height, width = depth.shape
    rows = torch.arange(height, device=depth.device).double() + 0.5
    columns = torch.arange(width, device=depth.device).double() + 0.5
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack([u, v, torch.ones_like(u)]).flatten(1)


def _lifted(view: CarriedView) -> F64:
    """Return the matrix ``(4, 4)`` from what a view's pixels see, times depth, to the world."""
    T = view.target.T_world_camera.copy()
    if view.target.rays is None:
        T[:3, :3] = T[:3, :3] @ np.linalg.inv(view.target.K)
    return T


def _lens_numbers(image: UploadedImage) -> F64:
    lens = image.recorded.lens
    return np.zeros(MAP_SIZE) if lens is None else lens.numbers


def _visible(images: Sequence[UploadedImage]) -> Tensor:
    """Return where frames show anything ``(V N, h, w)``."""
    masks = [
        torch.ones_like(image.depth) if image.visible is None else image.visible for image in images
    ]
    return _stacked([mask[None] for mask in masks])[:, 0]


def _boxes(views: Sequence[CarriedView]) -> tuple[F64, F64, F64, F64]:
    """Return the arrays of `Users`."""
    most = max(len(view.target.placed.names) for view in views)
    shape = len(views), most
    ray = np.tile(np.eye(3), (*shape, 1, 1))
    eye = np.zeros((*shape, 3))
    walls = np.ones((*shape, 2, 3))  # of equal ones nothing lies between
    then = np.zeros((*shape, 3 * len(views[0].pinholes), 4))
    for v, view in enumerate(views):
        names, boxes = view.target.placed
        count = len(names)
        project = np.array([image.project for image in view.pinholes])
        ray[v, :count], eye[v, :count], walls[v, :count] = boxes.ray, boxes.eye, boxes.walls
        for i, name in enumerate(names):
            T_world_box = [image.recorded.actors.get(name, ABSENT) for image in view.pinholes]
            then[v, i] = (project @ np.array(T_world_box)).reshape(-1, 4)
    return ray, eye[..., None], walls[..., None], then


def _turned(matrices: Tensor, points: Tensor) -> Tensor:
    """Return matrices ``(V, M, 4)`` times points ``(V, 3, P)``."""
    return torch.baddbmm(matrices[..., 3:], matrices[..., :3], points)


def _warp(
    recorded: Shown,
    surfaces: Tensor,
    rays: Tensor,
    depth: Tensor,
    users: Users | None,
    free_share: float,
) -> Tensor:
    """Return the recorded frames in the views ``(V, N, P, 4)``; see `warp.warp`.

    Args:
        recorded: Their frames.
        surfaces: ``(V N, h, w)`` depth of these.
        rays: Of the views.
        depth: ``(V, P)`` by which the frames are carried.
        users: Move with their boxes; None: nobody does.
        free_share: A recorded surface at least this share of a point's distance away does not hide it.
    """
    points = rays * torch.where(depth > 0, depth, INFINITY_M)[:, None]
    in_recorded = _turned(recorded.from_view, points)
    for i in reversed(range(0 if users is None else users.ray.shape[1])):  # of two the first counts
        assert users is not None
        local = users.ray[:, i] @ points + users.eye[:, i]
        inside = (local >= users.walls[:, i, 0]) & (local < users.walls[:, i, 1])
        inside = inside.all(dim=1, keepdim=True) & (depth > 0)[:, None]
        in_recorded = torch.where(inside, _turned(users.then[:, i], local), in_recorded)
    u, v, w = _shown(recorded.lenses, in_recorded.reshape(-1, 3, in_recorded.shape[2]))
    height, width = recorded.sizes_px[..., None].unbind(1)
    inside_image = (w > NEAREST_M) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    u = torch.where(inside_image, u, 0.5)
    v = torch.where(inside_image, v, 0.5)
    place = v.long() * surfaces.shape[2] + u.long()
    if recorded.visible is not None:
        inside_image &= recorded.visible.flatten(1).gather(1, place) > 0
    surface = surfaces.flatten(1).gather(1, place).double()
    surface = torch.where(surface > 0, surface, INFINITY_M)
    far = (surface > INFINITY_M / 2) & (w > INFINITY_M / 2)
    agrees = far | (surface >= free_share * w) | ((surface - w).abs() < SLACK * w + SLACK_M)
    held = torch.where(agrees, VALID, INCONSISTENT) * inside_image
    rows, columns = recorded.rgb.shape[2:]
    grid = torch.stack([(2 * u - 1) / (columns - 1) - 1, (2 * v - 1) / (rows - 1) - 1], dim=-1)
    sampled = F.grid_sample(
        recorded.rgb, grid[:, None].float(), "bicubic", padding_mode="border", align_corners=True
    )
    levels = (sampled[:, :, 0].mT + 0.5).clamp(0, 255)
    levels = levels * inside_image[..., None]  # black where no frame shows anything, as on the host
    out = torch.cat([levels, held[..., None]], dim=-1).to(torch.uint8)
    return out.view(len(depth), -1, *out.shape[1:])


def _shown(lenses: Tensor | None, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the pixels u, v at which recorded cameras show points, and how far these are, ``(M, P)``
    each.

    Args:
        lenses: See `Shown`.
        points: ``(M, 3, P)`` pixels times depth, of lenses in the camera's axes.
    """
    x, y, z = points.unbind(1)
    if lenses is None:
        return x / z, y / z, z
    u, v, distance = _lens_pixels(lenses, x, y, z)
    has_lens = lenses[:, S_MOST, None] > 0
    return (
        torch.where(has_lens, u, x / z),
        torch.where(has_lens, v, y / z),
        torch.where(has_lens, distance, z),
    )


def _lens_pixels(lenses: Tensor, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return where lenses show points, and the distance of these; see `image_map_kernel.lens_pixel`."""
    columns = lenses[..., None].unbind(1)
    distance = (x * x + y * y + z * z).sqrt()
    inverse_sum = 1 / torch.maximum(distance + z, 1e-9 * distance + 1e-30)
    hx = x * inverse_sum
    hy = y * inverse_sum
    s = hx * hx + hy * hy
    held = torch.minimum(s, columns[S_MOST])
    shrink = (held / s.clamp(min=1e-30)).sqrt()
    hx = hx * shrink
    hy = hy * shrink
    t = 2 * held / columns[S_MOST] - 1
    g = columns[POLYNOMIAL + DEGREE] * torch.ones_like(t)
    for k in range(DEGREE - 1, -1, -1):
        g = g * t + columns[POLYNOMIAL + k]
    p1, p2, s1, s2, s3, s4 = columns[BENT : BENT + 6]
    tangent = 2 / (1 - held)
    ax = hx * tangent
    ay = hy * tangent
    r2 = ax * ax + ay * ay
    bent_x = 2 * p1 * ax * ay + p2 * (r2 + 2 * ax * ax) + r2 * (s1 + r2 * s2)
    bent_y = p1 * (r2 + 2 * ay * ay) + 2 * p2 * ax * ay + r2 * (s3 + r2 * s4)
    bends = (lenses[:, BENT : BENT + 6] != 0).any(dim=1, keepdim=True)
    px = g * hx + torch.where(bends, bent_x, 0.0)
    py = g * hy + torch.where(bends, bent_y, 0.0)
    u = columns[LINEAR] * px + columns[LINEAR + 1] * py + columns[MIDDLE]
    v = columns[LINEAR + 2] * px + columns[LINEAR + 3] * py + columns[MIDDLE + 1]
    return u, v, distance


def _stacked(images: Sequence[Tensor]) -> Tensor:
    """Return images ``(C, h, w)`` as one tensor; smaller ones repeat their last rows and columns."""
    height, width = (max(image.shape[axis] for image in images) for axis in (1, 2))
    padded = []
    for image in images:
        below = height - image.shape[1]
        right = width - image.shape[2]
        if below or right:
            image = F.pad(image[None], (0, right, 0, below), mode="replicate")[0]
        padded.append(image)
    return torch.stack(padded)


def _ground_depth(planes: Tensor, rays: Tensor, depth: Tensor, users: Users) -> Tensor:
    """Return the depth of the ground ``(V, P)`` where a pixel may show it, of planes ``(V, 4)``: how
    steeply a ray falls, and the height above the ground; see `ground.ground_hypothesis`.
    """
    slope = (planes[:, None, :3] @ rays)[:, 0]
    z = -planes[:, 3:] / slope
    free = (slope < 0) & (z > ground.NEAREST_M) & (z < ground.FARTHEST_M)
    free &= (depth <= ground.FLOATING_M) | (depth >= FREE_SHARE * z)
    for i in range(users.ray.shape[1]):
        reaches = (users.walls[:, i] - users.eye[:, None, i]) / (users.ray[:, i] @ rays)[:, None]
        near = reaches.amin(dim=1).amax(dim=1).clamp(min=0)
        free &= near >= reaches.amax(dim=1).amin(dim=1)
    return torch.where(free, z, 0.0).float()


def _disagreement(images: Tensor, size: int) -> Tensor:
    """Return by how many levels two images ``(V, 2, h, w, 4)`` differ around each pixel; see
    `ground`.
    """
    a, b = images.float().unbind(1)
    apart = ((a - b).abs()[..., :3].sum(dim=-1) / 3).round()
    apart = torch.where(torch.minimum(a, b)[..., 3] == 0, ground.UNSEEN, apart)
    around = F.pad(apart[:, None], (size // 2,) * 4, mode="reflect")
    return F.avg_pool2d(around, size, 1, divisor_override=1)[:, 0]
