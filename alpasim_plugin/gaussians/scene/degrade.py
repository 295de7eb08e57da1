"""Surrogate of a bad reconstruction: seeded errors that grow with the distance from the logged
path.

Nothing is trained here. A reconstruction from one drive is right where its cameras were and wrong
elsewhere, and this module models the causes one by one (fact sheet on splatting, section 9):
surfaces that no log camera saw are missing; depth along the log cameras' rays is uncertain, so
Gaussians slide along those rays, with their size, and look right from the log only; some slide far
and become floaters; the log's poses are centimetres off, so the road sways; thin structures such as
lane paint are fitted late, so stretches of them are lost; Gaussians are too large, lose view
dependence and change colour; moving actors are blurred, incomplete and doubled; exposure and white
balance drift from frame to frame.

Every amount is ``severity * (on + off * w)``: a small part that is there on the path (mild
softness) and a part that grows with ``w``, 0 within ``onset_m`` of the path and 1 beyond
``full_m``. ``w`` is quantised to `STEPS` so that clouds are prepared once per step. Random numbers
belong to (scene, seed, part of the scene), never to ``w``: moving away makes the same faults
larger, not others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from alpasim_plugin.core.geometry import arc_lengths, interpolate, project, resample, se3
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F32, F64, Degradation, Scenario
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.scene.log_views import LogView, LogViews
from alpasim_plugin.gaussians.scene.scene_graph import SceneNode
from alpasim_plugin.gaussians.scene.site import left_of, unit
from alpasim_plugin.gaussians.sh import C0, C1

STEPS = 8
BEHIND_M = 6.0  # a Gaussian's log camera is the one this far before it
KNOT_US = 400_000  # spacing of the drift of exposure and poses
SWAY_M, SWAY_ON = (
    0.32,
    0.35,
)  # sideways error of the log's poses when full, and its share on the path
THIN_M = (
    0.075  # Gaussians thinner than this are detail that is fitted late: lane paint, poles, rails
)
LOST_ABOVE, LOST_OFF = (
    0.5,
    0.7,
)  # thin structures are lost where a field of unit spread exceeds the first, less the second times w
GHOST = "~ghost"


class _Recipe(NamedTuple):
    """A cloud and its faults: ``x_on`` is there on the path, ``x_off`` is added in proportion to
    ``w``.
    """

    cloud: GaussianCloud  # Gaussians that the log saw, colours flattened and tinted
    ray: F32  # (N, 3) from the log camera, metres
    shift_on: F32  # (N,) share of the ray
    shift_off: F32
    sway: F32  # (N, 3) sideways error of the log's poses, metres at full amount
    grow_on: F32  # (N,) logarithm of the size factor
    grow_off: F32
    fade: F32  # (N,) 0..1
    tint_off: F32  # (N, 1, 3) change of the constant colour coefficient
    missing_from: F32  # (N,) the w from which it is missing


class Surrogate:
    """Degrade the parts of one scene.

    Args:
        scenario: Gives the logged path, the amounts and the seed of the reconstruction (the scene's
            own: a reconstruction does not change from rollout to rollout).
        views: What the log cameras saw; Gaussians that none of them saw are missing.
    """

    def __init__(self, scenario: Scenario, views: Sequence[LogView]) -> None:
        self.scenario, self.views = scenario, LogViews(views)
        self.amount: Degradation = scenario.degradation
        path = scenario.ego_log.xyz
        length = float(arc_lengths(path)[-1])
        camera = (
            scenario.cameras[0].T_rig_camera[:3, 3]
            if scenario.cameras
            else np.array([1.5, 0.0, 1.5])
        )
        self._line = (
            resample(path, np.linspace(0.0, length, max(2, int(length) + 1)))
            if length > 0
            else np.repeat(path[:1], 2, axis=0)
        )
        self._eyes = self._line + np.array([0.0, 0.0, camera[2]])
        self._sway = _sway(scenario, self._line)
        self._tree = scipy.spatial.KDTree(self._line[:, :2])
        self._reach = extended(path, scenario.ego_log.quat[0])
        self._recipes: dict[tuple[str, int], _Recipe] = {}

    def weight(self, T_world_rig: F64) -> float:
        """Return ``w`` of a rig pose, 0..1, in steps of ``1 / STEPS``."""
        lateral = abs(project(self._reach, T_world_rig[:2, 3])[1])
        span = max(self.amount.full_m - self.amount.onset_m, 1e-9)
        return float(
            np.round(np.clip((lateral - self.amount.onset_m) / span, 0.0, 1.0) * STEPS) / STEPS
        )

    def background(
        self, node: SceneNode, level: int, cloud: GaussianCloud, w: float
    ) -> GaussianCloud:
        """Degrade one level of a background node."""
        r = self._recipe(node, level, cloud)
        s = self.amount.severity
        keep = np.flatnonzero(r.missing_from > w)
        kept, shift = (
            r.cloud.take(keep),
            np.clip((r.shift_on + w * r.shift_off)[keep], -0.75, 1.5)[:, None],
        )
        grow = (1 + shift) * np.exp(r.grow_on + w * r.grow_off)[keep, None]
        return GaussianCloud(
            kept.means + r.ray[keep] * shift + (SWAY_ON + (1 - SWAY_ON) * w) * r.sway[keep],
            kept.quats,
            kept.scales * grow,
            kept.opacities * (1 - np.float32(min(s * w, 1.5)) * 0.25 * r.fade[keep]),
            kept.sh + np.float32(w) * r.tint_off[keep],
        )

    def _recipe(self, node: SceneNode, level: int, cloud: GaussianCloud) -> _Recipe:
        """Draw everything about a cloud's faults that does not depend on ``w``; kept, because ``w``
        changes while driving.
        """
        key = (node.name, level)
        if key in self._recipes:
            return self._recipes[key]
        n, s = len(cloud), self.amount.severity
        rng = stream(self.scenario.scene_id, self.scenario.seed, f"degrade/{node.name}/{level}")
        draw, normal = (
            rng.random((n, 5), dtype=np.float32),
            rng.standard_normal((n, 3), dtype=np.float32),
        )
        # Depth errors: an own part per Gaussian, a part shared by a neighbourhood, and a few that
        # slide far and become floaters.
        ray, place, sway = self._rays(cloud.means.astype(np.float64))
        smooth = _wave(place, self.scenario, "degrade/depth-field")
        own = 0.35 * normal[:, 0] + np.where(draw[:, 0] < 0.12, normal[:, 1], 0.0)
        floater = draw[:, 1] < 0.02 * min(s, 2.0)
        shift_on = s * (0.012 * own + 0.004 * smooth)
        shift_off = s * (0.085 * own + 0.10 * smooth) - np.where(
            floater, s * (0.25 + 0.4 * draw[:, 2]), 0.0
        )
        blotch = _wave(place * 1.7 + 31.0, self.scenario, "degrade/colour-field")[
            :, None
        ] * np.array([1.0, 0.6, -0.8])
        rgb = flattened(cloud.sh)[:, 0] * C0 + 0.5
        tint_on, tint_off = (
            s * (a * rgb * normal[:, 2:3] + b * blotch) for a, b in ((0.03, 0.008), (0.05, 0.022))
        )
        patchy = _wave(place * 0.6 + 77.0, self.scenario, "degrade/missing-field")
        missing_from = draw[:, 3] / np.maximum(s * np.clip(0.10 + 0.30 * patchy, 0.02, 0.7), 1e-9)
        thin = np.sort(cloud.scales, axis=1)[:, 1] < THIN_M
        lost_from = (
            LOST_ABOVE / s
            - _wave(place * 0.5, self.scenario, "degrade/thin-field")
            - 0.2 * normal[:, 0]
        ) / LOST_OFF
        missing_from = np.where(thin, np.minimum(missing_from, lost_from), missing_from)
        seen = self.views.see(
            cloud.means.astype(np.float64), cloud.scales.max(axis=1).astype(np.float64)
        )
        unseen = ~seen & (draw[:, 2] < 0.95 * min(s, 1.0))
        keep = np.flatnonzero(~unseen)
        sh = ((np.clip(rgb + tint_on, 0, 1) - 0.5) / C0)[:, None, :].astype(np.float32)
        flat = replace(cloud, sh=sh)
        columns = (
            ray,
            shift_on,
            shift_off,
            s * sway,
            s * (0.14 + 0.10 * draw[:, 4]),
            s * (0.25 * draw[:, 4] + 0.12) + np.where(floater, 0.6, 0.0),
            draw[:, 2],
            (tint_off / C0)[:, None, :],
            missing_from,
        )
        recipe = _Recipe(flat.take(keep), *(column[keep].astype(np.float32) for column in columns))
        self._recipes[key] = recipe
        return recipe

    def actor(self, node: SceneNode, level: int, cloud: GaussianCloud, w: float) -> GaussianCloud:
        """Degrade one level of an actor: soft, incomplete, without sheen; ghosts are fainter."""
        n, s = len(cloud), self.amount.severity
        rng = stream(self.scenario.scene_id, self.scenario.seed, f"degrade/{node.name}/{level}")
        draw, normal = rng.random((n, 2)), rng.standard_normal((n, 3))
        ghost = node.name.endswith(GHOST)
        size = cloud.scales.max(axis=1, keepdims=True)
        opacity = cloud.opacities * (
            min(0.55, s * (0.05 + 0.40 * w))
            if ghost
            else 1 - min(0.6, s * (0.02 + 0.30 * w)) * draw[:, 1]
        )
        out = GaussianCloud(
            cloud.means + s * (0.15 + 0.9 * w) * size * normal,
            cloud.quats,
            (cloud.scales * np.exp(s * (0.12 + 0.45 * w) * (0.5 + draw[:, 1:]))).astype(np.float32),
            opacity.astype(np.float32),
            flattened(cloud.sh),
        )
        return out.take(np.flatnonzero(draw[:, 0] >= s * (0.03 + 0.30 * w)))

    def pose(self, actor_id: str, T_world_box: F64, t_us: int, seed: int, w: float) -> F64:
        """Return the pose at which the reconstruction puts an actor: tracks are a little off, and
        more so seen from aside.
        """
        s = self.amount.severity
        off = temporal_noise(self.scenario.scene_id, seed, f"degrade/pose/{actor_id}", t_us, 3)
        x, y = s * (0.03 + 0.22 * w) * off[0], s * (0.02 + 0.16 * w) * off[1]
        yaw = s * (0.008 + 0.05 * w) * off[2]
        move = se3([x, y, 0.0], [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
        return np.asarray(T_world_box @ move)

    def ghost_pose(self, actor_id: str, T_world_box: F64, t_us: int, seed: int, w: float) -> F64:
        """Return the pose of an actor's ghost: it trails behind along the actor's axis."""
        late = (
            0.35
            + 0.9 * w
            + 0.25
            * float(
                temporal_noise(self.scenario.scene_id, seed, f"degrade/ghost/{actor_id}", t_us, 1)[
                    0
                ]
            )
        )
        move = np.eye(4)
        move[0, 3] = -self.amount.severity * late
        return np.asarray(self.pose(actor_id, T_world_box, t_us, seed, w) @ move)

    def gain(self, t_us: int, seed: int, w: float) -> F32:
        """Return the factors ``(3,)`` of this frame's exposure and white balance."""
        s = self.amount.severity
        off = temporal_noise(self.scenario.scene_id, seed, "degrade/exposure", t_us, 4)
        return np.asarray(
            np.exp(s * ((0.02 + 0.07 * w) * off[0] + (0.006 + 0.022 * w) * off[1:])),
            dtype=np.float32,
        )

    def _rays(self, means: F64) -> tuple[F64, F64, F64]:
        """Return, per Gaussian, the vector from its log camera ``(N, 3)``, its plan position ``(N,
        2)`` and its sway ``(N, 3)``, metres.
        """
        distance, i = self._tree.query(means[:, :2])
        back = np.round(np.maximum(BEHIND_M, 0.8 * distance)).astype(np.int64)
        eye = self._eyes[np.clip(i - back, 0, len(self._eyes) - 1)]
        return means - eye, means[:, :2] - self._line[0, :2], self._sway[i]


