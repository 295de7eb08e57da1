from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alpasim_plugin.core.geometry import se2
from alpasim_plugin.core.types import Degradation, Scenario
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.scene.degrade import (
    KNOT_US,
    STEPS,
    SWAY_M,
    SWAY_ON,
    Surrogate,
    extended,
    flattened,
    log_actors,
    log_times,
    temporal_noise,
)
from alpasim_plugin.gaussians.scene.log_views import EDGE_SHARE, NEAR_M, LogView, LogViews
from alpasim_plugin.gaussians.scene.scene_graph import Level, SceneNode
from alpasim_plugin.gaussians.scene.surfels import cloud_of, with_sheen
from alpasim_plugin.gaussians.sh import dc_from_rgb, sh_colours
from tests.examples import examples
from tests.gaussians.scene_maps import camera_spec, curve, parked, straight

UNIT = Degradation(
    "surrogate", severity=1.0, onset_m=0.3, full_m=3.0
)  # the amounts that the expectations below are written for
SCENARIO = straight(degradation=UNIT)


def cloud(n: int = 400) -> GaussianCloud:
    rng = np.random.default_rng(0)
    means = np.column_stack([rng.uniform(5, 80, n), rng.uniform(-12, 9, n), rng.uniform(0, 3, n)])
    return cloud_of(means, rng.normal(size=(n, 4)), np.full((n, 3), 0.2), rng.random((n, 3)))


def node(name: str = "n", c: GaussianCloud | None = None, kind: str = "background") -> SceneNode:
    return SceneNode(name, kind, (Level(0.2, c if c is not None else cloud()),))


def degraded(w: float, severity: float = 1.0, scenario: Scenario = SCENARIO) -> GaussianCloud:
    s = Surrogate(replace(scenario, degradation=replace(UNIT, severity=severity)), [])
    return s.background(node(), 0, cloud(), w)


def test_weight_is_zero_on_the_path_one_beyond_full_and_grows_in_between() -> None:
    s = Surrogate(SCENARIO, [])
    weights = [
        s.weight(se2(40.0, -1.8 + d, 0.3)) for d in (0.0, 0.29, 0.8, 1.3, 2.0, 2.9, 3.0, 9.0)
    ]
    assert weights[:2] == [0.0, 0.0]
    assert weights[-2:] == [1.0, 1.0]
    assert weights == sorted(weights)
    assert all(w * STEPS == round(w * STEPS) for w in weights)


def test_weight_counts_sideways_distance_only_beyond_the_ends_of_the_log() -> None:
    s = Surrogate(SCENARIO, [])
    assert s.weight(se2(140.0, -1.8, 0.0)) == 0.0
    assert s.weight(se2(-30.0, -1.8, 0.0)) == 0.0
    assert s.weight(se2(140.0, 1.2, 0.0)) == 1.0


def test_weight_of_a_log_that_stands_still_is_measured_from_its_heading_line() -> None:
    log = replace(
        SCENARIO.ego_log, xyz=np.repeat(SCENARIO.ego_log.xyz[:1], len(SCENARIO.ego_log), axis=0)
    )
    s = Surrogate(replace(SCENARIO, ego_log=log), [])
    assert s.weight(se2(3.0, -1.8, 0.0)) == 0.0
    assert s.weight(se2(0.0, 2.0, 0.0)) == 1.0


@settings(deadline=None, max_examples=examples(50))
@given(st.floats(-3.0, 3.0), st.floats(0.05, 0.9))
def test_weight_follows_the_lateral_offset_along_a_curve(offset_m: float, share: float) -> None:
    scenario = curve(degradation=UNIT)
    i = int(share * len(scenario.ego_log))
    q = scenario.ego_log.quat[i]
    yaw = 2 * np.arctan2(q[3], q[0])
    x, y = scenario.ego_log.xyz[i, :2]
    w = Surrogate(scenario, []).weight(
        se2(x - offset_m * np.sin(yaw), y + offset_m * np.cos(yaw), yaw)
    )
    assert w == pytest.approx(np.clip((abs(offset_m) - 0.3) / 2.7, 0, 1), abs=0.5 / STEPS + 0.02)


