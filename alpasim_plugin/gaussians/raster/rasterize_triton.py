"""Render on a GPU: clouds are uploaded once, a frame sends poses, and its image stays there.

State of testing: the kernels are interpreted on the CPU against the reference implementation, and
compiled for GPUs of compute capability 8.0 and 9.0; they have not been run on a GPU.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from alpasim_plugin.core.devices import implementation, require_device, upload, upload_together
from alpasim_plugin.core.errors import RendererError
from alpasim_plugin.core.types import F64, FloatArray
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.constants import (
    ALPHA_MIN,
    EXTENT_MAX_SIGMA,
    MIP_PX2,
    NEAR_M,
    POSE_ANTIALIAS,
    TILE,
)
from alpasim_plugin.gaussians.lens_camera import LensCamera, lens_key
from alpasim_plugin.gaussians.raster import lens_on_device
from alpasim_plugin.gaussians.raster.device_output import DeviceOutput
from alpasim_plugin.gaussians.raster.lens_on_device import PlacedNode
from alpasim_plugin.gaussians.raster.output import Background, RasterOutput, background_image
from alpasim_plugin.gaussians.raster.stages import node_poses, write_motion

BLOCK = 128  # Gaussians that one program projects
CHUNK = 32  # splats after which a tile is tested for being full
FIRST_CAPACITY = 1 << 16  # pairs of splat and tile for which the first frame has room
MOST_PAIRS = 2**31 - 1  # the kernels count the places in a launch's lists by int32
HINT = "Install torch's CUDA build, which brings Triton, or choose --device cpu"


def triton_kernels(name: str = "triton_kernels") -> Any:
    """Return a module of kernels: those of pinholes, or ``triton_lens_kernels``.

    Raises:
        RendererError: Triton is not installed.
    """
    try:
        return import_module(f"{__package__}.{name}")
    except ImportError as error:
        raise RendererError(f"the package triton does not import ({error})", HINT) from error


class ProjectedSplats(NamedTuple):
    """What a device projected.

    Attributes:
        records: ``(N, RECORD)``, through a lens ``(N, SHORT)`` or ``(N, LONG)`` of `lens_records`.
        depths: ``(N,)``, by which they are drawn.
        boxes: ``(N, BOX)``; the tiles of a view stand below those of the view before.
        counts: ``(N,)`` int32, tiles of each; 0 for what is not drawn.
    """

    records: Tensor
    depths: Tensor
    boxes: Tensor
    counts: Tensor

    @property
    def pairs(self) -> Tensor:
        """Return ``()`` int64, the number of pairs of splat and tile."""
        return self.counts.sum(dtype=torch.int64)


class SplatLists(NamedTuple):
    """Splats by tile; see `TiledImage`."""

    order: Tensor
    ends: Tensor
    splats: Tensor
    places: Tensor
    starts: Tensor


class LensTensors(NamedTuple):
    """The lens of some views on a device.

    Attributes:
        rays: See `lens_on_device.rays_on_device`.
        lenses, motions: See `lens_on_device.LensNumbers`.
        rolls: Whether the shutters roll.
        length: Numbers of a record.
    """

    rays: Tensor
    lenses: Tensor
    motions: Tensor
    rolls: bool
    length: int


@dataclass(frozen=True, eq=False)
class TiledImage:
    """A view that a device composited, with what its gradient needs.

    Attributes:
        image: ``(V, H, W, PIXEL)``, see `triton_kernels.composite`.
        records: ``(N, RECORD)`` projected splats.
        order: ``(N,)`` splats, nearest first.
        ends: ``(N,)`` where the pairs of each end, in this order.
        splats: ``(capacity,)`` the splat of each pair, by tile.
        places: ``(capacity,)`` its place in the order of ``ends``.
        starts: ``(tiles + 1,)`` where each tile's pairs begin, and the end of the last.
    """

    image: Tensor
    records: Tensor
    order: Tensor
    ends: Tensor
    splats: Tensor
    places: Tensor
    starts: Tensor


class TileCompositor:
    """Lists projected splats by tile and blends them on a device, in lists that grow.

    Args:
        device: A torch device, ``cuda:0``.

    Raises:
        RendererError: Triton is not installed.
        InfrastructureError: There is no such device.
    """

    def __init__(self, device: str) -> None:
        self.kernels = triton_kernels()
        self.device = torch.device(require_device(device))
        self.capacity = FIRST_CAPACITY

    def had_room(self, capacity: int, count: int, views: int = 1) -> bool:
        """Return whether lists of a capacity held so many pairs; make room for the next ones.

        Args:
            capacity: Pairs that the lists had room for.
            count: Pairs of splat and tile, of all views.
            views: Views that were drawn together; each of several may still be drawn alone.

        Raises:
            RendererError: One view has more than `MOST_PAIRS`.
        """
        if count > MOST_PAIRS and views == 1:
            raise RendererError(
                f"an image in which {count} pairs of splat and tile are drawn, of at most {MOST_PAIRS}",
                "Render a smaller image or a scene of fewer Gaussians, or choose --device cpu",
            )
        if capacity < count <= MOST_PAIRS:  # the lists were cut short
            self.capacity = max(self.capacity, min(count + count // 4, MOST_PAIRS))
        return count <= capacity

    def composite(
        self,
        splats: ProjectedSplats,
        camera: PinholeCamera | LensCamera,
        views: int = 1,
        lens: LensTensors | None = None,
    ) -> TiledImage:
        """Blend projected splats; the views are whole if their pairs are at most `capacity`.

        Args:
            splats: See `ProjectedSplats`.
            camera: Gives the images' size.
            views: Their number.
            lens: That of all views; None: they are pinholes.
        """
        width = camera.width
        height = camera.height
        tiles_x, tiles_y = tile_grid(camera)
        listed = self._listed(splats, views * tiles_x * tiles_y, tiles_x)
        image = self._empty((views, height, width, self.kernels.PIXEL), torch.float32)
        grid = (views * tiles_x * tiles_y,)
        size = width, height, tiles_x, tiles_y
        lists = splats.records, listed.splats, listed.starts
        if lens is None:
            self.kernels.composite[grid](*lists, image, *size, TILE=TILE, CHUNK=CHUNK)
        else:
            triton_kernels("triton_lens_kernels").composite_lens[grid](
                *lists,
                lens.rays,
                lens.lenses,
                lens.motions,
                image,
                *size,
                TILE=TILE,
                CHUNK=CHUNK,
                LENGTH=lens.length,
                ROLLS=lens.rolls,
            )
        return TiledImage(image, splats.records, *listed)

    def _listed(self, splats: ProjectedSplats, tile_count: int, tiles_x: int) -> SplatLists:
        """List splats by tile, the nearest first."""
        total = len(splats.records)
        order = torch.sort(splats.depths, stable=True).indices
        ends = torch.cumsum(splats.counts[order], dim=0)
        tiles = torch.full((self.capacity,), tile_count, dtype=torch.int32, device=self.device)
        numbers = torch.zeros_like(tiles)
        if total:
            self.kernels.list_tiles[(-(-total // BLOCK),)](
                order,
                ends,
                splats.boxes,
                splats.counts,
                tiles,
                numbers,
                total,
                self.capacity,
                tiles_x,
                BLOCK=BLOCK,
            )
        sorted_tiles, places = torch.sort(tiles, stable=True)
        tile_numbers = torch.arange(tile_count + 1, dtype=torch.int32, device=self.device)
        starts = torch.searchsorted(sorted_tiles, tile_numbers).to(torch.int32)
        return SplatLists(order, ends, numbers[places], places, starts)

    def gradient(self, view: TiledImage, by_pixel: Tensor, columns: int) -> Tensor:
        """Return the sums ``(N, columns)`` of `triton_kernels.composite_backward` over the tiles of
        each splat, always added in one order.

        Args:
            view: What was composited, one view.
            by_pixel: ``(H, W, 5)`` gradients of colour, weighted depth and opacity.
            columns: Numbers per pair.
        """
        height, width = view.image.shape[1:3]
        pairs = by_pixel.new_zeros(len(view.splats), columns)
        self.kernels.composite_backward[(len(view.starts) - 1,)](
            view.records,
            view.splats,
            view.starts,
            view.image,
            by_pixel.contiguous(),
            view.places,
            pairs,
            width,
            height,
            -(-width // TILE),
            TILE=TILE,
        )
        offsets = torch.nn.functional.pad(view.ends.clamp(max=len(pairs)), (1, 0))
        sums = torch.segment_reduce(pairs, "sum", offsets=offsets, axis=0, unsafe=True)
        return torch.empty_like(sums).index_copy_(0, view.order, sums)

    def _empty(self, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        return torch.empty(shape, dtype=dtype, device=self.device)


def compositor_of(device: str) -> TileCompositor | None:
    """Return what blends splats on a card; None on the CPU, whose kernels share no memory."""
    return implementation(device, lambda _: None, TileCompositor)(device)


def tile_grid(camera: PinholeCamera | LensCamera) -> tuple[int, int]:
    """Return how many tiles an image has in a row and in a column."""
    return -(-camera.width // TILE), -(-camera.height // TILE)


class DrawnCloud(NamedTuple):
    """An uploaded cloud in a view."""

    cloud: int  # its place among those uploaded
    T_world_node: FloatArray | None = None  # (4, 4); None: the identity
    antialiased: bool = False  # drawn with a filter that it may lack
    T_world_start: F64 | None = None  # of a rolling shutter at its start; None: it stands


# From where, and what; equal depths are drawn in this order.
CloudView = tuple[PinholeCamera | LensCamera, Sequence[DrawnCloud]]


def drawn_together(camera: PinholeCamera | LensCamera) -> Hashable:
    """Return what cameras share whose views are drawn in one launch: their size, and their lens."""
    if isinstance(camera, LensCamera):
        return lens_key(camera.spec), camera.rolling is not None
    return camera.height, camera.width


class UploadedClouds(TileCompositor):
    """Clouds in a device's memory, drawn from there in any poses.

    Args:
        clouds: Gaussians, each in its own frame.
        device: A torch device, ``cuda:0``.

    Raises:
        InputError: A cloud cannot be drawn.
        RendererError: Triton is not installed.
        InfrastructureError: There is no such device.
    """

    def __init__(self, clouds: Sequence[GaussianCloud], device: str) -> None:
        super().__init__(device)
        for cloud in clouds:
            cloud.require_drawable()
        self.sizes = np.array([len(cloud) for cloud in clouds], dtype=np.int64)
        self.antialias_px2 = [cloud.antialias_px2 for cloud in clouds]
        self.first = np.cumsum(self.sizes) - self.sizes
        self.sh_size = max((cloud.sh.shape[1] for cloud in clouds), default=1)
        opacity = _joined([cloud.opacities.astype(np.float64) for cloud in clouds], ())
        extent = np.sqrt(2 * np.log(np.maximum(opacity / ALPHA_MIN, 1.0)))
        self.extents = self._upload(np.minimum(EXTENT_MAX_SIGMA, extent), np.float32)
        self.opacities = self._upload(opacity, np.float32)
        self.means = self._upload(_joined([cloud.means for cloud in clouds], (3,)), np.float64)
        factors = [cloud.rotations() * cloud.scales.astype(np.float64)[:, None] for cloud in clouds]
        self.factors = self._upload(_joined(factors, (3, 3)), np.float32)
        self.sh = self._upload(
            _joined(
                [
                    np.pad(cloud.sh, ((0, 0), (0, self.sh_size - cloud.sh.shape[1]), (0, 0)))
                    for cloud in clouds
                ],
                (self.sh_size, 3),
            ),
            np.float32,
        )

    def draw(
        self, views: Sequence[CloudView], behind: Tensor, near_m: float = NEAR_M
    ) -> list[DeviceOutput]:
        """Render views that share what `drawn_together` says; their images stay on the device.

        Args:
            views: Cameras, and clouds at rigid poses.
            behind: What is behind everything, ``(V, H, W, 3)`` or of shapes that broadcast to it.
            near_m: Gaussians whose centre is nearer are left out.

        Raises:
            InputError: A transform is not rigid.
        """
        had_room = partial(self.had_room, self.capacity, views=len(views))
        image, pairs = self._image(views, near_m)
        transmittance = image[..., 4]
        alpha = 1 - transmittance
        rgb = (image[..., :3] + transmittance[..., None] * behind).clamp(0, 1)
        depth = torch.where(alpha > 0, image[..., 3] / alpha, 0.0)
        backgrounds = behind.expand(rgb.shape)

        def again(index: int) -> DeviceOutput:
            return self.draw([views[index]], backgrounds[index], near_m)[0]

        return [
            DeviceOutput(
                rgb=rgb[index],
                alpha=alpha[index],
                depth=depth[index],
                pairs=pairs,
                had_room=had_room,
                again=partial(again, index),
            )
            for index in range(len(views))
        ]

    def _image(self, views: Sequence[CloudView], near_m: float) -> tuple[Tensor, Tensor]:
        """Return the composited images of the views, and the number of pairs of splat and tile."""
        camera = views[0][0]
        spans = self._spans(views)
        if isinstance(camera, LensCamera):
            splats, lens = self._projected_through_lens(views, spans, near_m)
        else:
            splats = self._projected(views, spans, near_m)
            lens = None
        batch = self.composite(splats, camera, len(views), lens)
        return batch.image, splats.pairs

    def _projected(
        self, views: Sequence[CloudView], spans: npt.NDArray[np.int32], near_m: float
    ) -> ProjectedSplats:
        """Project the Gaussians that pinholes may see."""
        poses = [self._poses(*view, near_m) for view in views]
        cameras = np.array([_pinhole_numbers(camera) for camera, _ in views])
        sent = upload_together([np.concatenate(poses), cameras], self.device)
        splats = self._room(len(spans), self.kernels.RECORD)
        if len(spans):
            self.kernels.project[(len(spans),)](
                self._upload(spans, np.int32),
                *sent,
                *self._clouds(),
                *splats,
                near_m,
                *tile_grid(views[0][0]),
                SIZE=self.sh_size,
                TILE=TILE,
                BLOCK=BLOCK,
            )
        return splats

    def _projected_through_lens(
        self, views: Sequence[CloudView], spans: npt.NDArray[np.int32], near_m: float
    ) -> tuple[ProjectedSplats, LensTensors]:
        """Project the Gaussians that cameras with a lens may see."""
        placed = [
            (lens_on_device.with_lens(camera), list(map(self._placed, nodes)))
            for camera, nodes in views
        ]
        camera, _ = placed[0]
        numbers = lens_on_device.lens_numbers(placed, near_m)
        poses, lenses, motions = upload_together(list(numbers), self.device)
        rolls = camera.rolling is not None
        length = lens_on_device.record_length(rolls)
        rays = lens_on_device.rays_on_device(camera.spec, str(self.device))
        splats = self._room(len(spans), length)
        if len(spans):
            triton_kernels("triton_lens_kernels").project_lens[(len(spans),)](
                self._upload(spans, np.int32),
                poses,
                lenses,
                motions,
                *self._clouds(),
                *splats,
                *tile_grid(camera),
                SIZE=self.sh_size,
                TILE=TILE,
                BLOCK=BLOCK,
                LENGTH=length,
                ROLLS=rolls,
                BENDS=lens_on_device.bends(numbers.lenses[0]),
            )
        return splats, LensTensors(rays, lenses, motions, rolls, length)

    def _placed(self, node: DrawnCloud) -> PlacedNode:
        return PlacedNode(node.T_world_node, node.T_world_start, self._antialias_px2(node))

    def _clouds(self) -> tuple[Tensor, ...]:
        return self.means, self.factors, self.opacities, self.extents, self.sh

    def _room(self, blocks: int, length: int) -> ProjectedSplats:
        """Return room for what blocks of Gaussians are projected to."""
        total = blocks * BLOCK
        return ProjectedSplats(
            self._empty((total, length), torch.float32),
            self._empty((total,), torch.float32),
            self._empty((total, self.kernels.BOX), torch.int32),
            self._empty((total,), torch.int32),
        )

    def _poses(
        self, camera: PinholeCamera | LensCamera, nodes: Sequence[DrawnCloud], near_m: float
    ) -> F64:
        """Return the poses of a view's nodes ``(N, POSE)``."""
        T_world_nodes = [node.T_world_node for node in nodes]
        poses = node_poses(T_world_nodes, camera, near_m)
        poses[:, POSE_ANTIALIAS] = list(map(self._antialias_px2, nodes))
        if camera.rolling is not None:
            write_motion(poses, T_world_nodes, [node.T_world_start for node in nodes], camera)
        return poses

    def _antialias_px2(self, node: DrawnCloud) -> float:
        return MIP_PX2 if node.antialiased else self.antialias_px2[node.cloud]

    def _spans(self, views: Sequence[CloudView]) -> npt.NDArray[np.int32]:
        """Return the table of blocks ``(B, SPAN)``: node among those of all views, first Gaussian,
        number of Gaussians, view.
        """
        view_clouds = [
            (view, node.cloud) for view, (_, nodes) in enumerate(views) for node in nodes
        ]
        view, cloud = np.array(view_clouds, dtype=np.int64).reshape(-1, 2).T
        blocks = -(-self.sizes[cloud] // BLOCK)
        node = np.repeat(np.arange(len(view_clouds)), blocks)
        before = np.arange(len(node)) - np.repeat(np.cumsum(blocks) - blocks, blocks)
        first = self.first[cloud[node]] + before * BLOCK
        size = np.minimum(self.sizes[cloud[node]] - before * BLOCK, BLOCK)
        return np.column_stack([node, first, size, view[node]]).astype(np.int32)

    def _upload(self, array: npt.NDArray[Any], dtype: npt.DTypeLike) -> Tensor:
        return upload(np.asarray(array, dtype=dtype), self.device)


def _pinhole_numbers(camera: PinholeCamera | LensCamera) -> list[float]:
    """Return a pinhole as `triton_kernels.project` reads it."""
    assert isinstance(camera, PinholeCamera), "views of one launch are all pinholes, or none is"
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.slope_limits()]
    rolling = camera.rolling
    return [*numbers, *((0.0, 0.0, 0.0, 0.0) if rolling is None else (*rolling.time, 1.0))]


def _joined(arrays: Sequence[npt.NDArray[Any]], shape: tuple[int, ...]) -> npt.NDArray[Any]:
    """Return arrays of rows of a shape as one, also where there is none."""
    return np.concatenate([np.zeros((0, *shape)), *arrays])


def rasterize_triton(
    cloud: GaussianCloud,
    camera: PinholeCamera | LensCamera,
    background: Background = (0.0, 0.0, 0.0),
    *,
    near_m: float = NEAR_M,
    device: str = "cuda",
) -> RasterOutput:
    """Upload and render one cloud in world coordinates; `UploadedClouds` draws repeated frames.

    Raises:
        InputError: The cloud or the background cannot be drawn.
        RendererError: Triton is not installed.
        InfrastructureError: There is no such device.
    """
    clouds = UploadedClouds([cloud], device)
    behind = upload(background_image(background, camera), clouds.device)
    return clouds.draw([(camera, [DrawnCloud(0)])], behind, near_m)[0].on_host()