def flattened(sh: npt.NDArray[np.floating]) -> F32:
    """Return colours ``(N, 1, 3)`` without view dependence: the mean over the views from outside.

    A sheen that grows away from the normal n is ``add * (1 + d . n)``; over the hemisphere of
    views, weighted by the area seen, ``d . n`` averages -2/3.
    """
    if sh.shape[1] == 1:
        return sh.astype(np.float32)
    add = C1 * np.linalg.norm(sh[:, 1:4], axis=1)
    return np.asarray(sh[:, :1] - (2.0 / 3.0) * (add / C0)[:, None, :], dtype=np.float32)


def extended(path: F64, quat: F64, by_m: float = 200.0) -> F64:
    """Return the path ``(N, 3)`` with straight ends, so that a pose beyond an end is judged by its
    lateral distance only.
    """
    first = np.array(
        [1 - 2 * (quat[2] ** 2 + quat[3] ** 2), 2 * (quat[1] * quat[2] + quat[0] * quat[3]), 0.0]
    )
    s = arc_lengths(path)
    if s[-1] < 1.0:
        return np.stack([path[0] - by_m * first, path[0] + by_m * first])
    ends = resample(path, [0.0, min(1.0, s[-1]), max(0.0, s[-1] - 1.0), s[-1]])
    start, stop = ends[0] - ends[1], ends[3] - ends[2]
    keep = np.concatenate([[True], np.diff(s) > 0])
    return np.concatenate(
        [
            [path[0] + by_m * start / np.linalg.norm(start)],
            path[keep],
            [path[-1] + by_m * stop / np.linalg.norm(stop)],
        ]
    )


