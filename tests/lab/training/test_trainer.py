"""The training loop: resuming gives equal weights, and a non-finite loss or a full disk loses
nothing.
"""

import json
import os

import pytest
import torch
from torch import nn
from torch.testing import assert_close

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.lab.training.trainer import BAD_FILE, PartSchedule, Schedule, Trainer
from tests.lab.training.trainer_cases import TRUTH, Linear, batch, trainer


def test_learns_and_averages(tmp_path):
    t = trainer(tmp_path, Schedule(steps=300, peak_lr=0.03, warmup=5, weight_decay=0.0, ema=0.9))
    t.run()
    assert_close(t.module.weight, TRUTH, atol=0.02, rtol=0)
    assert_close(t.averaged()["weight"], TRUTH, atol=0.02, rtol=0)
    assert set(t.averaged()) == {"weight", "bias", "fixed"}


def test_nan_stops_with_the_batch_saved_and_good_weights_kept(tmp_path):
    schedule = Schedule(steps=9)
    t = trainer(tmp_path, schedule, bad_at=4)
    with pytest.raises(InfrastructureError):
        t.run()
    assert torch.equal(torch.load(tmp_path / BAD_FILE, weights_only=True), batch(4))
    again = trainer(tmp_path, schedule)
    assert again.step == 4
    assert torch.isfinite(again.module.weight).all()
    again.run()
    assert again.step == 9


def test_of_several_batches_the_one_whose_loss_is_not_finite_is_saved(tmp_path):
    t = trainer(tmp_path, Schedule(steps=9, accumulate=3), bad_at=13)  # the second of update 4
    with pytest.raises(InfrastructureError) as caught:
        t.run()
    assert torch.equal(torch.load(tmp_path / BAD_FILE, weights_only=True), batch(13))
    assert "lower learning rate, begin in another folder" in caught.value.hint
    with pytest.raises(InputError):  # as the advice says
        trainer(tmp_path, Schedule(steps=9, accumulate=3, peak_lr=1e-5))
    assert trainer(tmp_path, Schedule(steps=9, accumulate=3)).step == 4


def test_folder_of_another_run_is_refused(tmp_path):
    trainer(tmp_path, Schedule(steps=2)).run()
    with pytest.raises(InputError):
        trainer(tmp_path, Schedule(steps=2), facts="b")
    with pytest.raises(InputError):
        trainer(tmp_path, Schedule(steps=3))


def test_learning_rate_rises_then_falls_along_a_cosine():
    s = Schedule(steps=110, peak_lr=1.0, warmup=10)
    assert s.lr(0) == pytest.approx(0.1)
    assert s.lr(10) == pytest.approx(1.0)
    assert s.lr(60) == pytest.approx(0.505)
    assert s.lr(110) == pytest.approx(0.01)

    s = Schedule(steps=110, peak_lr=2.0, warmup=10, decay="exponential", last_share=0.01)
    assert [s.lr(step) for step in (4, 10, 60, 110, 500)] == pytest.approx(
        [1.0, 2.0, 0.2, 0.02, 0.02]
    )
    assert [
        Schedule(steps=110, peak_lr=2.0, warmup=10, decay="constant").lr(step)
        for step in (4, 10, 110)
    ] == pytest.approx([1.0, 2.0, 2.0])


def test_full_disk_under_the_checkpoint_is_an_error_and_keeps_the_old_one(tmp_path, monkeypatch):
    t = trainer(tmp_path, Schedule(steps=4, save_every=2))
    t.run(until=2)

    def refuse(fd):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(InfrastructureError):
        t.run()
    monkeypatch.undo()
    assert trainer(tmp_path, Schedule(steps=4, save_every=2)).step == 2


class Two(nn.Module):
    """Two parts, of which one is trained in every third update."""

    def __init__(self):
        super().__init__()
        self.student = Linear()
        self.critic = Linear()


def two_parts(folder, schedule, parts):
    model = Two()

    def loss(x, index):
        trained = (model.critic, model.student) if index % 3 == 0 else (model.critic,)
        return torch.stack(
            [((x @ part.weight.T + part.bias - x @ TRUTH.T) ** 2).mean() for part in trained]
        ).sum(), {}

    return Trainer(model, folder, schedule, batch, loss, {}, parts=parts)


PARTS = {"student": PartSchedule(rate=0.5), "critic": PartSchedule(betas=(0.0, 0.9), clip=1e-3)}


def test_parts_have_rates_and_clips_of_their_own_and_rest_without_a_gradient(
    tmp_path,
):
    schedule = Schedule(steps=6, peak_lr=0.01, warmup=1, weight_decay=0.0, clip=100.0)
    t = two_parts(tmp_path, schedule, PARTS)
    t.run(until=1)
    first = {name: p.detach().clone() for name, p in t.parameters.items()}
    assert float(first["student.weight"].abs().max()) == pytest.approx(0.005, rel=1e-3), (
        "Adam's first step is the rate"
    )
    assert float(first["critic.weight"].abs().max()) == pytest.approx(0.01, rel=1e-3)
    average = t.average["student.weight"].clone()
    t.run(until=3)
    assert torch.equal(first["student.weight"], t.parameters["student.weight"])
    assert torch.equal(average, t.average["student.weight"])
    assert not torch.equal(first["critic.weight"], t.parameters["critic.weight"])
    rows = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert ["grad_norm.student" in row for row in rows] == [True, False, False]
    assert [group["weight_decay"] for group in t.optimiser.param_groups] == [0.0] * 4


def test_parts_resume_bit_for_bit_also_before_their_first_gradient(tmp_path):
    schedule = Schedule(steps=6, save_every=1)
    whole = two_parts(tmp_path / "whole", schedule, PARTS)
    whole.run()
    two_parts(tmp_path / "cut", schedule, PARTS).run(until=2)
    again = two_parts(tmp_path / "cut", schedule, PARTS)
    again.run()
    assert all(torch.equal(p, again.averaged()[name]) for name, p in whole.averaged().items())
    with pytest.raises(InputError):
        two_parts(tmp_path / "cut", schedule, {**PARTS, "student": PartSchedule(rate=1.0)})
