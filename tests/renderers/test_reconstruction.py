"""The renderer 3dgs on a model fitted to the logged drive: tiny fits of a street, 64 x 36
pixels.
"""

import sys
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse, se2
from alpasim_plugin.core.types import (
    BackgroundFile,
    Behaviour,
    Degradation,
    Environment,
    Latency,
)
from alpasim_plugin.gaussians.fit.loop import fit
from alpasim_plugin.gaussians.fit.views import logged_views
from alpasim_plugin.renderers import (
    make_renderer,
    reconstruction,
    reconstruction_build,
    recorded,
)
from alpasim_plugin.renderers.gaussian import (
    CleanRenderer,
    clear_cache,
    scene_of,
)
from alpasim_plugin.renderers.reconstruction import (
    KIND,
    ReconstructionRenderer,
    ensure,
    reconstruction_renderer,
)
from alpasim_plugin.renderers.reconstruction_build import build, misplaced
from alpasim_plugin.renderers.reconstruction_key import (
    read_model,
    recipe_of,
    reconstruction_key,
)
from tests.gaussians.scene_maps import camera_spec, line, parked, road_lanes, straight, with_camera
from tests.renderers.requests import psnr, request

ACTORS = (parked("ahead", 19.0, -1.8), parked("never-seen", -30.0, -1.8))
FITTED = Degradation("reconstruction", share=0.4)
DAMAGE = {"views_per_s": 20.0, "depth_error": 0.3, "pose_error_m": 0.1}


def street(degradation=FITTED):
    """Give 1.4 s along a straight street with one actor in view and one behind the camera."""
    around = Environment(buildings=0.0, trees_per_100m=5.0, poles_spacing_m=0.0)
    scenario = with_camera(
        straight(actors=ACTORS, environment=around, degradation=degradation), 64, 36
    )
    log = scenario.ego_log
    return replace(
        scenario, ego_log=replace(log, t_us=log.t_us[:8], xyz=log.xyz[:8], quat=log.quat[:8])
    )


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("cache")
        patch.setenv("SIMRUN_CACHE", str(folder))
        yield folder
    clear_cache()


@pytest.fixture(scope="module")
def fitted(cache):
    del cache
    renderer = make_renderer("3dgs", street())
    assert isinstance(renderer, ReconstructionRenderer)
    return renderer


def error_db(renderer, left_m):
    clean = make_renderer("clean", renderer.scenario)
    requests = [request(renderer.scenario, i, left_m) for i in (1, 3, 6)]
    return float(np.mean([psnr(clean.render(r), renderer.render(r)) for r in requests]))


def test_frame_has_the_shapes_types_and_ranges_of_the_contract(
    fitted,
):
    frame = fitted.render(request(fitted.scenario, 4))
    assert frame.rgb.shape == (36, 64, 3)
    assert frame.rgb.dtype == np.uint8
    assert frame.alpha.shape == frame.depth.shape == (36, 64)
    assert 0 <= frame.alpha.min() <= frame.alpha.max() <= 1
    assert frame.alpha[:4].mean() > 0.97  # sky counts as shown
    assert frame.alpha[24:].mean() > 0.6  # ground
    assert 2.0 < frame.depth[-1, 32] < 9.0


def test_a_larger_share_of_the_schedule_fits_better(fitted):
    hasty = make_renderer("3dgs", street(Degradation("reconstruction", share=0.02)))
    assert isinstance(hasty, ReconstructionRenderer)
    assert error_db(fitted, 0.0) > error_db(hasty, 0.0) + 1


def test_frames_do_not_depend_on_what_came_before_nor_on_threads(
    fitted,
):
    r = request(fitted.scenario, 4, 0.7)
    fitted.render(request(fitted.scenario, 7))
    first = fitted.render(r)
    clear_cache()
    for threads in (1, 2):  # of the rasteriser: the model comes from the disk
        again = make_renderer("3dgs", fitted.scenario, seed=5, threads=threads).render(r)
        assert_array_equal(first.rgb, again.rgb)
        assert_array_equal(first.alpha, again.alpha)