def temporal_noise(scene_id: str, seed: int, component: str, t_us: int, n: int) -> F64:
    """Return ``(n,)`` numbers of about unit spread that vary with time and depend on nothing but
    the key and ``t_us``.
    """
    knot, part = divmod(int(t_us), KNOT_US)
    f = part / KNOT_US
    return (
        _knot(scene_id, seed, component, knot, n) * (1 - f)
        + _knot(scene_id, seed, component, knot + 1, n) * f
    )


@lru_cache(maxsize=4096)
def _knot(scene_id: str, seed: int, component: str, knot: int, n: int) -> F64:
    return stream(scene_id, seed, component, knot).standard_normal(n)


def _wave(at: F64, scenario: Scenario, component: str) -> F32:
    """Return a smooth random field of about unit spread at ground points ``(N, 2)``: waves of 3 to
    12 m in random directions.
    """
    rng = stream(scenario.scene_id, scenario.seed, component)
    x, y = at.astype(np.float32).T
    total = np.zeros(len(at), dtype=np.float32)
    for _ in range(8):
        angle = rng.uniform(0, 2 * np.pi)
        length = rng.uniform(3.0, 12.0)
        phase = rng.uniform(0, 2 * np.pi)
        k = 2 * np.pi / length
        total += np.sin(
            np.float32(k * np.cos(angle)) * x
            + np.float32(k * np.sin(angle)) * y
            + np.float32(phase)
        )
    return total * np.float32(0.5)