def test_gaussians_slide_along_the_ray_of_their_log_camera_with_their_size() -> None:
    s = Surrogate(SCENARIO, [])
    original = cloud()
    recipe = s._recipe(node(), 0, original)
    moved = s.background(node(), 0, original, 0.0)
    eye = original.means - recipe.ray
    assert np.ptp(eye[:, 1]) < 1e-3  # all log cameras are on the path
    a = recipe.ray / np.linalg.norm(recipe.ray, axis=1, keepdims=True)
    b = moved.means - SWAY_ON * recipe.sway - eye
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    assert np.sum(a * b, axis=1).min() > 1 - 1e-6


def test_the_road_sways_sideways_smoothly_by_centimetres_on_the_path() -> None:
    s = Surrogate(SCENARIO, [])
    sway = s._sway
    assert np.abs(sway[:, [0, 2]]).max() < 1e-6  # the path runs along x
    assert np.abs(np.diff(sway[:, 1])).max() < 0.5 * SWAY_M
    assert 0.3 * SWAY_M < sway[:, 1].std() < 2.0 * SWAY_M


def test_stretches_of_thin_paint_are_lost_and_more_of_them_farther_away() -> None:
    n = 600
    rng = np.random.default_rng(2)
    means = np.column_stack([np.linspace(2, 90, n), np.full(n, -3.6), np.full(n, 0.02)])
    line = cloud_of(
        means, rng.normal(size=(n, 4)), np.tile([0.2, 0.06, 0.004], (n, 1)), np.full((n, 3), 0.9)
    )
    s = Surrogate(SCENARIO, [])
    left = [len(s.background(node(c=line), 0, line, w)) / n for w in (0.0, 0.5, 1.0)]
    assert 0.45 < left[0] < 0.9
    assert left[0] > left[1] > left[2]
    thick = cloud_of(
        means, rng.normal(size=(n, 4)), np.tile([0.2, 0.12, 0.004], (n, 1)), np.full((n, 3), 0.9)
    )
    assert len(s.background(node("m", thick), 0, thick, 0.0)) == n


def sees(view: LogView, points: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """Tell one view after the other which points ``(N, 3)`` of radius ``size_m (N,)`` lie in view
    and not behind what was seen.
    """
    camera = view.camera
    x, y, z = (points @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]).T
    ahead = z > NEAR_M
    safe = np.where(ahead, z, 1.0)
    u = np.floor(camera.fx * x / safe + camera.cx)
    v = np.floor(camera.fy * y / safe + camera.cy)
    edge = EDGE_SHARE * camera.width
    inside = (
        ahead & (u >= -edge) & (u < camera.width + edge) & (v >= -edge) & (v < camera.height + edge)
    )
    row = np.clip(np.where(inside, v, 0), 0, camera.height - 1).astype(np.int64)
    column = np.clip(np.where(inside, u, 0), 0, camera.width - 1).astype(np.int64)
    return np.asarray(inside & (z < view.limit[row, column] + size_m))


def test_all_views_at_once_agree_with_one_after_the_other() -> None:
    rng = np.random.default_rng(3)
    views = []
    for i, (w, h) in enumerate(((64, 36), (40, 52), (64, 36))):
        spec = camera_spec(w, h)
        camera = PinholeCamera.from_pose(
            w, h, spec.K, se2(8.0 * i, rng.normal(), 0.2 * rng.normal()) @ spec.T_rig_camera
        )
        views.append(
            LogView(
                camera,
                rng.uniform(3, 40, (h, w)).astype(np.float32),
                rng.random((h, w)).astype(np.float32),
            )
        )
    points = np.column_stack(
        [rng.uniform(-20, 80, 5000), rng.uniform(-30, 30, 5000), rng.uniform(-1, 9, 5000)]
    )
    size = rng.uniform(0, 1, 5000)
    slow = np.any([sees(v, points, size) for v in views], axis=0)
    np.testing.assert_array_equal(LogViews(views).see(points, size), slow)
    assert 0.02 < slow.mean() < 0.9
    assert LogViews([]).see(points, size).all()


def test_faults_grow_in_place_and_are_not_drawn_anew() -> None:
    small, large = degraded(0.25), degraded(1.0)
    original = cloud()
    assert len(large) < len(small) < len(original) + 1

    def by_name(c: GaussianCloud) -> dict[tuple[float, ...], np.ndarray]:
        return {
            tuple(q): m for q, m in zip(c.quats, c.means, strict=True)
        }  # orientations are unchanged and serve as names

    start = by_name(original)
    near = by_name(small)
    far = by_name(large)
    assert len(start) == len(original)
    assert set(far) <= set(
        near
    )  # what is missing nearer to the path is missing farther away as well
    growth = [np.linalg.norm(far[q] - start[q]) - np.linalg.norm(near[q] - start[q]) for q in far]
    assert np.mean(np.array(growth) > 0) > 0.85


