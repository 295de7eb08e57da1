"""The per-frame generator's training: objectives against their definition, gradients through k
frames, resumed runs are equal.
"""

from dataclasses import replace

import pytest
import torch

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.fixers.bundle import parts_of
from alpasim_plugin.fixers.network.checkpoints import load_weights
from alpasim_plugin.fixers.network.pixel_generator import PixelGenerator, PixelSizes, pixel_source
from alpasim_plugin.fixers.network.reference_blend import Sources, mix
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.lab.training.grid_term import grid_term
from alpasim_plugin.lab.training.pixel_rollout import (
    PixelObjectives,
    PixelSample,
    choice_term,
    pixel_losses,
)
from alpasim_plugin.lab.training.pixel_run import train_per_frame
from alpasim_plugin.lab.training.trainer import STATE_FILE
from tests.lab.training.pixel_runs import FRAMES, SMALL, Streams, run_of
from tests.pretended_device import pretended_device


def sample(seed=0, t=0.4):
    got = Streams().update(seed)
    render, truth, sdmap, opacity = (
        x.permute(0, 1, 3, 4, 2) for x in (got.render, got.target, got.map, got.opacity)
    )
    torch.manual_seed(seed)
    return PixelSample(
        render,
        truth,
        sdmap,
        opacity,
        torch.randn_like(render),
        torch.randn_like(render[:, 0]),
        torch.full((2,), t),
        1,
        (0, 2),
        (3, 1),
        torch.rand(2, FRAMES),
    )


def generator():
    torch.manual_seed(3)
    return PixelGenerator(PixelSizes((8, 8, 8), detail=8, hidden=4))


def test_terms_are_what_they_are_called():
    net = generator()
    s = sample()
    found = pixel_losses(
        net,
        s,
        net.start(s.render[:, 0]),
        PixelObjectives(),
        lambda a, b: (a - b).abs().amax((1, 2, 3)),
    )
    state = net.start(s.render[:, 0])
    made = []
    for i in range(FRAMES):
        if i == 1:  # the flow term: the velocity of the interpolant, on the rollout's history
            z_1 = pixel_source(s.render[:, 1], s.opacity[:, 1], s.eps_flow)
            z_t = 0.6 * s.truth[:, 1] + 0.4 * z_1
            guess, _ = net(s.render[:, 1], s.opacity[:, 1], s.sdmap[:, 1], state, z_t, s.t)
            velocity = (z_t - guess) / 0.4
            torch.testing.assert_close(
                found.flow, (velocity - (z_1 - s.truth[:, 1])).abs().mean(), atol=1e-5, rtol=0
            )
        out, state = net(
            s.render[:, i],
            s.opacity[:, i],
            s.sdmap[:, i],
            state,
            pixel_source(s.render[:, i], s.opacity[:, i], s.eps[:, i]),
        )
        made.append(out)
    torch.testing.assert_close(found.predictions, torch.stack(made, 1))
    error = found.predictions - s.truth
    torch.testing.assert_close(found.picture, error.abs().mean())
    torch.testing.assert_close(found.temporal, (error[:, 1:] - error[:, :-1]).abs().mean())
    torch.testing.assert_close(
        found.perceptual, error[:, [0, 2], 3:, 1:].abs().amax((2, 3, 4)).mean()
    )
    torch.testing.assert_close(found.grid, grid_term(found.predictions, s.truth))
    total = (
        found.picture
        + 0.1 * found.perceptual
        + 0.25 * found.temporal
        + 0.25 * found.flow
        + 0.01 * found.grid
    )
    torch.testing.assert_close(found.total, total)
    assert torch.equal(found.state.output, made[-1].clamp(-1, 1))


@pytest.mark.parametrize(("horizon", "reaches"), [(1, 0), (2, 0), (3, 2), (4, 2)])
def test_gradients_pass_through_the_last_k_frames(horizon, reaches):
    net = generator()
    s = sample()
    eps = s.eps.clone().requires_grad_()
    found = pixel_losses(
        net,
        replace(s, eps=eps),
        net.start(s.render[:, 0]),
        PixelObjectives(0, 0, 0, horizon=horizon),
        None,
    )
    (gradient,) = torch.autograd.grad(found.predictions[:, 2].square().mean(), eps)
    reached = [i for i in range(FRAMES) if bool(gradient[:, i].any())]
    assert len(reached) - 1 == reaches
    assert not found.state.hidden.requires_grad


