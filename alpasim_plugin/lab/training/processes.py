"""Processes that share an update, and what a card receives beside what it computes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch
from torch import Tensor, distributed

from alpasim_plugin.core.devices import implementation


def join_ranks(place: torch.device) -> tuple[int, int]:
    """Join the processes that torchrun started, by NCCL on cards and by gloo on CPUs; return this
    one's number and their count.
    """
    if "WORLD_SIZE" not in os.environ:
        return 0, 1
    if not distributed.is_initialized():
        backend = implementation(place, "gloo", "nccl")
        card: torch.device | None = implementation(place, None, place)
        distributed.init_process_group(backend, device_id=card)
    return distributed.get_rank(), distributed.get_world_size()


def rows_of_all(rows: Tensor, ranks: int) -> Tensor:
    """Return the rows of all processes, as many each, in the order of their numbers."""
    parts = [torch.empty_like(rows) for _ in range(ranks)]
    distributed.all_gather(parts, rows.contiguous())
    return torch.cat(parts)


def side_stream(place: torch.device) -> Callable[[], AbstractContextManager[None]]:
    """Return what makes contexts in which tensors are sent to a card beside what it computes; what
    it computes afterwards waits for them. Hold them until the host has waited for the card.
    """
    if implementation(place, True, False):
        return nullcontext
    stream = torch.cuda.Stream(place)  # type: ignore[no-untyped-call]

    @contextmanager
    def beside() -> Iterator[None]:
        with torch.cuda.stream(stream):
            yield
        torch.cuda.current_stream(place).wait_stream(stream)

    return beside
