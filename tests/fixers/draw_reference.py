"""Reference implementation of the semantic map, which the fast kernels are compared with.

Lines and triangles are halved until their pieces are short and seen under a small angle; every
point is projected by the exact formula in float64. Then every pixel is tested against each stroke
and shape: no bands, no shortcuts.

- A stroke covers a sample when the sample's distance to the line, measured with vertical pixels
  stretched, is at most the radius that the line has at the point nearest to the pixel's centre.
  1/depth is linear along a stroke and over a shape.
- Colour and depth of a stroke belong to the pixel, depth of a shape to the sample. The nearer wins;
  of equals the one drawn first.
- Colours fade with ``clamp(1 - depth / depth_max)``, half widths alike.
"""

import numpy as np

from alpasim_plugin.core.geometry import transform_points
from alpasim_plugin.fixers.semantic_map.draw import actor_geometry, view_of
from alpasim_plugin.fixers.semantic_map.kernels import (
    BACK,
    BIAS,
    FARTHEST,
    FRONT,
    HALF,
    NEAREST,
    RED,
    S_BIAS,
    SHAPE,
    STROKE,
)
from alpasim_plugin.fixers.semantic_map.raster import SAMPLES
from alpasim_plugin.fixers.semantic_map.style import DEPTH_MAX_M, NEAR_M, WIDTH_DEFINED_AT_PX


def draw_map_reference(
    scene,
    camera,
    T_world_camera,
    actors=(),
    *,
    step_m=2.0,
    angle_rad=0.05,
):
    """Draw what `alpasim_plugin.fixers.semantic_map.draw.draw_map` draws, from points at most
    ``step_m`` and ``angle_rad`` apart.

    Raises:
        InputError: As the fast one.
    """
    _, pose = view_of(scene, camera, T_world_camera)
    T_camera_scene = np.vstack([pose, [0.0, 0.0, 0.0, 1.0]])
    faces, edges = actor_geometry(actors, scene, pose)
    first = strokes_reference(scene.segments, T_camera_scene, camera, step_m, angle_rad)
    strokes = np.concatenate(
        [first, strokes_reference(edges, T_camera_scene, camera, step_m, angle_rad)]
    )
    shapes = [
        shapes_reference(part, T_camera_scene, camera, step_m, angle_rad)
        for part in (scene.triangles, faces)
    ]
    return draw_reference(strokes, len(first), np.concatenate(shapes), camera)


def project_points(camera, points):
    """Project camera-frame points ``(N, 3)``, metres, to pixels ``(N, 2)``; NaN behind the camera."""
    x, y, z = points.T
    z = np.where(z > 0, z, np.nan)
    k = camera.K
    u = k[0, 0] * x / z + k[0, 1] * y / z + k[0, 2]
    return np.stack([u, k[1, 1] * y / z + k[1, 2]], axis=1)


def strokes_reference(
    segments,
    T_camera_scene,
    camera,
    step_m,
    angle_rad,
):
    """Cut segments into short strokes ``(N, STROKE)``, clipped at the near and the far plane."""
    rows = [np.zeros((0, STROKE))]
    for ends, (width_px, *look) in zip(segments.ends, segments.style, strict=True):
        a, b = transform_points(T_camera_scene, ends)
        inside = [0.0, 1.0]
        if a[2] != b[2]:
            crossings = sorted(
                ((NEAR_M - a[2]) / (b[2] - a[2]), (DEPTH_MAX_M - a[2]) / (b[2] - a[2]))
            )
            inside = [max(0.0, crossings[0]), min(1.0, crossings[1])]
        elif not NEAR_M <= a[2] < DEPTH_MAX_M:
            continue
        if inside[0] > inside[1]:
            continue
        points = _along(a + inside[0] * (b - a), a + inside[1] * (b - a), step_m, angle_rad)
        points[:, 2] = np.maximum(points[:, 2], NEAR_M)
        seen = np.column_stack([project_points(camera, points), 1.0 / points[:, 2]])
        half = width_px / 2 * camera.width / WIDTH_DEFINED_AT_PX
        rows.append(
            np.column_stack([seen[:-1], seen[1:], np.tile((half, *look), (len(points) - 1, 1))])
        )
    return np.concatenate(rows)


