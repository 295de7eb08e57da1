"""Draw a scene of many parts: cull each part against the view, choose its level of detail, render
what is left once.

Nodes are background parts in world coordinates and rigid actors in the frame of their box. Culling
and level of detail are decided per node, before any Gaussian is touched: a node's sphere must meet
the view, and its level is the coarsest whose cells stay below `CELL_PX` pixels at the node's
nearest point. Order of drawing at equal depth is background nodes in the order given, then actors
by id.

What a camera sees does not depend on the other cameras of a scene. A built scene holds finer levels
for its sharpest camera; a camera is drawn with those that its own pixels per radian ask for, and if
these are more than usual, antialiased and with every level up to half the distance. Without
antialiasing all that is thinner than a pixel is drawn a pixel wide, and at 1900 pixels across a line
is as thin as that from 30 m on.

The sky is no Gaussian: its image stands behind everything and is blended with what transparency is
left. ``alpha`` is therefore the accumulated opacity of the scene *without* the sky (0 in the open
sky), which is what the paper's opacity-mixed source needs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, NamedTuple, final

import numpy as np

from alpasim_plugin.core.detail import halvings_of
from alpasim_plugin.core.devices import batched, implementation
from alpasim_plugin.core.errors import RendererError
from alpasim_plugin.core.types import F64, I64, Bool, CameraSpec, FloatArray
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud, placed_cloud
from alpasim_plugin.gaussians.constants import MIP_PX2
from alpasim_plugin.gaussians.lens_camera import LensCamera
from alpasim_plugin.gaussians.raster.output import RasterOutput
from alpasim_plugin.gaussians.raster.prepared import Node, PreparedCloud, prepare
from alpasim_plugin.gaussians.raster.rasterize_cpu import rasterize_prepared
from alpasim_plugin.gaussians.scene.sky import Sky

if TYPE_CHECKING:
    from alpasim_plugin.gaussians.raster.device_output import DeviceOutput
    from alpasim_plugin.gaussians.raster.rasterize_triton import UploadedClouds


@dataclass(frozen=True, eq=False)
class Level:
    """One level of detail: Gaussians that stand for cells of about ``cell_m``."""

    cell_m: float
    cloud: GaussianCloud

    @cached_property
    def prepared(self) -> PreparedCloud:
        """Return the Gaussians as the CPU's rasteriser takes them, kept as long as the level is."""
        return prepare(self.cloud)


@dataclass(frozen=True, eq=False)
class SceneNode:
    """A part of a scene that is culled and drawn as a whole.

    Attributes:
        name: Unique within the scene; an actor's node bears the actor's id.
        kind: ``background`` (world coordinates) or ``actor`` (box frame: origin at the box centre,
            x length, y width, z height).
        levels: Finest first.
        far_m: Beyond this distance the node is not drawn.
        usual_cell_m: Levels with smaller cells are for sharp cameras.
        is_built: Whether it is antialiased for sharp cameras; a model from elsewhere is drawn as it
            was trained.
    """

    name: str
    kind: str
    levels: tuple[Level, ...]
    far_m: float = 1.0e9
    usual_cell_m: float = 0.0
    is_built: bool = False

    @cached_property
    def sphere(self) -> tuple[F64, float]:
        """Return a centre ``(3,)`` and radius around the three-sigma extent of all levels."""
        clouds = [level.cloud for level in self.levels if len(level.cloud)]
        if not clouds:
            return np.zeros(3), 0.0
        # A coordinate at a time: numpy is slow along an axis of three.
        centres = [np.ascontiguousarray(cloud.means.T) for cloud in clouds]
        reach = [
            3 * np.maximum(np.maximum(*cloud.scales.T[:2]), cloud.scales.T[2]) for cloud in clouds
        ]
        low = np.min(
            [(centre - radius).min(axis=1) for centre, radius in zip(centres, reach, strict=True)],
            axis=0,
        )
        high = np.max(
            [(centre + radius).max(axis=1) for centre, radius in zip(centres, reach, strict=True)],
            axis=0,
        )
        return (low + high) / 2, float(np.linalg.norm(high - low) / 2)


def split_by_tile(cloud: GaussianCloud, tile: I64) -> dict[int, GaussianCloud]:
    """Return the Gaussians of each tile; ``tile (N,)`` names the tile of each Gaussian."""
    if not len(tile):
        return {}
    order = np.argsort(tile, kind="stable")
    ids, first = np.unique(tile[order], return_index=True)
    ordered = cloud.take(order)
    ends = [*first[1:], len(order)]
    return {
        int(i): ordered.take(slice(begin, end))
        for i, begin, end in zip(ids, first, ends, strict=True)
    }


