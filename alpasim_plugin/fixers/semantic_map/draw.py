"""Draw the semantic map that conditions a fixer: lanes, boundaries, crossings, signs, lights and
road users seen from a camera.

Prepare a scene once (`prepare_map`), then draw it from any camera, pinhole or f-theta. A depth
buffer resolves occlusion; colours and widths fade with depth along the optical axis. Tests compare
with the reference implementation `tests/fixers/draw_reference.py`.

Camera axes are x right, y down, z forward; pixel (row i, column j) covers columns j to j + 1 and
rows i to i + 1. An f-theta lens images a ray at angle theta from the axis at distance r(theta) from
the principal point, and the pixel is ``centre + A @ (r * direction)`` with a 2 x 2 matrix A; beyond
the lens's largest angle r goes on in a straight line.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F64, U8, CameraSpec, FTheta
from alpasim_plugin.fixers.semantic_map.kernels import SHAPE, STROKE
from alpasim_plugin.fixers.semantic_map.kernels import shapes as project_shapes
from alpasim_plugin.fixers.semantic_map.kernels import strokes as project_strokes
from alpasim_plugin.fixers.semantic_map.prepare import (
    CORNERS,
    EDGES,
    TRIANGLES,
    ActorBox,
    PreparedMap,
    Segments,
    Triangles,
    require_box,
)
from alpasim_plugin.fixers.semantic_map.raster import (
    BAND,
    SAMPLES_1,
    SAMPLES_4,
    draw_bands,
    rows_of,
)
from alpasim_plugin.fixers.semantic_map.style import WIDTH_DEFINED_AT_PX, MapStyle, box_class
from alpasim_plugin.gaussians.cloud import all_rigid, require_rigid
from alpasim_plugin.gaussians.raster.rasterize_cpu import run_on_threads, thread_count

TABLE = 4096  # angles of the radius table; linear interpolation errs by less than 1e-4 px
_BEYOND_RAD = 0.05  # part of the table beyond the largest angle


@dataclass(frozen=True)
class FThetaCamera:
    """An f-theta camera: image size, principal point in image pixels, lens, and the matrix that
    takes lens pixels to image pixels.
    """

    name: str
    width: int
    height: int
    cx: float
    cy: float
    lens: FTheta
    calibrated: Literal["pixel_to_angle", "angle_to_pixel"] = (
        "angle_to_pixel"  # the calibrated polynomial; the other is its fit
    )
    A: tuple[tuple[float, float], tuple[float, float]] = ((1.0, 0.0), (0.0, 1.0))

    def resized(self, width: int, height: int) -> FThetaCamera:
        """Return the camera of the same image resized to ``width`` x ``height``."""
        sx, sy = width / self.width, height / self.height
        (a, b), (c, d) = self.A
        scaled = ((a * sx, b * sx), (c * sy, d * sy))
        return FThetaCamera(
            self.name, width, height, self.cx * sx, self.cy * sy, self.lens, self.calibrated, scaled
        )


MapCamera = CameraSpec | FThetaCamera


def radius_of(camera: FThetaCamera, theta: F64) -> F64:
    """Return radii, lens pixels, of angles from the axis, radians; Newton's method where the
    calibrated polynomial is the inverse.

    Raises:
        InputError: The lens has no largest angle, or its radius does not grow up to there.
    """
    top = camera.lens.max_angle_rad
    if not np.isfinite(top) or not 0.0 < top < np.pi:
        raise _no_lens(camera, f"largest angle {top!r} rad")
    inside = np.minimum(theta, top)
    with np.errstate(all="ignore"):
        radius = _inside(camera, inside)
        h = 1e-5 * top
        slope = (_inside(camera, np.array([top])) - _inside(camera, np.array([top - h])))[0] / h
    out = radius + np.maximum(theta - top, 0.0) * max(slope, 0.0)
    if not np.isfinite(out).all():
        raise _no_lens(camera, "a radius that is not finite")
    return np.asarray(out, dtype=np.float64)


def _inside(camera: FThetaCamera, theta: F64) -> F64:
    radius = np.polynomial.polynomial.polyval(theta, np.array(camera.lens.angle_to_pixel))
    if camera.calibrated == "pixel_to_angle":
        poly = np.polynomial.Polynomial(camera.lens.pixel_to_angle)
        slope = poly.deriv()
        for _ in range(6):
            radius = radius - (poly(radius) - theta) / slope(radius)
    return np.asarray(radius, dtype=np.float64)


@dataclass(frozen=True)
class KernelCamera:
    """A camera as arrays for the kernels."""

    # (9,) is_ftheta, A00 or fx, A01 or skew, A10, A11 or fy, cx, cy, table entries per radian,
    # table's last angle
    params: F64
    table: F64  # (TABLE + 1,) radii; one entry for a pinhole
    half_angle_rad: float  # largest angle of a pixel from the axis


def kernel_camera(camera: MapCamera) -> KernelCamera:
    """Return a camera as the kernels read it; f-theta lenses are cached.

    Raises:
        InputError: An image without pixels, intrinsics without positive focal lengths, or a lens
            whose radius does not grow.
    """
    if camera.width < 1 or camera.height < 1:
        raise InputError(
            f"camera {camera.name}: {camera.width} x {camera.height} pixels", "give at least one"
        )
    if isinstance(camera, FThetaCamera):
        return _ftheta(camera)
    k = np.asarray(camera.K, dtype=np.float64)
    if k.shape != (3, 3) or not np.isfinite(k).all() or k[0, 0] <= 0 or k[1, 1] <= 0:
        found = np.array2string(k, separator=", ").replace("\n", "")
        raise InputError(
            f"camera {camera.name}: K = {found}",
            "give intrinsics with positive focal lengths",
        )
    corners = (
        np.array([[u, v, 1.0] for u in (0, camera.width) for v in (0, camera.height)])
        @ np.linalg.inv(k).T
    )
    half = float(np.arctan(np.hypot(corners[:, 0], corners[:, 1]).max()))
    params = np.array([0.0, k[0, 0], k[0, 1], 0.0, k[1, 1], k[0, 2], k[1, 2], 0.0, 0.0])
    return KernelCamera(params, np.zeros(1), half)


@cache
def _ftheta(camera: FThetaCamera) -> KernelCamera:
    A = np.array(camera.A, dtype=np.float64)
    if (
        A.shape != (2, 2)
        or not np.isfinite(A).all()
        or abs(np.linalg.det(A)) < 1e-9
        or not np.isfinite([camera.cx, camera.cy]).all()
    ):
        raise _no_lens(camera, f"centre ({camera.cx}, {camera.cy}), A = {camera.A}")
    top = camera.lens.max_angle_rad
    last = min(top + _BEYOND_RAD, np.pi)
    angles = np.linspace(0.0, last, TABLE + 1)
    radii = radius_of(camera, angles)
    if not (np.diff(radii[angles <= top]) > 0).all():
        raise _no_lens(camera, "a radius that does not grow up to its largest angle")
    corners = np.array([[u, v] for u in (0, camera.width) for v in (0, camera.height)]) - (
        camera.cx,
        camera.cy,
    )
    reach = float(np.linalg.norm(corners @ np.linalg.inv(A).T, axis=1).max())
    beyond = (reach - radii[-1]) / max((radii[-1] - radii[-2]) / (angles[-1] - angles[-2]), 1e-9)
    half = (
        float(np.interp(reach, radii, angles))
        if reach <= radii[-1]
        else min(float(last + beyond), np.pi)
    )
    params = np.array([1.0, *A.ravel(), camera.cx, camera.cy, TABLE / last, last])
    return KernelCamera(params, radii, half)


def _no_lens(camera: FThetaCamera, found: str) -> InputError:
    do_this = "give a lens whose radius grows up to max_angle_rad"
    return InputError(f"f-theta camera {camera.name}: {found}", do_this)


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
    scene: PreparedMap,
    camera: MapCamera,
    T_world_camera: F64,
    actors: Sequence[ActorBox] = (),
    *,
    threads: int | None = None,
    rows: slice | None = None,
) -> U8:
    """Draw the map and the road users as ``(H, W, 3)`` uint8.

    Args:
        scene: The prepared map.
        camera: A `CameraSpec` is drawn as the pinhole K; a `FThetaCamera` through its lens.
        T_world_camera: ``(4, 4)`` pose of the camera (x right, y down, z forward).
        actors: Road users present at this instant.
        threads: How many threads to use; None takes ``numba.get_num_threads()``. The image does not
            depend on it.
        rows: The part of the picture to draw and to return; None: all.

    Raises:
        InputError: A pose that is not rigid or not finite, a box of impossible size, or an invalid
            camera.
    """
    first, last = (0, camera.height) if rows is None else (rows.start, rows.stop)
    lens, view, pose = view_of(scene, camera, T_world_camera)
    faces, edges = actor_geometry(actors, scene, pose)
    n_first, n_strokes, strokes = _strokes(scene.segments, edges, pose, lens, view)
    n_shapes, shapes = _shapes(scene.triangles, faces, pose, lens, view)

    image: U8 = np.empty((last, camera.width, 3), np.uint8)
    stroke_rows, shape_rows = np.empty((n_strokes, 2), np.int64), np.empty((n_shapes, 2), np.int64)
    stretch, begin = stretch_of(scene.style, camera), np.full(1, first // BAND, np.int64)
    rows_of(strokes, n_strokes, shapes, n_shapes, stretch, camera.height, stroke_rows, shape_rows)
    run_on_threads(
        thread_count(threads),
        draw_bands,
        begin,
        strokes,
        n_first,
        n_strokes,
        stroke_rows,
        shapes,
        n_shapes,
        shape_rows,
        stretch,
        scene.style.depth_max_m,
        samples_of(scene.style),
        image,
    )
    return image[first:]


def samples_of(style: MapStyle) -> F64:
    """Return the sample offsets ``(n, 2)`` of a style, pixels from the centre."""
    return SAMPLES_4 if style.samples == 4 else SAMPLES_1


def stretch_of(style: MapStyle, camera: MapCamera) -> float:
    """Return how much longer a vertical pixel counts than a horizontal one when widths are
    measured.
    """
    return camera.width / camera.height if style.ndc_widths else 1.0


def view_of(
    scene: PreparedMap, camera: MapCamera, T_world_camera: F64
) -> tuple[KernelCamera, F64, F64]:
    """Return the lens, the view and the pose ``(3, 4)`` that maps the scene's own coordinates into
    the camera's.
    """
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


def actor_geometry(
    actors: Sequence[ActorBox], scene: PreparedMap, pose: F64
) -> tuple[Triangles, Segments]:
    """Return the faces and edges of road users, the nearest first, so that hidden ones are not
    shaded.

    Boxes cut by the near plane show their inner faces; other boxes are marked closed, so that faces
    turned away are culled.
    """
    style = scene.style
    poses, sizes = _checked(actors)
    order = np.argsort((poses[:, :3, 3] - scene.origin) @ pose[2, :3], kind="stable")
    poses, sizes = poses[order], sizes[order]
    corners = (CORNERS * sizes[:, None, :]) @ poses[:, :3, :3].transpose(0, 2, 1) + (
        poses[:, :3, 3] - scene.origin
    )[:, None, :]
    uncut = (corners @ pose[2, :3] + pose[2, 3]).min(axis=1, initial=np.inf) > style.near_m
    shades = [style.box_colours[box_class(actors[i].label)] for i in order]
    colours = np.array([(0.0, *front, *back) for front, back in shades], dtype=np.float64).reshape(
        -1, 7
    )
    n = len(TRIANGLES)
    # Tiled once, an array keeps the order of its index; the kernel would be compiled for that order
    # as well.
    shade = np.ascontiguousarray(np.tile((0.5 - CORNERS[:, 0])[TRIANGLES], (len(actors), 1)))
    faces = Triangles(
        corners[:, TRIANGLES].reshape(-1, 3, 3),
        np.repeat(uncut, n),
        shade,
        np.repeat(colours, n, axis=0),
    )
    edge = np.array(
        (style.box_edge_px, 1.0, style.edge_bias_m, *style.colours["box_edge"]), dtype=np.float64
    )
    ends = corners[:, EDGES].reshape(-1, 2, 3)
    return faces, Segments(ends, np.tile(edge, (len(ends), 1)), _NO_SPHERES)


def _checked(actors: Sequence[ActorBox]) -> tuple[F64, F64]:
    """Return poses ``(A, 4, 4)`` and sizes ``(A, 3)``, all checked at once; box by box only for the
    error message.
    """
    sizes = np.array(
        [(a.box.length_m, a.box.width_m, a.box.height_m) for a in actors], dtype=np.float64
    ).reshape(-1, 3)
    if all(np.shape(actor.T_world_box) == (4, 4) for actor in actors):
        poses = np.array([actor.T_world_box for actor in actors], dtype=np.float64).reshape(
            -1, 4, 4
        )
        if all_rigid(poses) and np.isfinite(sizes).all() and (sizes >= 0).all():
            return poses, sizes
    for actor in actors:
        require_box(f"actor box ({actor.label})", actor.T_world_box, actor.box)
    return np.stack([actor.T_world_box for actor in actors]), sizes


def _strokes(
    static: Segments, edges: Segments, pose: F64, lens: KernelCamera, view: F64
) -> tuple[int, int, F64]:
    """Project static lines and box edges; returns the number of the first, of all, and their
    array.
    """
    while True:
        out = _buffers.strokes
        first = project_strokes(
            static.ends, static.style, static.spheres, pose, lens.params, lens.table, view, out, 0
        )
        count = project_strokes(
            edges.ends, edges.style, edges.spheres, pose, lens.params, lens.table, view, out, first
        )
        if count <= len(out):
            return int(first), int(count), out
        _buffers.strokes = np.empty((count + count // 4, STROKE))


def _shapes(
    static: Triangles, faces: Triangles, pose: F64, lens: KernelCamera, view: F64
) -> tuple[int, F64]:
    while True:
        out = _buffers.shapes
        count = project_shapes(
            static.corners,
            static.closed,
            static.shade,
            static.style,
            pose,
            lens.params,
            lens.table,
            view,
            out,
            0,
        )
        count = project_shapes(
            faces.corners,
            faces.closed,
            faces.shade,
            faces.style,
            pose,
            lens.params,
            lens.table,
            view,
            out,
            count,
        )
        if count <= len(out):
            return int(count), out
        _buffers.shapes = np.empty((count + count // 4, SHAPE))
