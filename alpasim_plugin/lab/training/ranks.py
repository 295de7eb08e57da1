"""Data-parallel training: processes that compute the gradients of their own rows of a batch and
average them.

Every rank has the same weights and optimiser, sees the same updates and, with averaged gradients,
stays equal to the others. Only the first writes files. The number of ranks is no part of a run: a
checkpoint continues with any other.
"""

from __future__ import annotations

import multiprocessing
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor

from alpasim_plugin.core.errors import InfrastructureError, InputError, SimrunError
from alpasim_plugin.core.subprocesses import end_with_parent

T = TypeVar("T")
Report = Callable[[int, Mapping[str, float]], None]
DOING = "training in several processes"
GRACE_S = 10.0  # for the other ranks to end after the first


class Exchange(Protocol):
    """What the ranks do together; every rank calls the same methods in the same order."""

    def sum(self, values: Tensor) -> None:
        """Replace a vector by its sum over all ranks."""
        ...

    def gather(self, value: Tensor) -> list[Tensor]:
        """Return every rank's tensor, in their order; all of one shape."""
        ...


class TorchExchange:
    """`Exchange` through the process group of torch."""

    def sum(self, values: Tensor) -> None:
        """Replace a vector by its sum over all ranks."""
        torch.distributed.all_reduce(values)

    def gather(self, value: Tensor) -> list[Tensor]:
        """Return every rank's tensor, in their order."""
        out = [torch.empty_like(value) for _ in range(torch.distributed.get_world_size())]
        torch.distributed.all_gather(out, value.contiguous())
        return out


@dataclass(frozen=True)
class Ranks:
    """This process among those of a run.

    Args:
        rank: Its number, from 0.
        count: How many there are.
        exchange: How they exchange tensors; None for one alone.
    """

    rank: int = 0
    count: int = 1
    exchange: Exchange | None = None

    @property
    def is_first(self) -> bool:
        """Whether this one writes the files and reports."""
        return self.rank == 0

    def rows(self, batch: int) -> slice:
        """Return this rank's rows of a batch.

        Raises:
            InputError: The batch cannot be divided.
        """
        if batch % self.count:
            raise InputError(
                f"{batch} rows in {self.count} processes: they cannot be divided equally",
                "choose a divisor",
            )
        size = batch // self.count
        return slice(self.rank * size, (self.rank + 1) * size)

    def average(self, tensors: Sequence[Tensor]) -> None:
        """Replace tensors by their means over the ranks, in place."""
        if self.exchange is None or not tensors:
            return
        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        self.exchange.sum(flat)
        flat /= self.count
        for tensor, mean in zip(
            tensors, torch.split(flat, [tensor.numel() for tensor in tensors]), strict=True
        ):
            tensor.copy_(mean.view_as(tensor))

    def joined(self, rows: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return tensors whose first axis is the batch with the rows of all ranks."""
        if self.exchange is None:
            return dict(rows)
        return {name: torch.cat(self.exchange.gather(rows[name])) for name in sorted(rows)}


ALONE = Ranks()


def in_ranks(
    work: Callable[[Ranks, Report | None], T], count: int, report: Report | None = None
) -> T:
    """Run ``work`` in ``count`` processes, of which this is the first, and return its result here.

    The others end with this process, however it ends.

    Args:
        work: Picklable; called with the process's `Ranks`, and ``report`` in the first.
        count: Number of processes; 1 calls ``work`` alone.
        report: Need not be picklable.

    Raises:
        InfrastructureError: Another rank failed; its message comes with it.
        Exception: Whatever ``work`` raises here.
    """
    if count == 1:
        return work(ALONE, report)
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory(prefix="simrun-ranks-") as folder:
        meeting = Path(folder) / "meeting"
        failures = context.SimpleQueue()
        others = [
            context.Process(
                target=_other,
                args=(work, rank, count, meeting, torch.get_num_threads(), failures),
                daemon=True,
            )
            for rank in range(1, count)
        ]
        for process in others:
            process.start()
        try:
            return _ranked(work, 0, count, meeting, report)
        except RuntimeError as error:  # how the group reports a rank that is gone
            for process in others:
                process.join(GRACE_S)
            if failures.empty():
                raise
            rank, found = failures.get()
            raise InfrastructureError(
                f"process {rank + 1} of {count}: {found}", "run again: training resumes"
            ) from error
        finally:
            for process in others:
                process.join(GRACE_S)
                process.kill()


def _other(
    work: Callable[[Ranks, Report | None], Any],
    rank: int,
    count: int,
    meeting: Path,
    threads: int,
    failures: Any,
) -> None:
    end_with_parent()
    torch.set_num_threads(threads)
    try:
        _ranked(work, rank, count, meeting, None)
    except (
        SimrunError
    ) as error:  # the first rank raises the same, unless it concerns this one alone
        failures.put((rank, str(error)))
    except Exception as error:
        failures.put((rank, f"{type(error).__name__}: {error}"))


def _ranked(
    work: Callable[[Ranks, Report | None], T],
    rank: int,
    count: int,
    meeting: Path,
    report: Report | None,
) -> T:
    torch.distributed.init_process_group(
        "gloo", init_method=f"file://{meeting}", rank=rank, world_size=count
    )
    try:
        return work(Ranks(rank, count, TorchExchange()), report)
    finally:
        torch.distributed.destroy_process_group()
