"""Several ranks train to the weights of one: the same rows, the mean of their gradients, one
checkpoint.
"""

from __future__ import annotations

import threading
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import Tensor

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.fixers.network.pixel_generator import PixelGenerator, PixelSizes
from alpasim_plugin.lab.training.pixel_run import train_per_frame
from alpasim_plugin.lab.training.ranks import ALONE, Ranks, Report, in_ranks
from tests.lab.training.test_pixel_training import run_of, weights


class Threads:
    """An exchange between threads of this process."""

    def __init__(self, count: int) -> None:
        self.given: list[Tensor] = [torch.empty(0)] * count
        self.meet = threading.Barrier(count, timeout=60)

    def of(self, rank: int) -> Exchanging:
        return Exchanging(self, rank)


class Exchanging:
    def __init__(self, all_of_them: Threads, rank: int) -> None:
        self.all, self.rank = all_of_them, rank

    def gather(self, value: Tensor) -> list[Tensor]:
        self.all.given[self.rank] = value.clone()
        self.all.meet.wait()
        out = list(self.all.given)
        self.all.meet.wait()
        return out

    def sum(self, values: Tensor) -> None:
        values.copy_(torch.stack(self.gather(values)).sum(0))


@pytest.fixture(autouse=True)
def one_seeding_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Threads share torch's random state, from which initial weights are drawn; processes do
    not.
    """
    lock, draw = threading.Lock(), PixelGenerator.random

    def locked(sizes: PixelSizes, seed: int) -> PixelGenerator:
        with lock:
            return draw(sizes, seed)

    monkeypatch.setattr(PixelGenerator, "random", locked)


def in_threads(folder: Path, stop_at: int | None = None) -> None:
    shared = Threads(2)
    trained = [
        threading.Thread(
            target=train_per_frame,
            args=(run_of(), folder, None, stop_at, Ranks(rank, 2, shared.of(rank))),
        )
        for rank in range(2)
    ]
    for thread in trained:
        thread.start()
    for thread in trained:
        thread.join()


def assert_close(folder: Path, other: Path) -> None:
    one, two = weights(folder), weights(other)
    assert one.keys() == two.keys()
    for key, value in one.items():
        torch.testing.assert_close(two[key], value, atol=1e-5, rtol=1e-4, msg=key)


def test_two_ranks_train_as_one_and_another_number_goes_on(tmp_path: Path) -> None:
    train_per_frame(run_of(), tmp_path / "one", None)
    in_threads(tmp_path / "two")
    assert_close(tmp_path / "one", tmp_path / "two")
    in_threads(tmp_path / "mixed", stop_at=2)
    train_per_frame(run_of(), tmp_path / "mixed", None)
    assert_close(tmp_path / "one", tmp_path / "mixed")
    assert len((tmp_path / "two" / "log.jsonl").read_text().splitlines()) == 4


def test_rows_of_a_batch() -> None:
    assert [Ranks(rank, 3).rows(6) for rank in range(3)] == [slice(0, 2), slice(2, 4), slice(4, 6)]
    assert ALONE.rows(5) == slice(0, 5)
    with pytest.raises(InputError):
        Ranks(0, 2).rows(5)


def fail(ranks: Ranks, report: Report | None) -> None:
    del report
    if ranks.rank == 1:
        raise ValueError("the second has no memory left")
    ranks.average([torch.zeros(3)])


@pytest.mark.slow
def test_two_processes_train_as_one(tmp_path: Path) -> None:
    train_per_frame(run_of(), tmp_path / "one", None)
    in_ranks(partial(train_per_frame, run_of(), tmp_path / "two", None, None), 2)
    assert_close(tmp_path / "one", tmp_path / "two")


@pytest.mark.slow
def test_a_rank_that_fails_is_told_and_ends_the_others() -> None:
    with pytest.raises(InfrastructureError):
        in_ranks(fail, 2)