def shapes_reference(
    triangles,
    T_camera_scene,
    camera,
    side_m,
    angle_rad,
):
    """Cut triangles into small shapes ``(N, SHAPE)``, clipped at the near plane."""
    rows = [np.zeros((0, SHAPE))]
    for corners, shade, look in zip(
        triangles.corners, triangles.shade, triangles.style, strict=True
    ):
        polygon = clip_reference(
            np.column_stack([transform_points(T_camera_scene, corners), shade]), NEAR_M
        )
        for k in range(1, len(polygon) - 1):
            for piece in _cut(polygon[[0, k, k + 1]], side_m, angle_rad):
                seen = np.column_stack(
                    [
                        project_points(camera, piece[:, :3]),
                        1.0 / piece[:, 2],
                        piece[:, 3] / piece[:, 2],
                    ]
                )
                inverse = 1.0 / piece[:, 2]
                rows.append(np.array([[*seen.ravel(), inverse.max(), inverse.min(), *look]]))
    return np.concatenate(rows)


def clip_reference(polygon, near_m):
    """Return the part of a convex polygon ``(N, 3+)`` with z of at least ``near_m``; further
    columns are interpolated.
    """
    out = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if a[2] >= near_m:
            out.append(a)
        if (a[2] >= near_m) != (b[2] >= near_m):
            crossing = a + (near_m - a[2]) / (b[2] - a[2]) * (b - a)
            crossing[2] = near_m
            out.append(crossing)
    return np.array(out).reshape(-1, polygon.shape[1])


def _short(a, b, side_m, angle_rad):
    """Tell whether a piece between two camera-frame points is short enough to be taken as straight
    in any image.
    """
    nearest_m = min(float(np.linalg.norm(a[:3])), float(np.linalg.norm(b[:3])))
    return bool(np.linalg.norm((b - a)[:3]) <= min(side_m, angle_rad * nearest_m))


def _along(a, b, side_m, angle_rad):
    """Return points ``(N, 3)`` from a to b."""
    if _short(a, b, side_m, angle_rad):
        return np.stack([a, b])
    middle = (a + b) / 2
    return np.concatenate(
        [_along(a, middle, side_m, angle_rad)[:-1], _along(middle, b, side_m, angle_rad)]
    )


def _cut(triangle, side_m, angle_rad):
    """Halve a triangle at its longest side until all sides are short."""
    k = int(
        np.argmax([np.linalg.norm((triangle[i] - triangle[i - 2])[:3]) for i in range(3)])
    )  # the side from k to k + 1
    a = triangle[k]
    b = triangle[k - 2]
    c = triangle[k - 1]
    if all(_short(p, q, side_m, angle_rad) for p, q in ((a, b), (b, c), (c, a))):
        return [triangle]
    middle = (a + b) / 2
    return _cut(np.stack([a, middle, c]), side_m, angle_rad) + _cut(
        np.stack([middle, b, c]), side_m, angle_rad
    )


