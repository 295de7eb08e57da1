"""Draw the semantic map that conditions a fixer: lanes, boundaries, crossings, signs and road users
seen from a camera.

Prepare a scene once (`prepare_map`), then draw it from any camera. A depth buffer resolves
occlusion; colours and widths fade with depth along the optical axis, of a camera with a lens with
that of `lens_kernels`.

Camera axes are x right, y down, z forward; pixel (row i, column j) covers columns j to j + 1 and
rows i to i + 1.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from alpasim_plugin.cameras.lens import exposed_bands
from alpasim_plugin.cameras.shutter import joined
from alpasim_plugin.core.devices import batched, implementation, upload
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F64, U8, Actor, CameraSpec, RenderRequest
from alpasim_plugin.fixers.semantic_map import kernels, lens_kernels
from alpasim_plugin.fixers.semantic_map.lens_kernels import lens_numbers
from alpasim_plugin.fixers.semantic_map.prepare import (
    CORNERS,
    EDGES,
    TRIANGLES,
    ActorBox,
    PreparedMap,
    Segments,
    Triangles,
    actor_boxes,
)
from alpasim_plugin.fixers.semantic_map.raster import BAND, draw_bands
from alpasim_plugin.fixers.semantic_map.style import (
    BOX_COLOURS,
    BOX_EDGE_PX,
    COLOURS,
    EDGE_BIAS_M,
    NEAR_M,
    WIDTH_DEFINED_AT_PX,
    box_class,
)
from alpasim_plugin.gaussians.lens_camera import lens_map, lens_rays
from alpasim_plugin.gaussians.raster.stages import run_on_threads, thread_count

EDGE_STYLE = np.array((BOX_EDGE_PX, EDGE_BIAS_M, *COLOURS["box_edge"]))


def draw_map(
    scene: PreparedMap,
    camera: CameraSpec,
    T_world_camera: F64,
    actors: Sequence[ActorBox] = (),
    *,
    threads: int | None = None,
    rows: slice | None = None,
) -> U8:
    """Draw the map and the road users as ``(H, W, 3)`` uint8.

    Args:
        scene: The prepared map.
        camera: Its lens or, where it has none, its pinhole.
        T_world_camera: ``(4, 4)`` pose of the camera (x right, y down, z forward).
        actors: Road users present at this instant.
        threads: How many threads to use; None takes ``numba.get_num_threads()``. The image does not
            depend on it.
        rows: The part of the image to draw and to return; None: all.
    """
    rows = slice(0, camera.height) if rows is None else rows
    view, pose, faces, edges = seen_from(scene, camera, T_world_camera, actors)
    strokes, shapes_of_part = strokes_of, shapes_of
    if camera.lens is not None:
        view = lens_numbers(camera, lens_map(camera))
        faces = replace(faces, closed=np.ones_like(faces.closed))  # nothing is cut at a near plane
        strokes, shapes_of_part = lens_strokes_of, lens_shapes_of
    lines, box_edges = (strokes(part, pose, view) for part in (scene.segments, edges))
    shapes = np.concatenate([shapes_of_part(part, pose, view) for part in (scene.triangles, faces)])
    image: U8 = np.empty((rows.stop, camera.width, 3), dtype=np.uint8)
    band = np.full(1, rows.start // BAND, dtype=np.int64)
    stretch = camera.width / camera.height
    run_on_threads(
        thread_count(threads), draw_bands, band, lines, box_edges, shapes, stretch, image
    )
    if camera.lens is not None:
        visible = lens_rays(camera).visible.reshape(camera.height, camera.width)
        image[rows][~visible[rows]] = 0
    return image[rows]


def draw_exposed_maps(
    scene: PreparedMap,
    requests: Sequence[RenderRequest],
    actors: Sequence[Actor],
    threads: int | None = None,
    device: Any = "cpu",
) -> list[Any]:
    """Draw the maps of requested frames ``(H, W, 3)``: each band of a rolling shutter at its
    instant; see `draw_map`.

    Args:
        scene: Prepared map.
        requests: Cameras, poses, road users and when rows are exposed.
        actors: The scenario's, for the sizes of their boxes.
        threads: As many CPU threads; None leaves numba's number.
        device: What draws the maps; a card keeps them as tensors, and draws all of one size at
            once. Those through lenses are drawn on the CPU and sent there.
    """
    draw = implementation(device, partial(_on_host, threads), partial(_on_card, device, threads))
    cuts = [exposed_bands(request) for request in requests]
    views = [
        (request.camera, band.T_world_camera, actor_boxes(band.actors, actors), band.rows)
        for request, cut in zip(requests, cuts, strict=True)
        for band in cut
    ]
    parts = iter(draw(scene, views))
    return [
        joined(request, cut, [next(parts)[:, band.columns] for band in cut])
        for request, cut in zip(requests, cuts, strict=True)
    ]


View = tuple[CameraSpec, F64, Sequence[ActorBox], slice]  # its pose, road users and rows


def _on_host(threads: int | None, scene: PreparedMap, views: Sequence[View]) -> list[Any]:
    return [
        draw_map(scene, camera, T, actors, threads=threads, rows=rows)
        for camera, T, actors, rows in views
    ]


def _on_card(
    device: Any, threads: int | None, scene: PreparedMap, views: Sequence[View]
) -> list[Any]:
    """Draw maps on a card; those through lenses are drawn on the CPU and sent there."""
    return batched(
        views, lambda view: view[0].lens is not None, partial(_sent, device, threads, scene)
    )


def _sent(device: Any, threads: int | None, scene: PreparedMap, views: Sequence[View]) -> list[Any]:
    """Return the maps of views, which all have a lens or none, on a card."""
    if views[0][0].lens is not None:
        return [upload(image, device) for image in _on_host(threads, scene, views)]
    from alpasim_plugin.fixers.semantic_map.on_device import draw_tiles, size_of

    visible = [(*seen_from(scene, camera, T, actors), rows) for camera, T, actors, rows in views]
    return batched(visible, size_of, partial(draw_tiles, scene, device))


def seen_from(
    scene: PreparedMap, camera: CameraSpec, T_world_camera: F64, actors: Sequence[ActorBox]
) -> tuple[F64, F64, Triangles, Segments]:
    """Return the view as `kernels` reads it, the pose ``(3, 4)`` that maps the scene's own
    coordinates into the camera's, and the faces and edges of road users.
    """
    K = np.asarray(camera.K, dtype=np.float64)
    intrinsics = (K[0, 0], K[0, 1], K[1, 1], K[0, 2], K[1, 2])
    view = (*intrinsics, camera.width, camera.height, camera.width / WIDTH_DEFINED_AT_PX)
    T = np.array(T_world_camera, dtype=np.float64)
    T[:3, 3] -= scene.origin  # the difference of large coordinates is taken here, once, in float64
    pose = np.ascontiguousarray(inverse(T)[:3])
    # The faces of road users, the nearest first, so that hidden ones are not shaded. Boxes cut by
    # the near plane show their inner faces; of others, faces turned away are culled.
    poses = np.array([actor.T_world_box for actor in actors], dtype=np.float64).reshape(-1, 4, 4)
    sizes = np.array([actor.box.size_m for actor in actors], dtype=np.float64).reshape(-1, 1, 3)
    centres = poses[:, :3, 3] - scene.origin
    order = np.argsort(centres @ pose[2, :3], kind="stable")
    rotated = (CORNERS * sizes) @ poses[:, :3, :3].transpose(0, 2, 1)
    corners = (rotated + centres[:, None, :])[order]
    uncut = (corners @ pose[2, :3] + pose[2, 3]).min(axis=1, initial=np.inf) > NEAR_M
    colours = [BOX_COLOURS[box_class(actors[i].label)] for i in order]
    style = np.array([(0.0, *front, *back) for front, back in colours]).reshape(-1, 7)
    n = len(TRIANGLES)
    # Tiled once, an array keeps the order of its index; the kernel would be compiled for that order
    # as well.
    shade = np.ascontiguousarray(np.tile((0.5 - CORNERS[:, 0])[TRIANGLES], (len(actors), 1)))
    triangles = corners[:, TRIANGLES].reshape(-1, 3, 3)
    faces = Triangles(triangles, np.repeat(uncut, n), shade, np.repeat(style, n, axis=0))
    ends = corners[:, EDGES].reshape(-1, 2, 3)
    edges = Segments(ends, np.tile(EDGE_STYLE, (len(ends), 1)))
    return np.array(view), pose, faces, edges


def strokes_of(part: Segments, pose: F64, view: F64) -> F64:
    """Return the strokes of segments ``(N, STROKE)``."""
    out = np.empty((len(part.ends), kernels.STROKE))
    return out[: kernels.strokes(part.ends, part.style, pose, view, out)]


def shapes_of(part: Triangles, pose: F64, view: F64) -> F64:
    """Return the shapes of triangles ``(N, SHAPE)``."""
    out = np.empty((2 * len(part.corners), kernels.SHAPE))
    flat = part.corners, part.closed, part.shade, part.style
    return out[: kernels.shapes(*flat, pose, view, out)]


def lens_strokes_of(part: Segments, pose: F64, view: F64) -> F64:
    """Return the strokes of segments ``(N, STROKE)`` in the image of a lens."""
    put = partial(lens_kernels.lens_strokes, part.ends, part.style, pose, view)
    return _put(put, 4 * len(part.ends), kernels.STROKE)


def lens_shapes_of(part: Triangles, pose: F64, view: F64) -> F64:
    """Return the shapes of triangles ``(N, SHAPE)`` in the image of a lens."""
    flat = part.corners, part.closed, part.shade, part.style
    put = partial(lens_kernels.lens_shapes, *flat, pose, view)
    return _put(put, 8 * len(part.corners), kernels.SHAPE)


def _put(put: Callable[[F64], int], expected: int, columns: int) -> F64:
    """Return what a kernel writes, in as many rows as it needs."""
    out = np.empty((expected, columns))
    count = put(out)
    if count > len(out):
        out = np.empty((count, columns))
        count = put(out)
    return out[:count]