def test_the_drives_of_a_process_share_a_recording_and_what_was_read_of_it(
    fitted,
):
    (first, other), again = (
        make_renderer("3dgs", fitted.scenario).recorded()[:2] for _ in range(2)
    )
    assert (first, other) == tuple(again)
    assert again[0].read() is first.read()
    assert other.read() is not first.read()


def test_a_recording_keeps_so_many_pictures_as_its_memory_holds(fitted, monkeypatch):
    monkeypatch.setattr(recorded, "KEPT_BYTES", 2 * 64 * 36 * recorded.BYTES_PER_PX)
    scene = scene_of(fitted.scenario)
    model = fitted.model.graph.render
    first, second, third = recorded.built_recording(
        fitted.scenario, scene, model, recipe_of(fitted.scenario), fitted.scenario.cameras
    )[:3]
    was = first.read()
    second.read()
    assert first.read() is was
    third.read()
    second.read()  # now the first is the one that was not read for longest
    again = first.read()
    assert again is not was
    assert_array_equal(again[0], was[0])


def test_actor_that_was_seen_is_fitted_and_one_never_seen_is_spliced_in(
    fitted,
):
    actors = fitted.model.graph.actors
    assert len(actors["ahead"].levels) == 1
    own = make_renderer("clean", fitted.scenario)
    assert isinstance(own, CleanRenderer)
    assert_array_equal(
        actors["never-seen"].levels[0].cloud.means,
        own.scene.actors["never-seen"].levels[0].cloud.means,
    )
    r = request(fitted.scenario, 4)
    for name in actors:
        pose = np.eye(4)
        pose[:3, 3] = (22.0, -1.8, 0.75)
        with_actor, without = (fitted.render(replace(r, actors=a)) for a in ({name: pose}, {}))
        changed = np.abs(with_actor.rgb.astype(int) - without.rgb).max(axis=2) > 20
        assert changed.sum() > 12, name


def test_damaged_file_is_noticed_and_the_same_model_made_again_by_more_threads(
    fitted, cache, capfd
):
    scenario = fitted.scenario
    folder = cache / KIND / reconstruction_key(scenario, recipe_of(scenario))
    data = (folder / "background.ply").read_bytes()
    (folder / "background.ply").write_bytes(data[:-10])
    with pytest.raises(InputError):
        read_model(folder)
    ensure(scenario, recipe_of(scenario), threads=2)
    assert "is damaged" in capfd.readouterr().err
    assert (folder / "background.ply").read_bytes() == data


def test_a_model_that_is_kept_is_drawn_without_what_fits_it(fitted, monkeypatch):
    """Torch takes a second to load."""
    clear_cache("reconstruction:")
    for name in ("torch", reconstruction_build.__name__):
        monkeypatch.setitem(sys.modules, name, None)  # importing it raises
    frame = make_renderer("3dgs", fitted.scenario).render(request(fitted.scenario, 4))
    assert_array_equal(frame.rgb, fitted.render(request(fitted.scenario, 4)).rgb)


def test_a_model_is_fitted_where_its_renderer_draws_and_kept_apart(cache, monkeypatch):
    del cache
    scenario = street(replace(FITTED, share=0.06))
    places = []

    def fit_on(*views, device, **options):
        places.append(device)
        return fit(*views, **options)

    monkeypatch.setattr(reconstruction_build, "fit", fit_on)
    monkeypatch.setattr(reconstruction, "require_device", str)
    for device in ("cpu", "cuda:1", "cuda:2"):
        make_renderer("3dgs", scenario, device=device)
    assert places == ["cpu", "cuda:1"]