def draw_reference(strokes, n_first, shapes, camera):
    """Draw strokes before ``n_first``, then all shapes, then the other strokes."""
    depth = np.zeros((camera.height, camera.width, len(SAMPLES)), np.float32)
    colour = np.zeros((camera.height, camera.width, len(SAMPLES), 3))
    stretch = camera.width / camera.height
    for stroke in strokes[:n_first]:
        _stroke(stroke, stretch, depth, colour)
    for shape in shapes:
        _shape(shape, depth, colour)
    for stroke in strokes[n_first:]:
        _stroke(stroke, stretch, depth, colour)
    mean = (colour.sum(axis=2) + len(SAMPLES) // 2) // len(SAMPLES)
    return np.asarray(mean, dtype=np.uint8)


def _window(low, high, depth):
    """Return the rows, the columns and the centres ``(h, w, 2)`` of the pixels in a box of the
    image; None outside it.
    """
    height, width = depth.shape[:2]
    x0, y0 = np.clip(np.floor(low) - 1, 0, (width, height)).astype(int)
    x1, y1 = np.clip(np.ceil(high) + 1, 0, (width, height)).astype(int)
    if x0 >= x1 or y0 >= y1:
        return None
    x, y = np.meshgrid(np.arange(x0, x1) + 0.5, np.arange(y0, y1) + 0.5)
    return slice(y0, y1), slice(x0, x1), np.stack([x, y], axis=-1)


def _stroke(stroke, stretch, depth, colour):
    square = np.array([1.0, stretch])
    a, b = stroke[0:2], stroke[3:5]
    reach = stroke[HALF] / square
    window = _window(np.minimum(a, b) - reach, np.maximum(a, b) + reach, depth)
    if window is None:
        return
    rows, columns, centre = window
    along = (b - a) * square
    length2 = along @ along

    def nearest(points):
        """Return the part along the line nearest to points ``(..., 2)``, and the squared
        distance.
        """
        offset = (points - a) * square
        t = (
            np.clip(offset @ along / length2, 0.0, 1.0)
            if length2 > 0
            else np.zeros(offset.shape[:-1])
        )
        rest = offset - t[..., None] * along
        return t, np.sum(rest * rest, axis=-1)

    t, _ = nearest(centre)
    inverse = stroke[2] + t * (stroke[5] - stroke[2])
    fade = np.maximum(0.0, 1.0 - 1.0 / (inverse * DEPTH_MAX_M))
    radius = stroke[HALF] * fade
    covered = np.stack([nearest(centre + offset)[1] <= radius**2 for offset in SAMPLES], axis=-1)
    here = inverse / np.maximum(1.0 - stroke[BIAS] * inverse, 1e-3)
    painted = np.floor(stroke[RED : RED + 3] * fade[..., None] + 0.5)
    _put(
        covered,
        np.broadcast_to(here[..., None], covered.shape),
        painted,
        depth[rows, columns],
        colour[rows, columns],
    )


def _shape(shape, depth, colour):
    corners = shape[:12].reshape(3, 4)
    xy = corners[:, :2]
    window = _window(xy.min(axis=0), xy.max(axis=0), depth)
    edge = np.column_stack([np.ones(3), xy])
    if window is None or np.linalg.det(edge) == 0.0:
        return
    rows, columns, centre = window
    to_parts = np.linalg.inv(edge)  # [1, x, y] -> barycentric coordinates

    def parts(points):
        return np.asarray(to_parts[0] + points @ to_parts[1:])

    middle = parts(centre)
    inverse = np.clip(middle @ corners[:, 2], shape[FARTHEST], shape[NEAREST])
    fade = np.maximum(0.0, 1.0 - 1.0 / inverse / DEPTH_MAX_M)
    back = np.clip(middle @ corners[:, 3] / inverse, 0.0, 1.0)[..., None]
    painted = np.floor(
        (shape[FRONT : FRONT + 3] * (1 - back) + shape[BACK : BACK + 3] * back) * fade[..., None]
        + 0.5
    )
    at_samples = np.stack([parts(centre + offset) for offset in SAMPLES], axis=-2)
    here = np.clip(at_samples @ corners[:, 2], shape[FARTHEST], shape[NEAREST])
    here = here / np.maximum(1.0 - shape[S_BIAS] * here, 1e-3)
    _put(
        np.all(at_samples >= 0, axis=-1), here, painted, depth[rows, columns], colour[rows, columns]
    )


def _put(covered, inverse, painted, depth, colour):
    """Write covered samples ``(h, w, n)`` that are nearer than what is there; ``depth`` and
    ``colour`` are views of the buffers.
    """
    wins = covered & (inverse.astype(np.float32) > depth)
    depth[wins] = inverse[wins]
    colour[wins] = np.broadcast_to(painted[:, :, None, :], colour.shape)[wins]
