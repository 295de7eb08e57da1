"""The training loop on a scene of 500 Gaussians: does it learn, continue, follow the actor, and
stop on a bad number.
"""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.image_metrics import psnr_db
from alpasim_plugin.gaussians.fit import loop
from alpasim_plugin.gaussians.fit.loop import STATE_FILE, Look, fit
from alpasim_plugin.gaussians.fit.recipe import SplatRecipe
from alpasim_plugin.gaussians.fit.trial import Trial, trial_of
from tests.gaussians.fit.conftest import BOX, actor_pose, at, camera_at

QUICK = SplatRecipe(steps=40, points=300, cap=420, densify_every=10, save_every=15, sh_degree=1)


def mean_psnr(model, views):
    graph = model.graph()
    values = []
    for view in views:
        known = {name: T for name, T in view.actors.items() if name in graph.actors}
        values.append(psnr_db(graph.render(view.camera, known, 1).to_uint8(), view.rgb))
    return float(np.mean(values))


def bits(model):
    clouds = [model.background, *(model.actors[name] for name in sorted(model.actors))]
    return [
        np.ascontiguousarray(getattr(c, name)).tobytes()
        for c in clouds
        for name in ("means", "quats", "scales", "opacities", "sh")
    ]


def test_views_held_out_are_shown_better_after_the_fit_than_by_the_start(posed):
    train = [view for i, view in enumerate(posed.views) if i % 4 != 2]
    kept = posed.views[2::4]
    recipe = replace(QUICK, steps=80)
    before = mean_psnr(fit(train, posed.start, replace(recipe, steps=1)), kept)
    numbers = []
    after = fit(
        train, posed.start, recipe, report=lambda step, row: numbers.append({"step": step, **row})
    )
    assert mean_psnr(after, kept) > before + 4.0
    assert [row["step"] for row in numbers] == list(range(1, 81))
    assert numbers[-1]["loss"] < 0.5 * numbers[0]["loss"]
    assert len(posed.start.background) < len(after) <= recipe.cap


def test_a_look_at_a_fit_shows_the_model_of_that_step_and_changes_nothing(posed):
    seen = []
    looked_at = fit(posed.views, posed.start, QUICK, look=Look(10, seen.append))
    assert bits(looked_at) == bits(fit(posed.views, posed.start, QUICK))
    (early,) = seen
    assert mean_psnr(early, posed.views) < mean_psnr(looked_at, posed.views)


def test_a_trial_times_updates_of_both_sizes(posed):
    seconds = iter([0.0, 3.0, 10.0, 22.0])  # three coarse updates, three whole ones
    recipe = replace(QUICK, steps=100, coarse_share=0.25)
    trial = trial_of(posed.views, posed.start, recipe, clock=lambda: next(seconds))
    assert (trial.coarse_s, trial.whole_s) == (1.0, 4.0)
    assert trial.seconds_until(100) == 25 * 1.0 + 75 * 4.0
    assert [trial.share_of(step) for step in (0, 100)] == [0.0, 1.0]
    whole = Trial(replace(recipe, coarse_share=0.0), 0.0, 2.0)
    assert whole.share_of(25) == 0.25


def test_a_fit_cut_off_and_continued_ends_with_the_same_bits(posed, tmp_path):
    whole = fit(posed.views, posed.start, QUICK, scene_id="s", folder=tmp_path / "whole")

    class CutOffError(Exception):
        pass

    def cut(step, numbers):
        if step == 27:  # between checkpoints, between densifications
            raise CutOffError

    with pytest.raises(CutOffError):
        fit(posed.views, posed.start, QUICK, scene_id="s", folder=tmp_path / "cut", report=cut)
    steps = []
    again = fit(
        posed.views,
        posed.start,
        QUICK,
        scene_id="s",
        folder=tmp_path / "cut",
        report=lambda step, _: steps.append(step),
    )
    assert steps[0] == 16, "continues after the checkpoint"
    assert bits(again) == bits(whole)


def test_a_folder_begun_with_another_recipe_is_refused(posed, tmp_path):
    recipe = replace(QUICK, steps=2)
    fit(posed.views, posed.start, recipe, folder=tmp_path)
    with pytest.raises(InputError):
        fit(posed.views, posed.start, replace(recipe, lr_scales=0.1), folder=tmp_path)
    with pytest.raises(InputError):
        fit(posed.views[1:], posed.start, recipe, folder=tmp_path)
    background = posed.start.background
    fainter = replace(background, opacities=background.opacities / 2)
    with pytest.raises(InputError):
        fit(posed.views, replace(posed.start, background=fainter), recipe, folder=tmp_path)


def test_the_actor_is_learned_in_its_own_frame(posed):
    model = fit(posed.views, posed.start, replace(QUICK, steps=80))
    car = model.actors["car"]
    solid = car.opacities > 0.3
    assert solid.sum() > 10
    inside = np.all(
        np.abs(car.means[solid]) < np.array([BOX.length_m, BOX.width_m, BOX.height_m]) / 2 + 0.5,
        axis=1,
    )
    assert inside.mean() > 0.9, "in the frame of its box, not in the world"
    # Put where no view saw it, it is drawn there and nowhere else.
    camera = camera_at(0.0)
    graph = model.graph()
    T = actor_pose(0)
    T[:3, 3] = at(8.0, 2.0, 0.8)
    moved = np.abs(graph.render(camera, {"car": T}, 1).rgb - graph.render(camera, {}, 1).rgb).max(
        axis=2
    )
    rows, columns = np.nonzero(moved > 0.1)
    assert len(rows) > 20
    assert columns.max() < 0.6 * camera.width, "to the left, as it was put"


def test_a_mask_keeps_what_it_hides_out_of_the_model(posed):
    spoiled = []
    for view in posed.views:
        rgb = view.rgb.copy()
        mask = np.ones(view.rgb.shape[:2], dtype=bool)
        rgb[-8:], mask[-8:] = (255, 0, 255), False
        spoiled.append(replace(view, rgb=rgb, mask=mask))
    model = fit(spoiled, posed.start, replace(QUICK, steps=40)).graph()
    shown = model.render(posed.views[3].camera, posed.views[3].actors, 1).rgb[-6:]
    magenta = (shown[..., 0] > 0.8) & (shown[..., 1] < 0.2) & (shown[..., 2] > 0.8)
    assert magenta.mean() < 0.05


def test_a_loss_that_is_not_finite_stops_the_fit_with_the_state_before_it(
    posed, tmp_path, monkeypatch
):
    real = loop.rasterize_gradient
    calls = []

    def breaks(*args, **kwargs):
        calls.append(1)
        out = real(*args, **kwargs)
        return replace(out, rgb=out.rgb * float("nan")) if len(calls) == 4 else out

    monkeypatch.setattr(loop, "rasterize_gradient", breaks)
    with pytest.raises(InfrastructureError) as error:
        fit(posed.views, posed.start, QUICK, folder=tmp_path)
    assert "update 3" in str(error.value)
    assert "view-" in str(error.value)
    monkeypatch.setattr(loop, "rasterize_gradient", real)
    steps = []
    fit(posed.views, posed.start, QUICK, folder=tmp_path, report=lambda step, _: steps.append(step))
    assert (tmp_path / STATE_FILE).exists()
    assert steps[0] == 4
