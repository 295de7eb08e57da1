"""Every causal arm, end to end: its stages train, resume bit for bit, and give a bundle that steps
as a renderer.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.fixers.network.checkpoints import load_weights
from alpasim_plugin.lab.training.adversarial import AdversarialTerm
from alpasim_plugin.lab.training.bundle_fixer import bundle_fixer
from alpasim_plugin.lab.training.clip_batches import BatchForm
from alpasim_plugin.lab.training.distillation import Distillation
from alpasim_plugin.lab.training.fixer_run import FixerRun, train_fixer
from alpasim_plugin.lab.training.recipes.causal_arms import CAUSAL_ARMS
from alpasim_plugin.lab.training.recipes.registry import recipe_of
from alpasim_plugin.lab.training.trainer import STATE_FILE, Schedule
from tests.block_fixers.fixer_cases import SMALL_DIT, fixer, run_blocks
from tests.fixers.clip_cases import maps_of, moving_picture, pixels
from tests.lab.training.generator_runs import (
    FORM,
    clips_of,  # noqa: F401 - data is a fixture
    data,  # noqa: F401 - data is a fixture
)

pytestmark = pytest.mark.slow

STEPS = 2  # U


def arm_settings(name, *overrides):
    sizes = [text for text in SMALL_DIT if text.startswith("dit.")]
    settings = fixer_settings(name, (*sizes, *overrides))
    assert isinstance(settings, OneFixerSettings)
    return settings


def run_of(data, recipe, **weights):
    schedule = Schedule(STEPS, peak_lr=1e-2, warmup=1, accumulate=1, save_every=1, ema=0.5)
    batches = BatchForm(clips=2, columns=4)
    return FixerRun(
        arm_settings(recipe.fixer),
        recipe,
        data,
        data / "vae.safetensors",
        weights,
        FORM,
        batches,
        schedule,
    )


def deployed(path, steps=1):
    name, overrides = bundle_fixer(path)
    settings = fixer_settings(name, (*overrides, f"steps={steps}"))
    assert isinstance(settings, OneFixerSettings)
    return fixer(settings)


@pytest.fixture(scope="module")
def student(data, tmp_path_factory):
    return train_fixer(
        run_of(data, recipe_of("omnidreams")), tmp_path_factory.mktemp("arms") / "student"
    )


QUICK = (
    "self-forcing",
)  # it has the stages of the others; the adversarial head is tried by itself


@pytest.mark.parametrize(
    "recipe",
    [
        pytest.param(r, id=r.name, marks=() if r.name in QUICK else pytest.mark.slow)
        for r in CAUSAL_ARMS
    ],
)
def test_an_arm_trains_resumes_and_drives(data, tmp_path, recipe):
    run = run_of(data, recipe)
    whole = train_fixer(run, tmp_path / "whole")
    last = recipe.stages[-1].updates(STEPS)
    stopped = train_fixer(
        run, tmp_path / "cut", stop_at=run.updates - last + 1
    )  # within the last stage
    assert json.loads(stopped.with_suffix(".card.json").read_text())["curves"][-1]["step"] == 1
    again = train_fixer(run, tmp_path / "cut")
    assert stopped == again
    one, other = (load_weights(path.with_name(STATE_FILE)) for path in (whole, again))
    assert all(torch.equal(value, other[key]) for key, value in one.items())
    for stage in recipe.stages[:-1]:
        one, other = (
            load_weights(tmp_path / folder / stage.name / STATE_FILE) for folder in ("whole", "cut")
        )
        assert all(torch.equal(value, other[key]) for key, value in one.items())
    session = deployed(whole)
    assert session.label.startswith(f"{recipe.fixer}, ")
    assert f", {recipe.name}, {last} updates" in session.label
    frames = moving_picture(9)
    fixed = pixels(run_blocks(session, frames, maps_of(frames)))
    assert np.abs(fixed.astype(int) - pixels(frames)).max() > 0
    assert deployed(whole, steps=4).label.startswith(f"{recipe.fixer}@4")


def test_a_head_that_no_longer_teaches_stops_its_run(data, student, tmp_path):
    recipe = recipe_of("one-forcing")
    strict = replace(
        recipe.stages[-1], objective=Distillation(adversarial=AdversarialTerm(most=0.0))
    )
    run = run_of(
        data,
        replace(recipe, stages=(*recipe.stages[:-1], strict)),
        student=student,
        teacher=student,
    )
    with pytest.raises(InfrastructureError):
        train_fixer(run, tmp_path / "run")
