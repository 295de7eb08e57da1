"""Each part of the fit against something independent of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from alpasim_plugin.core.geometry import se2
from alpasim_plugin.core.image_metrics import ssim
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.gaussians import GaussianCloud, PinholeCamera
from alpasim_plugin.gaussians.fit.model import (
    RowAdam,
    ScreenGradients,
    SplatModel,
    densify,
)
from alpasim_plugin.gaussians.fit.quality import SsimTarget
from alpasim_plugin.gaussians.fit.recipe import SplatRecipe
from alpasim_plugin.gaussians.fit.reconstruction import sky_of
from alpasim_plugin.gaussians.fit.start import (
    Start,
    cloud_from_points,
    start_from_depth,
    start_in_boxes,
)
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.gaussians.scene.sky import HEIGHT, WIDTH, Sky
from alpasim_plugin.gaussians.sh import dc_from_rgb
from tests.camera_builders import ahead
from tests.gaussians.fit.conftest import BOX, FAR, actor_pose
from tests.gaussians.gaussian_scenes import covariances, random_cloud, random_rigid
from tests.gaussians.gradient_scenes import central_differences, cloud_of


def images():
    rng = stream("fit-tests", 0, "images")
    a, b = (torch.as_tensor(rng.random((16, 19, 3), dtype=np.float32)) for _ in range(2))
    return a, (a + 0.3 * b) / 1.3


def model_of(cloud, actors=None, degree=1):
    return SplatModel.from_start(Start(cloud, actors or {}), np.zeros(3), degree)


# --- loss


def test_similarity_and_its_gradient_are_those_of_the_metric():
    a, b = images()
    a[3:9, 4:12] = b[3:9, 4:12] = 0.5  # flat in both: only the constants keep the quotient
    image = a.clone().requires_grad_()
    found = SsimTarget(b).ssim(image)
    found.backward()
    wanted = central_differences(lambda: ssim(a.numpy(), b.numpy(), peak=1.0), a.numpy(), 1e-3)
    assert float(found.detach()) == pytest.approx(ssim(a.numpy(), b.numpy(), peak=1.0), abs=1e-6)
    assert np.abs(image.grad.numpy() - wanted).max() < 0.01 * np.abs(wanted).max()


# --- optimiser


def test_updates_follow_the_published_algorithm():
    start = stream("fit-tests", 0, "adam").standard_normal((5, 3)).astype(np.float32)
    p = torch.as_tensor(start.copy()).requires_grad_()
    adam = RowAdam({"p": p})
    wanted = start.astype(np.float64)
    m = 0.0
    v = 0.0
    for t in range(1, 11):
        p.pow(3).sum().backward()
        adam.update({"p": p}, {"p": 0.01 / t})
        gradient = 3 * wanted**2
        m = 0.9 * m + 0.1 * gradient
        v = 0.999 * v + 0.001 * gradient**2
        wanted -= 0.01 / t * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-15)
    assert np.allclose(p.detach().numpy(), wanted, atol=1e-5)


def test_rows_keep_their_moments_when_others_come_and_go():
    p = torch.arange(6.0).reshape(3, 2).requires_grad_()
    adam = RowAdam({"p": p})
    p.sum().backward()
    adam.update({"p": p}, {"p": 0.1})
    before = adam.first["p"].clone()
    adam.take(torch.tensor([2, 0, 0]), 2)
    assert torch.equal(adam.first["p"], torch.stack([before[2], before[0], torch.zeros(2)]))


# --- model


def test_an_actor_is_placed_as_a_moved_cloud_is():
    ground = random_cloud(20, 1)
    car = random_cloud(15, 2)
    model = model_of(ground, {"car": car, "gone": random_cloud(5, 3)}, degree=3)
    T = random_rigid(4)
    splats, rows = model.placed(model.motion({"car": T, "stranger": T}), 16)
    wanted = GaussianCloud.concatenate([ground, car.transformed(T)])
    assert rows.tolist() == list(range(35)), "background and car, without what is not there"
    found = cloud_of(splats)
    assert np.allclose(found.means, wanted.means, atol=1e-5)
    assert np.allclose(covariances(found), covariances(wanted), atol=1e-5)
    assert np.allclose(found.sh, wanted.sh, atol=1e-5)
    assert np.allclose(found.opacities, wanted.opacities, atol=1e-6)


def test_a_placed_actor_passes_gradients_to_its_own_frame():
    model = model_of(random_cloud(3, 1), {"car": random_cloud(4, 2)})
    T = random_rigid(5)
    splats, _ = model.placed(model.motion({"car": T}), 4)
    splats.means[3:, 0].sum().backward()
    gradient = model.params["means"].grad
    assert torch.allclose(
        gradient[3:], torch.as_tensor(T[0, :3], dtype=torch.float32).expand(4, 3), atol=1e-6
    )
    assert not gradient[:3].any()


def test_clouds_come_back_as_they_went_in_far_from_the_origin():
    cloud = random_cloud(30, 6, degree=1)
    far = replace(cloud, means=cloud.means + FAR, opacities=cloud.opacities.clip(0.01, 0.99))
    model = SplatModel.from_start(Start(far, {"car": cloud}), FAR, 1)
    background, actors = model.clouds()
    assert np.abs(background.means - far.means).max() < 1e-5
    assert np.abs(actors["car"].means - cloud.means).max() < 1e-5
    assert np.allclose(background.scales, far.scales, rtol=1e-5)
    assert np.allclose(background.opacities, far.opacities, atol=1e-6)


# --- density


def density_case(cap=100):
    """Three background Gaussians (small and pulled, large and pulled, calm), one of a car
    (pulled).
    """
    cloud = GaussianCloud(
        np.array([[0, 0, 0], [1.0, 0, 0], [2, 0, 0]]),
        np.tile([1.0, 0, 0, 0], (3, 1)),
        np.array([[0.1] * 3, [2.0] * 3, [0.2] * 3]),
        np.full(3, 0.5),
        np.zeros((3, 1, 3)),
    )
    model = model_of(cloud, {"car": cloud.take([0])})
    gradients = ScreenGradients(4)
    gradients.add(torch.arange(4), torch.tensor([1e-3, 2e-3, 0.0, 5e-3]), torch.ones(4))
    return (
        model,
        RowAdam(model.params),
        gradients,
        SplatRecipe(cap=cap, densify_gradient=2e-4, dense_share=0.01, prune_share=1.0),
    )


def test_small_ones_are_cloned_large_ones_split_calm_ones_kept():
    model, adam, gradients, recipe = density_case()
    densify(model, adam, gradients, recipe, 50.0, stream("t", 0, "split"))
    size = model.params["log_scales"].exp().max(dim=1).values.tolist()
    assert sorted(round(s, 3) for s in size[:5]) == [0.1, 0.1, 0.2, 1.25, 1.25]
    assert model.node.tolist() == [0, 0, 0, 0, 0, 1, 1], "a car's clone belongs to the car"
    at = sorted(round(float(x), 3) for x in model.params["means"].detach()[:5, 0])
    assert at.count(0.0) == 2, "a clone starts where its original is"
    assert at.count(1.0) == 0, "two drawn from the split one"
    assert all(
        len(t) == 7 for t in (*adam.first.values(), *adam.second.values(), *model.params.values())
    )


def test_faint_and_oversized_ones_are_removed():
    model, adam, gradients, recipe = density_case()
    with torch.no_grad():
        model.params["logit_opacities"][2] = -6.0
    densify(
        model,
        adam,
        gradients,
        replace(recipe, densify_gradient=1.0, prune_share=0.03),
        50.0,
        stream("t", 0, "split"),
    )
    assert [round(float(x), 3) for x in model.params["means"].detach()[:, 0]] == [0.0, 0.0]


# --- start and sky


def test_start_points_lie_on_the_surfaces_and_actors_own_theirs(posed):
    start = start_from_depth(posed.views, {"car": BOX}, 400, "s", 0, 50)
    assert len(start.actors["car"]) == 50
    assert np.abs(start.actors["car"].means).max() < 2.2
    # What is left is the wall and the floor, up to the range error and the sizes of their
    # Gaussians.
    local = start.background.means - FAR
    assert np.quantile(np.minimum(np.abs(local[:, 0] - 12), np.abs(local[:, 2])), 0.9) < 1.0
    again = start_from_depth(posed.views, {"car": BOX}, 400, "s", 0, 50)
    assert np.array_equal(start.background.means, again.background.means)


def test_points_become_gaussians_as_large_as_their_distance():
    line = np.column_stack([np.arange(5) * 0.5, np.zeros(5), np.zeros(5)])
    cloud = cloud_from_points(line, np.full((5, 3), 0.25))
    assert cloud.scales[2, 0] > 0.2
    assert np.allclose(cloud.sh[:, 0], dc_from_rgb([0.25] * 3))
    assert len(cloud_from_points(line[:1], np.zeros((1, 3)))) == 1


def test_where_no_depth_is_known_an_actor_starts_all_over_its_box():
    cloud = start_in_boxes({"car": BOX}, 500, "s", 0)["car"]
    half = np.array([BOX.length_m, BOX.width_m, BOX.height_m]) / 2
    assert np.all(np.abs(cloud.means) <= half)
    assert np.all(np.abs(cloud.means).max(axis=0) > 0.9 * half)


def test_the_panorama_shows_the_sky_that_the_views_saw(posed):
    sky = sky_of(posed.views)
    for view in posed.views[::3]:
        assert view.sky is not None
        error = np.abs(sky.image(view.camera) - view.rgb / 255.0)[view.sky]
        assert error.mean() < 0.03
    assert np.isfinite(sky.panorama).all()
    assert sky_of([replace(v, sky=None) for v in posed.views]) is None


def test_the_panorama_of_views_is_not_turned():
    """Brightness rises to the left by a level every 0.06 degrees; half a pixel would be 2."""
    azimuth = np.arange(WIDTH) * 2 * np.pi / WIDTH
    ramp = 0.5 + 0.4 * np.sin(12 * azimuth)
    true = Sky(np.repeat(np.repeat(ramp[None, :, None], HEIGHT, 0), 3, 2).astype(np.float32))
    views = []
    for yaw in (0.0, 0.4):
        camera = PinholeCamera.from_pose(
            320,
            180,
            np.array([[960.0, 0, 160], [0, 960.0, 90], [0, 0, 1]]),
            se2(0, 0, yaw) @ ahead(),
        )
        rgb = np.rint(true.image(camera) * 255).astype(np.uint8)
        views.append(PosedView(camera, rgb, sky=np.ones((180, 320), dtype=np.bool_)))
    found = sky_of(views)
    off = [
        (found.image(view.camera) - true.image(view.camera))[10:-10, 10:-10, 0] for view in views
    ]
    slope = [np.gradient(true.image(view.camera)[10:-10, 10:-10, 0], axis=1) for view in views]
    turned_px = np.vdot(slope, off) / np.vdot(slope, slope)
    assert abs(turned_px) < 0.2


# --- recipe


def test_the_schedule_stretches_with_the_steps():
    short = SplatRecipe(steps=100, densify_every=10)
    long = SplatRecipe(steps=1000, densify_every=100)
    assert [i for i in range(101) if short.densifies_after(i)] == [20, 30, 40, 50, 60]
    assert [i // 10 for i in range(1001) if long.densifies_after(i)] == [20, 30, 40, 50, 60]
    assert short.lr_means_at(0) == pytest.approx(short.lr_means)
    assert short.lr_means_at(100) == pytest.approx(short.lr_means_end)
    assert [short.sh_size_at(i) for i in (0, 24, 25, 50, 99)] == [1, 1, 4, 9, 9]


def test_where_the_cap_leaves_room_for_one_the_strongest_pull_wins():
    model, adam, gradients, recipe = density_case(cap=5)
    densify(model, adam, gradients, recipe, 50.0, stream("t", 0, "split"))
    assert model.node.tolist() == [0, 0, 0, 1, 1]


def test_an_actor_that_is_not_in_view_gets_no_model(posed):
    views = [
        replace(
            v,
            actors={
                "car": actor_pose(0) @ np.diag([1.0, 1, 1, 1])
                + np.array([[0, 0, 0, 500.0]] * 3 + [[0] * 4])
            },
        )
        for v in posed.views
    ]
    assert not start_from_depth(views, {"car": BOX}, 100, "s", 0).actors