def test_severity_scales_the_faults() -> None:
    shift = [np.median(np.abs(degraded(0.5, s).scales / 0.2 - 1)) for s in (0.01, 0.5, 1.0, 2.0)]
    assert shift == sorted(shift)
    assert shift[0] < 0.01


def test_degraded_clouds_can_be_drawn_even_at_high_severity() -> None:
    for w in (0.0, 1.0):
        degraded(w, 3.0).require_drawable()


def test_same_reconstruction_for_every_rollout_and_another_for_another_scene_seed() -> None:
    a = degraded(0.5)
    b = degraded(0.5)
    c = degraded(0.5, scenario=straight(seed=5))
    np.testing.assert_array_equal(a.means, b.means)
    assert len(a) != len(c) or np.abs(a.means - c.means).max() > 0


def test_gaussians_that_no_log_camera_saw_are_missing() -> None:
    spec = camera_spec(64, 36)
    camera = PinholeCamera.from_pose(64, 36, spec.K, se2(0, 0, 0) @ spec.T_rig_camera)
    wall_at_20m = LogView(
        camera, np.full((36, 64), 20.0, dtype=np.float32), np.ones((36, 64), dtype=np.float32)
    )
    points = np.array(
        [[15.0, 0, 1.5], [21.0, 0, 1.5], [40.0, 0, 1.5], [15.0, 60.0, 1.5], [-10.0, 0, 1.5]]
    )
    assert LogViews([wall_at_20m]).see(points, np.full(5, 0.1)).tolist() == [
        True,
        True,
        False,
        False,
        False,
    ]
    open_sky = LogView(
        camera, np.zeros((36, 64), dtype=np.float32), np.zeros((36, 64), dtype=np.float32)
    )
    assert LogViews([open_sky]).see(points, np.full(5, 0.1)).tolist() == [
        True,
        True,
        True,
        False,
        False,
    ]
    many = cloud_of(
        np.tile([40.0, 0, 1.5], (500, 1)),
        np.tile([1.0, 0, 0, 0], (500, 1)),
        np.full((500, 3), 0.1),
        np.full((500, 3), 0.5),
    )
    kept = Surrogate(SCENARIO, [wall_at_20m]).background(node(c=many), 0, many, 0.0)
    assert len(kept) < 0.12 * 500


def test_colour_without_view_dependence_is_the_mean_over_the_views_from_outside() -> None:
    normal = np.array([[0.6, 0.0, 0.8]])
    base = cloud_of(
        np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]), np.ones((1, 3)), np.array([[0.3, 0.4, 0.5]])
    )
    glossy = with_sheen(base, normal, np.array([0.3]), (0.7, 0.8, 0.9))
    rng = np.random.default_rng(0)
    d = rng.normal(size=(200_000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    seen = -(d @ normal[0])
    views, weight = d[seen > 0], seen[seen > 0]
    colours = sh_colours(np.repeat(glossy.sh, len(views), axis=0), views)
    mean = (colours * weight[:, None]).sum(axis=0) / weight.sum()
    flat = sh_colours(flattened(glossy.sh), normal)[0]
    np.testing.assert_allclose(flat, mean, atol=2e-3)
    np.testing.assert_array_equal(flattened(base.sh), base.sh)


def test_sheen_adds_nothing_seen_head_on_and_the_most_at_grazing_angles() -> None:
    base = cloud_of(
        np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]), np.ones((1, 3)), np.array([[0.3, 0.3, 0.3]])
    )
    glossy = with_sheen(base, np.array([[0.0, 0.0, 1.0]]), np.array([0.25]), (1.0, 1.0, 1.0))
    np.testing.assert_allclose(sh_colours(glossy.sh, [[0.0, 0.0, -1.0]]), 0.3, atol=1e-6)
    np.testing.assert_allclose(sh_colours(glossy.sh, [[1.0, 0.0, 0.0]]), 0.55, atol=1e-6)


def test_exposure_wanders_smoothly_and_depends_on_time_and_rollout_seed_only() -> None:
    s = Surrogate(SCENARIO, [])
    t = np.arange(0, 4_000_000, 50_000)
    gains = np.array([s.gain(int(x), 0, 0.5) for x in t])
    assert np.abs(np.diff(gains, axis=0)).max() < 0.06
    assert gains.std() > 0.005
    np.testing.assert_array_equal(
        s.gain(700_000, 0, 0.5), Surrogate(SCENARIO, []).gain(700_000, 0, 0.5)
    )
    assert np.abs(s.gain(700_000, 0, 0.5) - s.gain(700_000, 1, 0.5)).max() > 0


