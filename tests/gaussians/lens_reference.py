"""Gaussians along the rays of a lens and a rolling shutter, in float64 and plain numpy: the definition of
what `rasterize_lens` draws (Wu et al., 3DGUT, CVPR 2025, arXiv 2412.12507, equations 9 to 11).

A Gaussian with mean p has its covariance S, and the pixel's: eps times that of a step of one pixel across
the line of sight at the distance |p|, and as much along it. Its response on a ray is exp(-q^2 / 2), with q
the least Mahalanobis distance of a place on the ray, from the ray's start on. A pixel's ray starts where the
camera is at the pixel's time. All are blended in the order of the largest of |x|, |y|, |z| of their means in
the camera's axes at the middle of the shutter, with the rules of the other rasterisers.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from alpasim_plugin.cameras.lens import radial_form
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.gaussians.constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    EPS2D_PX2,
    NEAR_M,
    TIME_STEPS,
    TRANSMITTANCE_STOP,
)
from alpasim_plugin.gaussians.lens_camera import lens_map
from alpasim_plugin.gaussians.sh import sh_colours

STEP_RAD = 1e-5


@dataclass
class Splats:
    """Gaussians of one node in the world's axes, as the camera at the middle of the shutter sees
    them.
    """

    p: np.ndarray  # (N, 3) mean in the camera's axes at the middle
    S: np.ndarray  # (N, 3, 3)
    opacity: np.ndarray
    rgb: np.ndarray
    distance: np.ndarray  # (N,) at the time of the mean's pixel
    node: np.ndarray  # (N,) which of the nodes it is of


class Motion:
    """Where a body is at a time of the shutter: linear in position, even in rotation.

    Args:
        T_middle, T_start: ``T_world_body`` at the middle and the start.
    """

    def __init__(self, T_middle, T_start):
        self.T = np.asarray(T_middle, dtype=np.float64)
        self.speed = 2 * (self.T[:3, 3] - T_start[:3, 3])
        half = Rotation.from_matrix(self.T[:3, :3] @ T_start[:3, :3].T)
        self.turn = 2 * half.as_rotvec()

    def at(self, time):
        """Return ``T_world_body`` at a time from -0.5 to 0.5."""
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(time * self.turn).as_matrix() @ self.T[:3, :3]
        T[:3, 3] = self.T[:3, 3] + time * self.speed
        return T


class LensReference:
    """A scene seen through a lens.

    Args:
        nodes: ``(cloud, T_world_node)`` pairs, as of `rasterize_prepared`.
        camera: A `LensCamera`.
        starts: Poses of the nodes at the start of the shutter.
    """

    def __init__(self, nodes, camera, starts=(), near_m=NEAR_M):
        self.camera = camera
        self.form = radial_form(camera.spec)
        T_start = camera.T_camera_world
        if camera.rolling is not None:
            T_start = camera.rolling.T_camera_world_start
        self.body = Motion(inverse(camera.T_camera_world), inverse(T_start))
        poses = [np.eye(4) if T is None else T for _, T in nodes]
        starts = starts or [None] * len(nodes)
        self.nodes = [
            Motion(T, T if start is None else start) for T, start in zip(poses, starts, strict=True)
        ]
        parts = [self._splats(cloud, number) for number, (cloud, _) in enumerate(nodes)]
        joined = [np.concatenate([vars(part)[name] for part in parts]) for name in vars(parts[0])]
        splats = Splats(*joined)
        key = np.abs(splats.p).max(axis=1).astype(np.float32)
        order = np.argsort(key, kind="stable")
        near = np.linalg.norm(splats.p, axis=1) >= near_m
        order = order[(near & (splats.opacity >= ALPHA_MIN))[order]]
        self.splats = Splats(*(value[order] for value in vars(splats).values()))
        self.W = np.linalg.inv(np.linalg.cholesky(self.splats.S))

    def time(self, pixels):
        """Return when pixels ``(N, 2)`` are exposed, from -0.5 to 0.5."""
        if self.camera.rolling is None:
            return np.zeros(len(pixels))
        a, b, c = self.camera.rolling.time
        return np.clip(a * pixels[:, 0] + b * pixels[:, 1] + c, -0.5, 0.5)

    def _splats(self, cloud, number):
        node = self.nodes[number]
        T = inverse(self.body.T) @ node.T
        means = cloud.means.astype(np.float64)
        p = means @ T[:3, :3].T + T[:3, 3]
        seen = p if self.camera.rolling is None else self._at_their_times(means, node, p)
        factor = T[:3, :3] @ (cloud.rotations() * cloud.scales.astype(np.float64)[:, None, :])
        S = factor @ factor.transpose(0, 2, 1)
        steps, tangents = self._pixel_steps(seen)
        n2 = (seen**2).sum(axis=1)
        eps = cloud.antialias_px2 or EPS2D_PX2
        opacity = cloud.opacities.astype(np.float64)
        if cloud.antialias_px2:
            in_plane = tangents @ S @ tangents.transpose(0, 2, 1)
            to_pixels = np.linalg.inv(steps @ tangents.transpose(0, 2, 1)).transpose(0, 2, 1)
            image = to_pixels @ in_plane @ to_pixels.transpose(0, 2, 1) / n2[:, None, None]
            raw = np.maximum(np.linalg.det(image), 0)
            opacity = opacity * np.sqrt(raw / np.linalg.det(image + eps * np.eye(2)))
        across = np.einsum("nki,nkj->nij", steps, steps)
        along = 0.5 * (steps**2).sum(axis=(1, 2))
        S = S + eps * n2[:, None, None] * across
        S = S + eps * along[:, None, None] * seen[:, :, None] * seen[:, None, :]
        centre = inverse(node.T) @ self.body.T[:, 3]
        offset = means - centre[:3]
        rgb = sh_colours(cloud.sh, offset / np.linalg.norm(offset, axis=1, keepdims=True))
        index = np.full(len(cloud), number)
        return Splats(p, S, opacity, rgb, np.sqrt(n2), index)

    def _at_their_times(self, means, node, p):
        """Return where means are in the camera's axes at the time of their pixels."""
        seen = p
        for _ in range(TIME_STEPS):
            times = self.time(self._exact_pixel(self._held(seen)))
            T = np.array([inverse(self.body.at(time)) @ node.at(time) for time in times])
            seen = np.einsum("nij,nj->ni", T[:, :3, :3], means) + T[:, :3, 3]
        return seen

    def _held(self, p):
        """Return unit directions, turned to the edge of what is described where they lie beyond."""
        limit = 2 * np.arctan(np.sqrt(lens_map(self.camera.spec).s_most))
        unit = p / np.linalg.norm(p, axis=1, keepdims=True)
        angle = np.arctan2(np.linalg.norm(unit[:, :2], axis=1), unit[:, 2])
        held = np.minimum(angle, limit)
        across = unit[:, :2] / np.maximum(
            np.linalg.norm(unit[:, :2], axis=1, keepdims=True), 1e-300
        )
        return np.column_stack([across * np.sin(held)[:, None], np.cos(held)])

    def _exact_pixel(self, unit):
        form = self.form
        angle = np.arctan2(np.linalg.norm(unit[:, :2], axis=1), unit[:, 2])
        across = unit[:, :2] / np.maximum(
            np.linalg.norm(unit[:, :2], axis=1, keepdims=True), 1e-300
        )
        plane = across * form.radius(angle)[:, None]
        if any(form.bent):
            p1, p2, s1, s2, s3, s4 = form.bent
            x, y = (unit[:, :2] / unit[:, 2:]).T
            r2 = x * x + y * y
            plane = plane + np.column_stack(
                [
                    2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s1 * r2 + s2 * r2 * r2,
                    p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + s3 * r2 + s4 * r2 * r2,
                ]
            )
        return plane @ form.linear.T + self.camera.spec.K[:2, 2]

    def _pixel_steps(self, p):
        """Return the two steps ``(N, 2, 3)`` across the line of sight, radians, by which the image
        changes by one pixel along u and along v, and the tangents that they are made of.
        """
        n = np.linalg.norm(p, axis=1, keepdims=True)
        h = p[:, :2] / np.maximum(n + p[:, 2:], 1e-7 * n)
        k = 2 / (1 + (h**2).sum(axis=1))
        right = np.column_stack([1 - k * h[:, 0] ** 2, -k * h[:, 0] * h[:, 1], -k * h[:, 0]])
        down = np.column_stack([-k * h[:, 0] * h[:, 1], 1 - k * h[:, 1] ** 2, -k * h[:, 1]])
        tangents = np.stack([right, down], axis=1)
        held = self._held(p)
        # Differences of the lens itself, at the held direction, along its own tangents.
        g = held[:, :2] / (1 + held[:, 2:])
        kk = 2 / (1 + (g**2).sum(axis=1))
        own = np.stack(
            [
                np.column_stack([1 - kk * g[:, 0] ** 2, -kk * g[:, 0] * g[:, 1], -kk * g[:, 0]]),
                np.column_stack([-kk * g[:, 0] * g[:, 1], 1 - kk * g[:, 1] ** 2, -kk * g[:, 1]]),
            ],
            axis=1,
        )
        by = []
        for axis in range(2):
            step = STEP_RAD * own[:, axis]
            by.append(
                (self._exact_pixel(held + step) - self._exact_pixel(held - step)) / (2 * STEP_RAD)
            )
        jacobian = np.stack(by, axis=2)  # (N, pixel, tangent)
        inverse_jacobian = np.linalg.inv(jacobian)  # (N, tangent, pixel)
        return np.einsum("ntp,nti->npi", inverse_jacobian, tangents), tangents

    def ray(self, row, column, node):
        """Return start and direction of a pixel's ray in the camera's axes at the middle, as it
        meets a node that is where it is at the middle.
        """
        time = self.time(np.array([[column + 0.5, row + 0.5]]))[0]
        d = self.camera.rays()[row, column]
        motion = self.nodes[node]
        T = inverse(self.body.T) @ motion.T @ inverse(motion.at(time)) @ self.body.at(time)
        return T[:3, 3], T[:3, :3] @ d

    def alphas(self, row, column):
        """Return the opacities of all Gaussians, nearest first, at a pixel."""
        o, d = np.empty((2, len(self.splats.p), 3))
        for node in range(len(self.nodes)):
            here = self.splats.node == node
            o[here], d[here] = self.ray(row, column, node)
        x = np.einsum("nij,nj->ni", self.W, o - self.splats.p)
        e = np.einsum("nij,nj->ni", self.W, d)
        along = np.maximum(-(x * e).sum(axis=1) / (e * e).sum(axis=1), 0.0)
        q2 = ((x + along[:, None] * e) ** 2).sum(axis=1)
        return np.minimum(ALPHA_MAX, self.splats.opacity * np.exp(-0.5 * q2))

    def pixel(self, row, column):
        """Return colour without background, alpha and mean distance of a pixel."""
        if not self.camera.visible[row, column]:
            return np.zeros(3), 1.0, 0.0
        alphas = self.alphas(row, column)
        colour = np.zeros(3)
        through = 1.0
        depth = 0.0
        for i in np.flatnonzero(alphas >= ALPHA_MIN):
            after = through * (1 - alphas[i])
            if after <= TRANSMITTANCE_STOP:
                break
            colour += through * alphas[i] * self.splats.rgb[i]
            depth += through * alphas[i] * self.splats.distance[i]
            through = after
        alpha = 1 - through
        return colour, alpha, depth / alpha if alpha > 0 else 0.0

    def image(self):
        """Return `pixel` of all pixels through a global shutter: ``(H, W, 3)``, and ``(H, W)`` twice."""
        x = np.einsum("nij,nj->ni", self.W, -self.splats.p)
        e = np.einsum("nij,hwj->hwni", self.W, self.camera.rays())
        along = np.maximum(-(e * x).sum(axis=-1) / (e * e).sum(axis=-1), 0.0)
        q2 = ((x + along[..., None] * e) ** 2).sum(axis=-1)
        alphas = np.minimum(ALPHA_MAX, self.splats.opacity * np.exp(-0.5 * q2))
        alphas = np.where((alphas >= ALPHA_MIN) & self.camera.visible[..., None], alphas, 0.0)
        through = np.cumprod(1 - alphas, axis=2)
        before = np.concatenate([np.ones_like(through[..., :1]), through[..., :-1]], axis=2)
        weights = np.where(through > TRANSMITTANCE_STOP, before * alphas, 0.0)
        alpha = weights.sum(axis=2)
        depth = weights @ self.splats.distance / np.where(alpha > 0, alpha, 1.0)
        return weights @ self.splats.rgb, np.where(self.camera.visible, alpha, 1.0), depth


def least_distance_along(S, p, o, d, far_m):
    """Return the least Mahalanobis distance, squared, of places of a ray, looked for along it."""
    W = np.linalg.inv(S)
    s = np.linspace(0.0, far_m, 2001)
    for _ in range(12):
        x = o + s[:, None] * d - p
        q2 = np.einsum("ni,ij,nj->n", x, W, x)
        best = int(q2.argmin())
        step = s[1] - s[0]
        s = np.linspace(max(s[best] - step, 0.0), s[best] + step, 2001)
    return float(q2.min())
