"""`fit_drive` on a drawn street: learns depth with the colours, tells about views held out,
resumes, refuses what it cannot start.
"""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.gaussians.fit import drive
from alpasim_plugin.gaussians.fit.drive import fit_drive
from alpasim_plugin.gaussians.fit.loop import SplatFit
from alpasim_plugin.gaussians.fit.model import Exposure
from alpasim_plugin.gaussians.fit.recipe import SplatRecipe
from alpasim_plugin.gaussians.fit.start import Start, cloud_from_points
from tests.gaussians.fit.street_views import brightened, street_views, true_depth

pytestmark = pytest.mark.slow

QUICK = replace(
    SplatRecipe.street(), steps=45, points=3000, cap=3500, save_every=15, densify_every=20
)
GAINS = [(1 + 0.1 * np.sin(i),) * 3 for i in range(8)]


@pytest.fixture(scope="module")
def views():
    return [brightened(view, gain) for view, gain in zip(street_views(8), GAINS, strict=True)]


@pytest.fixture(scope="module")
def fitted(views):
    told = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drive, "LEAST_WAY_M", 2.0)  # these views cover 4 m
        done = fit_drive(
            [*views[:4], *views[5:]],
            None,
            kept={views[4].name: views[4].camera},
            scene_id="s",
            threads=1,
            recipe=QUICK,
            report=lambda stage, at, all, numbers: told.append((stage, dict(numbers))),
        )
    return done, told


def test_after_few_steps_the_depth_of_the_fit_is_already_near_the_street_s(fitted, views):
    out = fitted[0].model.graph().render(views[4].camera, {}, 1)
    truth = true_depth(views[4])
    near = np.isfinite(truth) & (truth < 20) & (out.alpha > 0.5)
    assert near.mean() > 0.4
    assert np.median(np.abs(out.depth[near] / truth[near] - 1)) < 0.2


def test_the_sky_stays_free_of_gaussians(fitted, views):
    sky = ~np.isfinite(true_depth(views[4]))
    out = fitted[0].model.graph().render(views[4].camera, {}, 1)
    assert out.alpha[sky].mean() < 0.25


def test_exposures_are_told_for_every_view_and_a_kept_one_has_its_neighbours(
    fitted,
):
    found = fitted[0].exposures
    assert len(found) == 8
    fitted_ones = [i for i in range(8) if i != 4]
    ratio = np.array([found[f"front-{i:06d}"][1] / GAINS[i][1] for i in fitted_ones])
    assert np.abs(ratio / ratio.mean() - 1).max() < 0.04
    between = (found["front-000003"][1] + found["front-000005"][1]) / 2
    assert found["front-000004"][1] == pytest.approx(between, abs=0.01)


def test_photographs_that_share_nothing_start_from_given_points(views):
    rng = np.random.default_rng(0)
    noise = [
        replace(view, rgb=rng.integers(0, 255, view.rgb.shape, dtype=np.uint8))
        for view in views[:2]
    ]
    points = cloud_from_points(rng.uniform([4, -3, 0], [12, 3, 2], (50, 3)), np.full((50, 3), 0.5))
    assert (
        len(fit_drive(noise, points, recipe=replace(QUICK, steps=2, densify_every=0)).model) == 50
    )


def test_a_weight_of_depth_moves_gaussians_to_the_measured_depth(views):
    """Of a flat grey picture colours say nothing: the weight pulls the points, 12 m away, towards
    the depth of 8 m.
    """
    rng = np.random.default_rng(0)
    flat = replace(
        views[0],
        rgb=np.full_like(views[0].rgb, 128),
        depth=np.full(views[0].rgb.shape[:2], 8.0, dtype=np.float32),
    )
    points = np.column_stack([np.full(400, 12.0), rng.uniform(-4, 4, 400), rng.uniform(0, 4, 400)])
    cloud = cloud_from_points(points, np.full((400, 3), 0.5))

    def fitted_to(weight):
        recipe = SplatRecipe(
            steps=60, densify_every=0, depth_weight=weight, lr_means=0.05, lr_means_end=0.05
        )
        run = SplatFit([flat], Start(cloud, {}), recipe, "s", 1, None)
        while run.step < recipe.steps:
            run.update()
        return float(np.median(run.model.clouds()[0].means[:, 0]))

    assert abs(fitted_to(0.5) - 8.0) < 0.5 < abs(fitted_to(0.0) - 8.0)


def test_an_exposure_learns_its_gain_and_keeps_the_mean():
    exposure = Exposure(np.ones((2, 3)))
    for _ in range(200):
        ((exposure.gain(0) - 1.2) ** 2).sum().backward()
        exposure.update(0.01)
    gains = exposure.gains()
    assert gains[0, 0] == pytest.approx(1.2, abs=0.03)
    assert np.allclose(np.log(gains).sum(axis=0), 0, atol=1e-4)
