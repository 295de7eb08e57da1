"""Draw the semantic map that conditions a fixer: lanes, boundaries, crossings, signs, lights and road users seen from a camera.

Prepare a scene once (`prepare_map`), then draw it from any camera, pinhole or f-theta. A depth buffer resolves occlusion; colours and
widths fade with depth along the optical axis. Tests compare with the reference implementation `tests/semantic_map/draw_reference.py`.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np

from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F64, U8
from alpasim_plugin.gaussians.cloud import require_rigid
from alpasim_plugin.gaussians.raster.workers import run_on_threads, thread_count
from alpasim_plugin.semantic_map.kernels import SHAPE, STROKE
from alpasim_plugin.semantic_map.kernels import shapes as project_shapes
from alpasim_plugin.semantic_map.kernels import strokes as project_strokes
from alpasim_plugin.semantic_map.layers import ActorBox
from alpasim_plugin.semantic_map.prepare import CORNERS, EDGES, TRIANGLES, PreparedMap, Segments, Triangles, require_box
from alpasim_plugin.semantic_map.projection import KernelCamera, MapCamera, kernel_camera
from alpasim_plugin.semantic_map.raster import SAMPLES_1, SAMPLES_4, draw_bands, rows_of
from alpasim_plugin.semantic_map.style import WIDTH_DEFINED_AT_PX, MapStyle, box_class

DOING = "drawing the semantic map"
_MARGIN_RAD = 0.1  # half of the widest line reaches this far into the view from outside
_NO_SPHERES = np.zeros((0, 4))


class _Buffers(threading.local):
    """Arrays reused between frames, one set per calling thread."""

    def __init__(self) -> None:
        self.strokes = np.empty((4096, STROKE))
        self.shapes = np.empty((4096, SHAPE))


_buffers = _Buffers()


def draw_map(
    scene: PreparedMap, camera: MapCamera, T_world_camera: F64, actors: Sequence[ActorBox] = (), *, threads: int | None = None
) -> U8:
    """Draw the map and the road users as ``(H, W, 3)`` uint8.

    Args:
        scene: The prepared map.
        camera: A `CameraSpec` is drawn as the pinhole K; a `FThetaCamera` through its lens.
        T_world_camera: ``(4, 4)`` pose of the camera (x right, y down, z forward).
        actors: Road users present at this instant.
        threads: How many threads to use; None takes ``numba.get_num_threads()``. The image does not depend on it.

    Raises:
        InputError: A pose that is not rigid or not finite, a box of impossible size, or an invalid camera.
    """
    lens, view, pose = view_of(scene, camera, T_world_camera)
    faces, edges = actor_geometry(actors, scene, pose)
    n_first, n_strokes, strokes = _strokes(scene.segments, edges, pose, lens, view)
    n_shapes, shapes = _shapes(scene.triangles, faces, pose, lens, view)

    image: U8 = np.empty((camera.height, camera.width, 3), np.uint8)
    stroke_rows, shape_rows = np.empty((n_strokes, 2), np.int64), np.empty((n_shapes, 2), np.int64)
    stretch = stretch_of(scene.style, camera)
    rows_of(strokes, n_strokes, shapes, n_shapes, stretch, camera.height, stroke_rows, shape_rows)
    run_on_threads(
        thread_count(threads), draw_bands, np.zeros(1, np.int64), strokes, n_first, n_strokes, stroke_rows, shapes, n_shapes, shape_rows,
        stretch, scene.style.depth_max_m, samples_of(scene.style), image,
    )  # fmt: skip
    return image


def samples_of(style: MapStyle) -> F64:
    """Return the sample offsets ``(n, 2)`` of a style, pixels from the centre."""
    return SAMPLES_4 if style.samples == 4 else SAMPLES_1


def stretch_of(style: MapStyle, camera: MapCamera) -> float:
    """Return how much longer a vertical pixel counts than a horizontal one when widths are measured."""
    return camera.width / camera.height if style.ndc_widths else 1.0


def view_of(scene: PreparedMap, camera: MapCamera, T_world_camera: F64) -> tuple[KernelCamera, F64, F64]:
    """Return the lens, the view and the pose ``(3, 4)`` that maps the scene's own coordinates into the camera's."""
    require_rigid(T_world_camera, f"{DOING}, camera pose")
    lens = kernel_camera(camera)
    T = np.array(T_world_camera, dtype=np.float64)
    T[:3, 3] -= scene.origin  # the difference of large coordinates is taken here, once, in float64
    half = min(lens.half_angle_rad + _MARGIN_RAD, np.pi)
    style = scene.style
    view = np.array(
        [
            *(camera.width, camera.height, style.near_m, style.depth_max_m),
            *(np.cos(half), np.sin(half), camera.width / WIDTH_DEFINED_AT_PX),
        ]
    )
    return lens, view, np.ascontiguousarray(inverse(T)[:3])


def actor_geometry(actors: Sequence[ActorBox], scene: PreparedMap, pose: F64) -> tuple[Triangles, Segments]:
    """Return the faces and edges of road users, the nearest first, so that hidden ones are not shaded.

    Boxes cut by the near plane show their inner faces; other boxes are marked closed, so that faces turned away are culled.
    """
    style = scene.style
    poses, sizes = _checked(actors)
    order = np.argsort((poses[:, :3, 3] - scene.origin) @ pose[2, :3], kind="stable")
    poses, sizes = poses[order], sizes[order]
    corners = (CORNERS * sizes[:, None, :]) @ poses[:, :3, :3].transpose(0, 2, 1) + (poses[:, :3, 3] - scene.origin)[:, None, :]
    uncut = (corners @ pose[2, :3] + pose[2, 3]).min(axis=1, initial=np.inf) > style.near_m
    shades = [style.box_colours[box_class(actors[i].label)] for i in order]
    colours = np.array([(0.0, *front, *back) for front, back in shades], dtype=np.float64).reshape(-1, 7)
    n = len(TRIANGLES)
    # Tiled once, an array keeps the order of its index; the kernel would be compiled for that order as well.
    shade = np.ascontiguousarray(np.tile((0.5 - CORNERS[:, 0])[TRIANGLES], (len(actors), 1)))
    faces = Triangles(corners[:, TRIANGLES].reshape(-1, 3, 3), np.repeat(uncut, n), shade, np.repeat(colours, n, axis=0))
    edge = np.array((style.box_edge_px, 1.0, style.edge_bias_m, *style.colours["box_edge"]), dtype=np.float64)
    ends = corners[:, EDGES].reshape(-1, 2, 3)
    return faces, Segments(ends, np.tile(edge, (len(ends), 1)), _NO_SPHERES)


def _checked(actors: Sequence[ActorBox]) -> tuple[F64, F64]:
    """Return poses ``(A, 4, 4)`` and sizes ``(A, 3)``, all checked at once; box by box only for the error message."""
    sizes = np.array([(a.box.length_m, a.box.width_m, a.box.height_m) for a in actors], dtype=np.float64).reshape(-1, 3)
    if all(np.shape(actor.T_world_box) == (4, 4) for actor in actors):
        poses = np.array([actor.T_world_box for actor in actors], dtype=np.float64).reshape(-1, 4, 4)
        rotation = poses[:, :3, :3]
        sound = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0) <= 1e-5 and (np.linalg.det(rotation) > 0).all()
        sound = sound and np.isfinite(poses).all() and np.abs(poses[:, 3] - [0, 0, 0, 1]).max(initial=0.0) <= 1e-9
        if sound and np.isfinite(sizes).all() and (sizes >= 0).all():
            return poses, sizes
    for actor in actors:
        require_box(f"actor box ({actor.label})", actor.T_world_box, actor.box, DOING)
    return np.stack([actor.T_world_box for actor in actors]), sizes


def _strokes(static: Segments, edges: Segments, pose: F64, lens: KernelCamera, view: F64) -> tuple[int, int, F64]:
    """Project static lines and box edges; returns the number of the first, of all, and their array."""
    while True:
        out = _buffers.strokes
        first = project_strokes(static.ends, static.style, static.spheres, pose, lens.params, lens.table, view, out, 0)
        count = project_strokes(edges.ends, edges.style, edges.spheres, pose, lens.params, lens.table, view, out, first)
        if count <= len(out):
            return int(first), int(count), out
        _buffers.strokes = np.empty((count + count // 4, STROKE))


def _shapes(static: Triangles, faces: Triangles, pose: F64, lens: KernelCamera, view: F64) -> tuple[int, F64]:
    while True:
        out = _buffers.shapes
        count = project_shapes(static.corners, static.closed, static.shade, static.style, pose, lens.params, lens.table, view, out, 0)
        count = project_shapes(faces.corners, faces.closed, faces.shade, faces.style, pose, lens.params, lens.table, view, out, count)
        if count <= len(out):
            return int(count), out
        _buffers.shapes = np.empty((count + count // 4, SHAPE))