def test_wander_is_continuous_across_a_knot_even_at_epoch_times() -> None:
    knot = 1_600_000_000_000_000 // KNOT_US * KNOT_US
    a, b = temporal_noise("s", 0, "c", knot - 1, 3), temporal_noise("s", 0, "c", knot, 3)
    np.testing.assert_allclose(a, b, atol=1e-4)


def test_actor_pose_error_grows_and_stays_rigid() -> None:
    s = Surrogate(SCENARIO, [])
    T = se2(20.0, 3.0, 0.4, 0.75)
    times = range(0, 8_000_000, 250_000)
    errors = [
        np.mean([np.linalg.norm(s.pose("car-1", T, t, 0, w)[:3, 3] - T[:3, 3]) for t in times])
        for w in (0.0, 0.5, 1.0)
    ]
    assert errors == sorted(errors)
    assert errors[0] < 0.12
    moved = s.pose("car-1", T, 250_000, 0, 1.0)
    np.testing.assert_allclose(moved[:3, :3] @ moved[:3, :3].T, np.eye(3), atol=1e-12)
    assert moved[2, 3] == T[2, 3]


def test_ghost_trails_behind_the_actor_and_is_fainter() -> None:
    s = Surrogate(SCENARIO, [])
    T = se2(20.0, 3.0, 0.0)
    behind = [
        (s.ghost_pose("a", T, t, 0, 1.0) - s.pose("a", T, t, 0, 1.0))[0, 3]
        for t in range(0, 4_000_000, 500_000)
    ]
    assert np.mean(behind) < -0.8
    c = cloud(50)
    ghost, body = (
        s.actor(node("a~ghost", c, "actor"), 0, c, 0.5),
        s.actor(node("a", c, "actor"), 0, c, 0.5),
    )
    assert ghost.opacities.mean() < 0.5 * body.opacities.mean()


def test_actor_loses_parts_and_sheen() -> None:
    c = with_sheen(cloud(500), np.tile([0.0, 0.0, 1.0], (500, 1)), np.full(500, 0.2), (1, 1, 1))
    s = Surrogate(SCENARIO, [])
    sizes = [len(s.actor(node("a", c, "actor"), 0, c, w)) for w in (0.0, 0.5, 1.0)]
    assert 500 > sizes[0] > sizes[1] > sizes[2] > 250
    assert s.actor(node("a", c, "actor"), 0, c, 0.0).sh.shape[1] == 1


@pytest.mark.parametrize("make", [straight, curve])
def test_log_times_are_inside_the_log_and_few(make: Callable[..., Scenario]) -> None:
    scenario = make()
    times = log_times(scenario, 4.0, 20)
    assert 10 < len(times) <= 20
    assert times[0] == scenario.ego_log.t_us[0]
    assert times[-1] == scenario.ego_log.t_us[-1]


def test_only_actors_present_are_posed() -> None:
    early = replace(
        parked("early", 5, 0),
        track=replace(parked("early", 5, 0).track, t_us=np.array([0, 1_000_000])),
    )
    scenario = straight(actors=(parked("always", 9, 0), early))
    assert set(log_actors(scenario, 500_000)) == {"always", "early"}
    assert set(log_actors(scenario, 1_500_000)) == {"always"}


def test_path_is_extended_straight_at_both_ends() -> None:
    line = extended(
        np.array([[0.0, 0, 0], [10.0, 0, 0], [10.0, 5.0, 0]]), np.array([1.0, 0, 0, 0]), 100.0
    )
    np.testing.assert_allclose(line[0], [-100.0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(line[-1], [10.0, 105.0, 0], atol=1e-9)


def test_colour_tint_keeps_grey_near_grey_on_the_path() -> None:
    n = 300
    rng = np.random.default_rng(1)
    means = np.column_stack([rng.uniform(5, 80, n), rng.uniform(-8, 8, n), np.zeros(n)])
    grey = cloud_of(means, rng.normal(size=(n, 4)), np.full((n, 3), 0.2), np.full((n, 3), 0.34))
    out = Surrogate(SCENARIO, []).background(node(c=grey), 0, grey, 0.0)
    assert np.abs(out.sh - dc_from_rgb(0.34)).mean() < 0.1
