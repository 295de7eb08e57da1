"""Draw the semantic map that conditions a fixer: lanes, boundaries, crossings, signs and road users
seen from a camera.

Prepare a scene once (`prepare_map`), then draw it from any pinhole camera. A depth buffer resolves
occlusion; colours and widths fade with depth along the optical axis. Tests compare with the
reference implementation `tests/fixers/draw_reference.py`.

Camera axes are x right, y down, z forward; pixel (row i, column j) covers columns j to j + 1 and
rows i to i + 1.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.shutter import bands
from alpasim_plugin.core.types import F64, U8, Actor, CameraSpec, RenderRequest
from alpasim_plugin.fixers.semantic_map import kernels
from alpasim_plugin.fixers.semantic_map.prepare import (
    CORNERS,
    EDGES,
    TRIANGLES,
    ActorBox,
    PreparedMap,
    Segments,
    Triangles,
    actor_boxes,
    require_box,
)
from alpasim_plugin.fixers.semantic_map.raster import BAND, draw_bands, rows_of
from alpasim_plugin.fixers.semantic_map.style import (
    BOX_COLOURS,
    BOX_EDGE_PX,
    COLOURS,
    EDGE_BIAS_M,
    NEAR_M,
    WIDTH_DEFINED_AT_PX,
    box_class,
)
from alpasim_plugin.gaussians.cloud import require_rigid
from alpasim_plugin.gaussians.raster.rasterize_cpu import run_on_threads, thread_count

MARGIN_RAD = 0.1  # half of the widest line reaches this far into the view from outside
NO_SPHERES = np.zeros((0, 4))
EDGE_STYLE = np.array((BOX_EDGE_PX, EDGE_BIAS_M, *COLOURS["box_edge"]))


class _Buffers(threading.local):
    """Arrays reused between frames, one set per calling thread."""

    def __init__(self) -> None:
        self.strokes = np.empty((4096, kernels.STROKE))
        self.shapes = np.empty((4096, kernels.SHAPE))


_buffers = _Buffers()


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
        camera: It is drawn as the pinhole K.
        T_world_camera: ``(4, 4)`` pose of the camera (x right, y down, z forward).
        actors: Road users present at this instant.
        threads: How many threads to use; None takes ``numba.get_num_threads()``. The image does not
            depend on it.
        rows: The part of the image to draw and to return; None: all.

    Raises:
        InputError: A pose that is not rigid or not finite, a box of impossible size, or an invalid
            camera.
    """
    rows = slice(0, camera.height) if rows is None else rows
    view, pose = view_of(scene, camera, T_world_camera)
    faces, edges = actor_geometry(actors, scene, pose)
    n_lines, strokes = project_strokes((scene.segments, edges), pose, view)
    shapes = project_shapes((scene.triangles, faces), pose, view)
    image: U8 = np.empty((rows.stop, camera.width, 3), np.uint8)
    stroke_rows = np.empty((len(strokes), 2), np.int64)
    shape_rows = np.empty((len(shapes), 2), np.int64)
    stretch = camera.width / camera.height
    rows_of(strokes, shapes, stretch, rows.stop, stroke_rows, shape_rows)
    run_on_threads(
        thread_count(threads),
        draw_bands,
        np.full(1, rows.start // BAND, np.int64),
        strokes[:n_lines],
        strokes[n_lines:],
        stroke_rows[:n_lines],
        stroke_rows[n_lines:],
        shapes,
        shape_rows,
        stretch,
        image,
    )
    return image[rows]


def draw_exposed_map(
    scene: PreparedMap, request: RenderRequest, actors: Sequence[Actor], threads: int | None = None
) -> U8:
    """Draw the map of a requested frame ``(H, W, 3)``: each band of a rolling shutter at its
    instant; see `draw_map`.

    Args:
        scene: Prepared map.
        request: Camera, poses, road users and when rows are exposed.
        actors: The scenario's, for the sizes of their boxes.
        threads: As many CPU threads; None leaves numba's number.
    """
    out: U8 = np.zeros((request.camera.height, request.camera.width, 3), np.uint8)
    for band in bands(request):
        boxes = actor_boxes(band.actors, actors)
        part = draw_map(
            scene, request.camera, band.T_world_camera, boxes, threads=threads, rows=band.rows
        )
        band.put(out, part[:, band.columns])
    return out


def view_of(scene: PreparedMap, camera: CameraSpec, T_world_camera: F64) -> tuple[F64, F64]:
    """Return the view as `kernels` reads it, and the pose ``(3, 4)`` that maps the scene's own
    coordinates into the camera's.
    """
    if camera.width < 1 or camera.height < 1:
        raise InputError(
            f"camera {camera.name}: {camera.width} x {camera.height} pixels", "give at least one"
        )
    K = np.asarray(camera.K, dtype=np.float64)
    if K.shape != (3, 3) or not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise InputError(
            f"camera {camera.name}: K = {K.tolist()}", "give intrinsics with positive focal lengths"
        )
    require_rigid(T_world_camera, "camera pose of the semantic map")
    image_corners = [[u, v, 1.0] for u in (0, camera.width) for v in (0, camera.height)]
    corners = np.array(image_corners) @ np.linalg.inv(K).T
    half_angle = float(np.arctan(np.hypot(corners[:, 0], corners[:, 1]).max()))
    half = min(half_angle + MARGIN_RAD, np.pi)
    intrinsics = (K[0, 0], K[0, 1], K[1, 1], K[0, 2], K[1, 2])
    scale = camera.width / WIDTH_DEFINED_AT_PX
    view = np.array([*intrinsics, camera.width, camera.height, np.cos(half), np.sin(half), scale])
    T = np.array(T_world_camera, dtype=np.float64)
    T[:3, 3] -= scene.origin  # the difference of large coordinates is taken here, once, in float64
    return view, np.ascontiguousarray(inverse(T)[:3])


def actor_geometry(
    actors: Sequence[ActorBox], scene: PreparedMap, pose: F64
) -> tuple[Triangles, Segments]:
    """Return the faces and edges of road users, the nearest first, so that hidden ones are not
    shaded.

    Boxes cut by the near plane show their inner faces; other boxes are marked closed, so that faces
    turned away are culled.
    """
    for actor in actors:
        require_box(f"actor box ({actor.label})", actor.T_world_box, actor.box)
    poses = np.array([actor.T_world_box for actor in actors], dtype=np.float64).reshape(-1, 4, 4)
    boxes = [actor.box for actor in actors]
    lengths = [(box.length_m, box.width_m, box.height_m) for box in boxes]
    sizes = np.array(lengths, dtype=np.float64).reshape(-1, 1, 3)
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
    return faces, Segments(ends, np.tile(EDGE_STYLE, (len(ends), 1)), NO_SPHERES)


def project_strokes(parts: Sequence[Segments], pose: F64, view: F64) -> tuple[int, F64]:
    """Return how many strokes the first part has, and the strokes of all parts ``(N, STROKE)``."""
    while True:
        out = _buffers.strokes
        counts = [0]
        for part in parts:
            lines = part.ends, part.style, part.spheres
            counts.append(int(kernels.strokes(*lines, pose, view, out, counts[-1])))
        if counts[-1] <= len(out):
            return counts[1], out[: counts[-1]]
        _buffers.strokes = np.empty((counts[-1] * 5 // 4, kernels.STROKE))


def project_shapes(parts: Sequence[Triangles], pose: F64, view: F64) -> F64:
    """Return the shapes of all parts ``(N, SHAPE)``."""
    while True:
        out = _buffers.shapes
        count = 0
        for part in parts:
            flat = part.corners, part.closed, part.shade, part.style
            count = int(kernels.shapes(*flat, pose, view, out, count))
        if count <= len(out):
            return out[:count]
        _buffers.shapes = np.empty((count * 5 // 4, kernels.SHAPE))