def test_cycle_is_fitted_one_metre_aside_and_takes_all_actors_from_the_scene(cache):
    del cache
    scenario = street(Degradation("cycle", share=0.1, shift_m=1.0))
    renderer = make_renderer("3dgs", scenario)
    assert isinstance(renderer, ReconstructionRenderer)
    assert all(len(node.levels) > 1 for node in renderer.model.graph.actors.values())
    _, views = ensure(scenario, recipe_of(scenario))
    y = [inverse(view.camera.T_camera_world)[1, 3] for view in views]
    assert_allclose(y, -0.8, atol=1e-6)  # the log runs at y = -1.8


def test_a_sharp_camera_is_fitted_with_more_steps_and_points_of_larger_views():
    scenario = street()
    sharp = replace(scenario, cameras=(camera_spec(1280, 720),))
    usual = recipe_of(scenario).splat
    fine = recipe_of(sharp).splat
    assert (fine.steps, fine.points) == (4 * usual.steps, 2 * usual.points)
    assert fine.width == 2 * usual.width
    assert len(sharp.cameras) == len(scenario.cameras)


def test_key_follows_what_is_seen_and_how_it_is_fitted_and_nothing_else():
    scenario = street()
    key = reconstruction_key(scenario, recipe_of(scenario))
    same = [
        replace(scenario, latency=Latency("fixed", 100_000)),
        replace(scenario, end_us=scenario.end_us - 500_000, content_hash="other"),
        replace(scenario, actors=(replace(ACTORS[0], behaviour=Behaviour("idm")), ACTORS[1])),
    ]
    assert {reconstruction_key(s, recipe_of(s)) for s in same} == {key}
    other_lanes = road_lanes(line((-60, 0), (220, 0)), "r", 1)
    other = [
        replace(scenario, seed=1),
        replace(scenario, actors=ACTORS[:1]),
        replace(scenario, actors=(parked("ahead", 19.5, -1.8), ACTORS[1])),
        replace(scenario, lane_map=replace(scenario.lane_map, lanes=other_lanes)),
        replace(scenario, environment=replace(scenario.environment, buildings=0.4)),
        replace(scenario, degradation=replace(FITTED, share=0.5)),
        *(
            replace(scenario, degradation=replace(FITTED, **{key: value}))
            for key, value in DAMAGE.items()
        ),
        replace(scenario, degradation=Degradation("cycle", share=0.4)),
        with_camera(scenario, 96, 54),
    ]
    keys = [reconstruction_key(s, recipe_of(s)) for s in other]
    assert len({key, *keys}) == len(other) + 1


def test_key_follows_the_bytes_of_a_background_file_not_its_place(tmp_path):
    keys = []
    for name, content in (("a", b"1"), ("b", b"1"), ("c", b"2")):
        (tmp_path / name).write_bytes(content)
        scenario = replace(street(), background=BackgroundFile(str(tmp_path / name), np.eye(4)))
        keys.append(reconstruction_key(scenario, recipe_of(scenario)))
    assert keys[0] == keys[1] != keys[2]


def test_longer_logs_and_more_cameras_get_more_views_points_and_steps():
    short = recipe_of(street()).splat
    scenario = straight(degradation=FITTED)
    log = scenario.ego_log
    minutes = replace(scenario, ego_log=replace(log, t_us=log.t_us * 40))
    long, two, six = (
        recipe_of(replace(minutes, cameras=scenario.cameras * count)).splat for count in (1, 2, 6)
    )
    for name in ("views", "points", "steps"):
        assert getattr(short, name) < getattr(long, name) < getattr(two, name)
        assert getattr(six, name) == 3 * getattr(two, name)


def test_a_log_of_minutes_is_refused_before_anything_is_fitted():
    scenario = street()
    log = replace(scenario.ego_log, t_us=scenario.ego_log.t_us * 100)
    with pytest.raises(
        InputError,
    ):
        reconstruction_renderer(replace(scenario, ego_log=log), 0, "cpu", None)


