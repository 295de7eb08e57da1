"""Training on a pretended device: the weights of the CPU, one wait an update; and in processes that
share an update.
"""

import os
import socket
from dataclasses import replace
from functools import partial

import pytest
import torch

from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.core.devices import require_device
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.network.checkpoints import load_weights
from alpasim_plugin.lab.training import vae
from alpasim_plugin.lab.training.clips import CropSize
from alpasim_plugin.lab.training.fixer_run import train_fixer
from alpasim_plugin.lab.training.pixel_run import train_per_frame
from alpasim_plugin.lab.training.processes import join_ranks
from alpasim_plugin.lab.training.trainer import STATE_FILE, Schedule, Trainer
from alpasim_plugin.lab.training.vae import VaeRecipe
from tests.examples import first_of
from tests.lab.training.generator_runs import (
    brightness,
    data,  # noqa: F401 - data is a fixture
    run_of,
)
from tests.lab.training.pixel_runs import Streams
from tests.lab.training.pixel_runs import run_of as per_frame_run
from tests.lab.training.trainer_cases import batch, trainer
from tests.pretended_device import pretended_device, traffic


@pytest.fixture
def waits(monkeypatch):
    """Return the waits of every update, without those of its checkpoint."""
    found = []
    update = Trainer._update

    def counted(trainer):
        traffic.reset()
        numbers = update(trainer)
        found.append(sum(traffic.waits.values()))
        assert traffic.bytes_pinned == traffic.bytes_up
        return numbers

    monkeypatch.setattr(Trainer, "_update", counted)
    return found


def trained(recipe, data, folder, device, monkeypatch):
    distance = "brightness", brightness
    if recipe == "vae":
        monkeypatch.setattr(vae, "MEASURED_FRAMES", 13)
        monkeypatch.setattr(vae, "VaeRecipe", partial(VaeRecipe, size=CropSize(5, 32, 48)))
        monkeypatch.setattr(
            TinyVAE,
            "random",
            lambda seed: vae.load_tiny_vae(data / "vae.safetensors").requires_grad_(),
        )
        return vae.train_vae(data, None, folder / "run", 2, 0, None, device=device)
    run = replace(run_of(data, recipe), device=device)
    return train_fixer(run, folder / "run", distance)


@pytest.mark.parametrize("recipe", first_of(["vae", "V9", "base"]))
def test_a_recipe_on_a_device_equals_the_processors(recipe, data, tmp_path, monkeypatch, waits):
    with pretended_device(monkeypatch):
        found = load_weights(trained(recipe, data, tmp_path / "device", "cuda", monkeypatch))
    assert waits == [1, 1]
    wanted = load_weights(trained(recipe, data, tmp_path / "host", "cpu", monkeypatch))
    for name, due in wanted.items():
        torch.testing.assert_close(found[name], due, rtol=0, atol=1e-3)


def assert_same_weights(one, other):
    found = load_weights(other / STATE_FILE)
    for name, due in load_weights(one / STATE_FILE).items():
        torch.testing.assert_close(found[name], due)


def test_a_run_goes_on_on_another_device_and_makes_batches_ahead(tmp_path, monkeypatch):
    host, both, schedule = tmp_path / "host", tmp_path / "both", Schedule(steps=6)
    trainer(host, schedule).run()
    trainer(both, schedule).run(until=2)
    made = []
    made_at = []
    with pretended_device(monkeypatch):
        there = trainer(both, schedule, device="cuda")
        monkeypatch.setattr(there, "_batch", lambda index: made.append(index) or batch(index))
        there.run(lambda step, numbers: made_at.append(len(made)), until=5)
    assert (made, made_at) == ([2, 3, 4], [2, 3, 3])
    trainer(both, schedule).run()
    assert_same_weights(host, both)


def batches_in_a_rank(folder):
    trainer(folder, Schedule(steps=3, accumulate=4, save_every=1)).run()


def streams_in_a_rank(folder):
    train_per_frame(per_frame_run(), folder, None, stop_at=2)
    train_per_frame(per_frame_run(), folder, None, stop_at=3)


def in_a_rank(rank, job, folder, port):
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": "2"}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    job(folder)
    with pytest.raises(InputError):
        trainer(folder / "odd", Schedule(steps=3, accumulate=3))
    streams = Streams()
    streams.batch = 3
    with pytest.raises(InputError):
        train_per_frame(replace(per_frame_run(), streams=streams), folder / "odd", None)


@pytest.mark.slow
@pytest.mark.parametrize("job", [batches_in_a_rank, streams_in_a_rank])
def test_two_processes_train_to_the_weights_and_the_log_of_one(job, tmp_path):
    one = tmp_path / "one"
    two = tmp_path / "two"
    job(one)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    torch.multiprocessing.spawn(in_a_rank, (job, two, port), nprocs=2)
    assert_same_weights(one, two)
    assert len((two / "log.jsonl").read_text().splitlines()) == 3


def test_processes_on_cards_join_by_nccl_each_with_a_card_of_its_own(monkeypatch):
    chosen = []
    monkeypatch.setattr(
        torch.distributed,
        "init_process_group",
        lambda backend, device_id: chosen.append((backend, device_id)),
    )
    monkeypatch.setattr(torch.distributed, "get_rank", lambda: 1)
    monkeypatch.setattr(torch.distributed, "get_world_size", lambda: 2)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert join_ranks(torch.device("cpu")) == (0, 1)
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert require_device("cuda") == "cuda:1"
    card = torch.device("cuda:1")
    assert join_ranks(card) == join_ranks(torch.device("cpu")) == (1, 2)
    assert chosen == [("nccl", card), ("gloo", None)]