def tile_numbers(xy: FloatArray, size_m: float, row: int = 100_000) -> I64:
    """Return the number ``(N,)`` of the square tile in which each point ``(N, 2)`` lies; ``row``
    more from one row of tiles to the next.
    """
    tile = np.floor(xy / size_m).astype(np.int64)
    return tile[:, 1] * row + tile[:, 0]


def nodes_by_tile(
    prefix: str,
    levels: list[tuple[float, GaussianCloud, I64]],
    far_m: float = 1.0e9,
    usual_cell_m: float = 0.0,
) -> list[SceneNode]:
    """Group clouds of several levels into one node per tile.

    Args:
        prefix: Start of the nodes' names.
        levels: (cell size, cloud, tile of each Gaussian), finest first. A tile may lack some: what
            lies across a border may have its middle in one tile at one size and in the next at
            another.
        far_m, usual_cell_m: See `SceneNode`.
    """
    by_tile: dict[int, list[Level]] = {}
    for cell_m, cloud, tile in levels:
        for i, part in split_by_tile(cloud, tile).items():
            by_tile.setdefault(i, []).append(Level(cell_m, part))
    return [
        SceneNode(f"{prefix}/{i}", "background", tuple(by_tile[i]), far_m, usual_cell_m)
        for i in sorted(by_tile)
    ]


CELL_PX = 3.5  # larger is faster and coarser
FILE_TILE_M = 16.0  # blocks in which a model from a file is culled
Camera = PinholeCamera | LensCamera
SceneView = tuple[Camera, Mapping[str, F64]]  # from where, and ``T_world_box`` of the actors


class ChosenNode(NamedTuple):
    """A node that a camera may see."""

    node: SceneNode
    level: int
    T_world_node: F64 | None  # (4, 4); None: the identity
    antialiased: bool


@dataclass(frozen=True, eq=False)
class NodeSet:
    """Nodes in world coordinates, with what they are culled by.

    Attributes:
        nodes: In the order of drawing at equal depth.
        centre, radius: ``(N, 3)``, ``(N,)`` metres, world: their spheres.
        far_m: ``(N,)`` metres: beyond this distance they are not drawn.
    """

    nodes: tuple[SceneNode, ...]
    centre: F64
    radius: F64
    far_m: F64

    @classmethod
    def of(cls, nodes: Iterable[SceneNode]) -> NodeSet:
        """Return the set of nodes."""
        chosen = tuple(nodes)
        centre, radius = _spheres(chosen)
        return cls(chosen, centre, radius, np.array([node.far_m for node in chosen]))