def weights(path):
    return load_weights(path / STATE_FILE)


def test_a_resumed_run_ends_with_equal_weights_and_state(tmp_path):
    train_per_frame(run_of(), tmp_path / "whole", None)
    train_per_frame(run_of(), tmp_path / "cut", None, stop_at=2)
    bundle = train_per_frame(run_of(), tmp_path / "cut", None)
    one = weights(tmp_path / "whole")
    other = weights(tmp_path / "cut")
    assert any(key.startswith("carried.") for key in one)
    assert one.keys() == other.keys()
    assert all(torch.equal(value, other[key]) for key, value in one.items())
    saved = parts_of(load_weights(bundle))["generator"]
    assert torch.equal(saved["mix.weight"], one["average.mix.weight"].half())


def test_a_run_goes_on_from_another_runs_checkpoint(tmp_path):
    train_per_frame(run_of(), tmp_path / "first", None)
    begin = tmp_path / "first" / STATE_FILE
    train_per_frame(run_of(init=begin, keep_every=1), tmp_path / "next", None, stop_at=1)
    assert float(weights(tmp_path / "next")["moment.step.mix.weight"]) == 5  # its moments go on
    assert (tmp_path / "next" / "fixer-000001.safetensors").is_file()
    wide = fixer_settings("onefixer", (*SMALL, "generator.detail=12"))
    assert isinstance(wide, PixelFixerSettings)
    with pytest.raises(InputError):
        train_per_frame(replace(run_of(init=begin), settings=wide), tmp_path / "wide", None)


def test_it_learns(tmp_path):
    seen = []
    train_per_frame(
        run_of(24, 20), tmp_path, None, report=lambda step, numbers: seen.append(numbers["picture"])
    )
    assert sum(seen[-4:]) < 0.7 * sum(seen[:4])


def test_a_blend_that_is_sure_of_the_wrong_source_learns_from_the_choice_term_where_the_picture_teaches_nothing():
    truth = torch.zeros(1, 16, 16, 3)
    colour = torch.stack(
        [torch.full_like(truth, 0.1), truth], dim=1
    )  # the render is wrong, the reference right
    weight = torch.full((1, 1, 16, 16, 1), -12.0, requires_grad=True)
    sources = Sources(
        colour,
        torch.cat([torch.zeros(1, 1, 16, 16, 1), weight], dim=1),
        torch.ones(1, 2, 16, 16, 1),
    )
    (by_picture,) = torch.autograd.grad(
        (mix(sources)[0] - truth).abs().mean(), weight, retain_graph=True
    )
    (by_choice,) = torch.autograd.grad(choice_term(sources, truth), weight)
    assert by_choice.sum() < -0.5
    assert abs(float(by_picture.sum())) < 1e-4
    nowhere = sources._replace(
        holds=torch.cat([torch.ones(1, 1, 16, 16, 1), torch.full((1, 1, 16, 16, 1), 1e-6)], dim=1)
    )
    assert float(choice_term(nowhere, truth).detach()) < 0.1, (
        "a reference that holds nowhere is not to be chosen"
    )


def test_a_run_on_a_device_equals_the_processors_and_goes_on_there(tmp_path, monkeypatch):
    wanted = load_weights(train_per_frame(run_of(), tmp_path / "host", None))
    waits = []
    with pretended_device(monkeypatch) as traffic:
        run = run_of(device="cuda")

        def report(step, numbers):
            waits.append(sum(traffic.waits.values()))
            traffic.reset()

        train_per_frame(run, tmp_path / "device", None, 2, report)
    found = load_weights(train_per_frame(run_of(), tmp_path / "device", None))
    assert all(torch.equal(found[key], value) for key, value in wanted.items())
    assert waits[-1] == 1