def _sway(scenario: Scenario, line: F64) -> F64:
    """Return the sideways error ``(M, 3)`` of the log's poses at points 1 m apart: smooth, waves of
    18 to 50 m, `SWAY_M` spread.
    """
    rng = stream(scenario.scene_id, scenario.seed, "degrade/log-poses")
    s = arc_lengths(line)
    total = np.zeros(len(line))
    for _ in range(6):
        total += np.sin(2 * np.pi * s / rng.uniform(18.0, 50.0) + rng.uniform(0, 2 * np.pi))
    left = left_of(unit(np.gradient(line[:, :2], axis=0)))
    return np.asarray(
        SWAY_M / np.sqrt(3.0) * total[:, None] * np.column_stack([left, np.zeros(len(left))])
    )


def log_times(scenario: Scenario, spacing_m: float, most: int) -> list[int]:
    """Return times of the log at which the ego has moved ``spacing_m`` since the last one, at most
    ``most`` of them.
    """
    s = arc_lengths(scenario.ego_log.xyz)
    n = int(np.clip(s[-1] / spacing_m + 1, 1, most))
    index = np.searchsorted(s, np.linspace(0.0, s[-1], n)).clip(0, len(s) - 1)
    return [int(t) for t in np.unique(scenario.ego_log.t_us[index])]


def log_actors(scenario: Scenario, t_us: int) -> dict[str, F64]:
    """Return the recorded poses of the actors present at a time."""
    return {
        a.actor_id: interpolate(a.track, t_us)
        for a in scenario.actors
        if a.track.t_us[0] <= t_us <= a.track.t_us[-1]
    }