class SceneGraph:
    """A scene ready to be rendered from anywhere.

    Every kind of scene is drawn by `render_all`, which nothing overrides. What is not held as a
    whole overrides `backgrounds`.

    Args:
        background: Nodes in world coordinates.
        actors: Nodes in box frames; the name is the actor's id.
        sky: What stands behind everything.
    """

    def __init__(
        self,
        background: Sequence[SceneNode],
        actors: Sequence[SceneNode],
        sky: Sky,
    ) -> None:
        self.actors = {node.name: node for node in sorted(actors, key=lambda node: node.name)}
        self.sky = sky
        self._whole = NodeSet.of(background)
        self._uploaded: dict[str, _OnDevice] = {}

    @property
    def background(self) -> tuple[SceneNode, ...]:
        """Return the background nodes that are held now."""
        return self._whole.nodes

    def backgrounds(self, cameras: Sequence[Camera]) -> Sequence[NodeSet]:
        """Return for each camera the background that it may see."""
        return [self._whole] * len(cameras)

    def __len__(self) -> int:
        """Return the number of Gaussians at the finest level."""
        return sum(len(node.levels[0].cloud) for node in (*self.background, *self.actors.values()))

    @final
    def render(
        self,
        camera: Camera,
        actor_poses: Mapping[str, F64],
        threads: int | None = None,
        device: str = "cpu",
        px_per_rad: float | None = None,
    ) -> RasterOutput:
        """Render one view; see `render_all`."""
        return self.render_all([(camera, actor_poses)], threads, device, px_per_rad)[0]

    @final
    def render_all(
        self,
        views: Sequence[SceneView],
        threads: int | None = None,
        device: str = "cpu",
        px_per_rad: float | None = None,
    ) -> list[RasterOutput]:
        """Render views; a GPU draws those of one size together.

        Args:
            views: From where, and actor id to ``T_world_box (4, 4)`` of the actors present.
            threads: Thread count on the CPU; None leaves it as it is.
            device: Where to draw. The first frame on a GPU uploads all nodes.
            px_per_rad: Of the camera whose smaller image this is, which decides whether it is
                sharp; None: the camera's own.

        Returns:
            Of each view colour with sky, alpha and depth. A GPU's is a `DeviceOutput`.

        Raises:
            RendererError: A pose for an actor that the scene does not hold.
        """
        backgrounds = self.backgrounds([camera for camera, _ in views])
        chosen = [
            (camera, self._choose(camera, poses, halvings_of(px_per_rad or camera.fx), background))
            for (camera, poses), background in zip(views, backgrounds, strict=True)
        ]
        held = dict.fromkeys(node for background in backgrounds for node in background.nodes)
        one_by_one = partial(map, partial(self._draw_on_host, threads))
        on_card = partial(self._draw_on_card, device, tuple(held))
        draw: Callable[..., Iterable[RasterOutput]] = implementation(device, one_by_one, on_card)
        return list(draw(chosen))

    def _draw_on_host(
        self, threads: int | None, view: tuple[Camera, Sequence[ChosenNode]]
    ) -> RasterOutput:
        camera, chosen = view
        nodes: list[Node] = []
        for choice in chosen:
            prepared = choice.node.levels[choice.level].prepared
            if choice.antialiased:
                prepared = replace(prepared, antialias_px2=MIP_PX2)
            nodes.append((prepared, choice.T_world_node))
        behind = self.sky.image(camera)
        starts = _starts(camera, chosen)
        return rasterize_prepared(nodes, camera, behind, threads=threads, starts=starts)

    def _draw_on_card(
        self,
        device: str,
        held: tuple[SceneNode, ...],
        views: Sequence[tuple[Camera, Sequence[ChosenNode]]],
    ) -> list[DeviceOutput]:
        from alpasim_plugin.gaussians.raster.rasterize_triton import (
            CloudView,
            DrawnCloud,
            drawn_together,
        )

        _, clouds, place = self._upload(device, held)
        placed = [
            (
                camera,
                [
                    DrawnCloud(place[node.name, level], T, antialiased, start)
                    for (node, level, T, antialiased), start in zip(
                        chosen, _starts(camera, chosen), strict=True
                    )
                ],
            )
            for camera, chosen in views
        ]

        def draw(batch: Sequence[CloudView]) -> list[DeviceOutput]:
            return clouds.draw(batch, self.sky.on_device([camera for camera, _ in batch], device))

        return batched(placed, lambda view: drawn_together(view[0]), draw)

    def _choose(
        self,
        camera: Camera,
        actor_poses: Mapping[str, F64],
        halvings: int,
        background: NodeSet,
    ) -> list[ChosenNode]:
        """Return the nodes that a camera sees, each with the level whose cells are small enough at
        its distance.

        Args:
            camera: From where.
            actor_poses: Road user -> ``(4, 4)`` pose of its box; those without one are not there.
            halvings: How often the cells of usual cameras are halved for this one.
            background: What does not move.

        Raises:
            RendererError: A pose of a road user that has no model.
        """
        unknown = sorted(set(actor_poses) - set(self.actors))
        if unknown:
            raise RendererError(
                f"poses of {len(actor_poses)} actors: actor {unknown[0]!r} has no model in this scene",
                "pass poses of the scenario's own actors only",
            )
        present = [node for node in self.actors.values() if node.name in actor_poses]
        poses = np.array([actor_poses[node.name] for node in present]).reshape(-1, 4, 4)
        centre, radius = _spheres(present)
        moved = np.einsum("nij,nj->ni", poses[:, :3, :3], centre) + poses[:, :3, 3]
        centres = np.concatenate([background.centre, moved])
        radii = np.concatenate([background.radius, radius])
        distance = np.linalg.norm(centres - camera.centre_world, axis=1) - radii
        visible = in_view(camera, centres, radii)
        count = len(background.nodes)
        visible[:count] &= distance[:count] < background.far_m
        nodes = (*background.nodes, *present)
        places = [None] * count + list(poses)
        allowed_m = CELL_PX * np.maximum(distance, 0.0) / max(camera.fx, camera.fy)
        chosen = []
        for i in np.flatnonzero(visible):
            level = _level(nodes[i], float(allowed_m[i]), halvings)
            if level is not None:
                antialiased = halvings > 0 and nodes[i].is_built
                chosen.append(ChosenNode(nodes[i], level, places[i], antialiased))
        return chosen

    def _upload(self, device: str, held: tuple[SceneNode, ...]) -> _OnDevice:
        """Return all levels of the background and of the actors on a device; what was there is
        kept if the background is the same.
        """
        kept = self._uploaded.get(device)
        if kept is None or kept.background != held:
            from alpasim_plugin.gaussians.raster.rasterize_triton import UploadedClouds

            clouds = {
                (node.name, i): level.cloud
                for node in (*held, *self.actors.values())
                for i, level in enumerate(node.levels)
            }
            place = {key: number for number, key in enumerate(clouds)}
            kept = _OnDevice(held, UploadedClouds(list(clouds.values()), device), place)
            self._uploaded[device] = kept
        return kept