def turned_aside(name, yaw):
    """Give a small camera that looks to the left of the driving direction by an angle, radians."""
    spec = camera_spec(32, 18)
    T = spec.T_rig_camera.copy()
    T[:3, :3] = se2(0.0, 0.0, yaw)[:3, :3] @ T[:3, :3]
    return replace(spec, name=name, T_rig_camera=T)


@pytest.mark.slow
def test_the_model_does_not_depend_on_the_order_in_which_cameras_are_listed(tmp_path):
    damaged = replace(FITTED, share=0.05, pose_error_m=0.05)
    rig = [turned_aside("front", 0.0), turned_aside("left", 1.2), turned_aside("rear", np.pi)]
    models = []
    for cameras in (rig, rig[::-1], rig[1:] + rig[:1]):
        scenario = replace(street(damaged), cameras=cameras)
        assert [camera.name for camera in scenario.cameras] == ["front", "left", "rear"]
        folder = tmp_path / str(len(models))
        folder.mkdir()
        build(scenario, recipe_of(scenario), 1, "cpu", folder)
        models.append(read_model(folder)[0].background)
    for model in models[1:]:
        for part in ("means", "quats", "scales", "opacities", "sh"):
            assert_array_equal(getattr(model, part), getattr(models[0], part))


def test_every_camera_gives_points_to_start_from(cache):
    del cache
    damaged = replace(FITTED, share=1e-9, depth_error=0.0)
    ahead = turned_aside("front", 0.0)
    behind = turned_aside("rear", np.pi)
    scenario = replace(street(damaged), cameras=(behind, ahead), actors=())
    model, _ = ensure(scenario, recipe_of(scenario), 1)
    first, last = scenario.ego_log.xyz[[0, -1], 0]
    assert (model.background.means[:, 0] > last + 10).sum() > 50
    assert (model.background.means[:, 0] < first - 10).sum() > 50


def test_views_are_misplaced_smoothly_by_the_pose_error_and_not_at_all_by_none():
    scenario = street()
    views = logged_views(scenario, scene_of(scenario), 8, 32)
    many = [replace(views[0], t_us=100_000 * i) for i in range(400)]
    assert all(a is b for a, b in zip(misplaced(many, 0.0, "s", 0), many, strict=True))
    moved = misplaced(many, 0.1, "s", 0)
    errors = np.array(
        [
            a.camera.T_camera_world @ inverse(b.camera.T_camera_world)
            for a, b in zip(moved, many, strict=True)
        ]
    )
    assert 0.06 < errors[:, :3, 3].std() < 0.12
    turned_deg = np.degrees(
        np.arccos(np.clip((np.trace(errors[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
    )
    assert 0.2 < turned_deg.mean() < 0.6
    assert np.abs(np.diff(errors[:, :3, 3], axis=0)).mean() < 0.5 * errors[:, :3, 3].std()


def test_the_pinholes_of_a_lens_are_misplaced_as_one():
    view = logged_views(street(), scene_of(street()), 8, 32)[3]
    turn = se2(0.0, 0.0, 0.7)
    turned = replace(view.camera, T_camera_world=turn @ view.camera.T_camera_world)
    ahead = replace(view, name="lens.ahead-3")
    first, second = misplaced(
        [ahead, replace(ahead, name="lens.left-3", camera=turned)], 0.1, "s", 0
    )
    assert_allclose(
        second.camera.T_camera_world, turn @ first.camera.T_camera_world, rtol=0, atol=1e-9
    )


def test_it_shows_the_scene_well_on_the_path_and_worse_beside_it(
    fitted,
):
    on_path = error_db(fitted, 0.0)
    beside = error_db(fitted, 3.0)
    assert on_path > 19
    assert on_path > beside + 1


def test_recipe_has_the_views_depth_error_and_pose_error_of_the_scenario():
    log_s = 1.4
    recipe = recipe_of(street(replace(FITTED, **DAMAGE)))
    assert recipe.splat.views == round(20.0 * log_s)
    assert (recipe.range_error, recipe.pose_error_m) == (0.3, 0.1)