class _OnDevice(NamedTuple):
    """What lies on a device: the clouds of a background and of all actors, and the place of each
    by the node's name and the level.
    """

    background: tuple[SceneNode, ...]
    clouds: UploadedClouds
    place: Mapping[tuple[str, int], int]


def _level(node: SceneNode, allowed_m: float, halvings: int) -> int | None:
    """Return the coarsest level whose cells are small enough for a camera, else the finest of those
    that the camera may use; None for a node that only sharper cameras see.
    """
    least_m = node.usual_cell_m / 2**halvings
    most_m = allowed_m / 2 if halvings and node.is_built else allowed_m
    level_numbers = [i for i, level in enumerate(node.levels) if level.cell_m >= least_m]
    fit = [i for i in level_numbers if node.levels[i].cell_m <= most_m]
    if fit:
        return fit[-1]
    return level_numbers[0] if level_numbers else None


def _starts(camera: Camera, chosen: Sequence[ChosenNode]) -> list[F64 | None]:
    """Return where nodes were at the start of a rolling shutter; None: they stand."""
    if camera.rolling is None:
        return [None] * len(chosen)
    return [camera.rolling.actors_start.get(choice.node.name) for choice in chosen]


def posed(spec: CameraSpec, T_world_camera: F64) -> Camera:
    """Return a camera at a pose ``(4, 4)``, with its lens if it has one."""
    if spec.lens is not None:
        return LensCamera.from_pose(spec, T_world_camera)
    return PinholeCamera.from_pose(spec.width, spec.height, spec.K, T_world_camera)


def in_view(camera: Camera, centre: F64, radius: F64) -> Bool:
    """Return which spheres ``(N, 3)``, ``(N,)`` in the world meet the camera's view volume
    (conservative at its corners), while its shutter is open.
    """
    if isinstance(camera, LensCamera):
        return camera.in_view(centre, radius)
    if camera.rolling is not None:
        camera = camera.widened(camera.rolling.reach_px)
    p = centre @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]
    x, y, z = p.T
    visible = z > -radius
    for slope, coordinate, sign in (
        (camera.cx / camera.fx, x, 1.0),
        ((camera.width - camera.cx) / camera.fx, x, -1.0),
        (camera.cy / camera.fy, y, 1.0),
        ((camera.height - camera.cy) / camera.fy, y, -1.0),
    ):
        visible &= sign * coordinate + slope * z > -radius * np.hypot(1.0, slope)
    return visible


def _spheres(nodes: Sequence[SceneNode]) -> tuple[F64, F64]:
    return np.array([node.sphere[0] for node in nodes]).reshape(-1, 3), np.array(
        [node.sphere[1] for node in nodes]
    )


def with_background(graph: SceneGraph, cloud: GaussianCloud, T_world_file: F64) -> SceneGraph:
    """Return the scene with a Gaussian model as its background, cut into blocks that are culled one
    by one.

    Args:
        graph: Actors and sky, and a road that is drawn with the model.
        cloud: The model in its file's frame.
        T_world_file: ``(4, 4)`` rotation, translation and one scale for all axes.
    """
    placed = placed_cloud(cloud, T_world_file)
    nodes = nodes_by_tile(
        "file", [(0.0, placed, tile_numbers(placed.means[:, :2], FILE_TILE_M, 1_000_003))]
    )
    return SceneGraph(
        [*graph.background, *nodes],
        list(graph.actors.values()),
        graph.sky,
    )
