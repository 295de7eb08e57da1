"""Devices by name: ``cpu``, ``cuda`` (the first card) or ``cuda:N``."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import AbstractContextManager
from threading import Lock
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.types import F64

if TYPE_CHECKING:
    from torch import Tensor, device, dtype

S = TypeVar("S")
WARM_UP = 3  # calls before a function is recorded


def require_device(name: str) -> str:
    """Return a device's full name, ``cpu`` or ``cuda:N``; nothing falls back to another device.
    In a process that torchrun started ``cuda`` is the card of its number.

    Raises:
        InputError: Neither ``cpu``, ``cuda`` nor ``cuda:N``.
        InfrastructureError: torch sees no such card.
    """
    if re.fullmatch(r"cpu|cuda(:[0-9]{1,3})?", name) is None:
        raise InputError(f"--device {name}: no such device", "Use cpu, cuda or cuda:N")
    if name == "cpu":
        return name
    import torch

    number = int(name.partition(":")[2] or os.environ.get("LOCAL_RANK", "0"))
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if number >= count:
        raise InfrastructureError(
            f"--device {name}: torch {torch.__version__} sees {count} CUDA devices",
            "Install torch with CUDA on a machine with an NVIDIA GPU, or choose --device cpu",
        )
    # Float32 is float32: neither products nor convolutions round to TF32.
    torch.backends.cuda.matmul.allow_tf32 = False
    torch.backends.cudnn.allow_tf32 = False
    return f"cuda:{number}"


def implementation(place: device | str, host: Any, card: Any) -> Any:
    """Return what serves a device: the CPU's own or that of cards. Nobody else compares devices."""
    return host if str(place) == "cpu" else card


def batched(
    items: Sequence[S], key: Callable[[S], Hashable], make: Callable[[list[S]], Any]
) -> list[Any]:
    """Return what a function makes of each item, in order; it is called once for all that share a
    key, such as their size.
    """
    groups: dict[Hashable, list[int]] = {}
    for index, item in enumerate(items):
        groups.setdefault(key(item), []).append(index)
    made: dict[int, Any] = {}
    for indices in groups.values():
        made |= zip(indices, make([items[index] for index in indices]), strict=True)
    return [made[index] for index in range(len(items))]


def facts_of(place: str) -> dict[str, Any]:
    """Return a card's name, memory, compute capability and version of CUDA; nothing of the CPU."""
    if implementation(place, True, False):
        return {}
    import torch

    properties = torch.cuda.get_device_properties(place)
    return {
        "card": properties.name,
        "memory_gib": round(properties.total_memory / 2**30, 1),
        "compute_capability": f"{properties.major}.{properties.minor}",
        "cuda": torch.version.cuda,
    }


def autocast(place: device, dtype: dtype | None = None) -> AbstractContextManager[Any]:
    """Return a context in which products of a device are rounded to a type; None: they are not."""
    import torch

    kind = place.type.replace("meta", "cpu")  # nothing is rounded where nothing is computed
    return torch.autocast(kind, dtype or torch.bfloat16, enabled=dtype is not None)


def share_card(device: str, workers: int) -> None:
    """Leave every worker of a card an equal share of its memory."""
    if implementation(device, False, workers > 1):
        import torch

        torch.cuda.set_per_process_memory_fraction(1 / workers, device)


def upload(array: npt.ArrayLike | Tensor, place: device | str) -> Tensor:
    """Return a copy of an array as a tensor of a device, or a tensor there, for which the host does
    not wait: a card reads it from pinned memory.
    """
    import torch

    tensor = array if isinstance(array, torch.Tensor) else torch.tensor(array)
    if str(place).startswith("cuda") and tensor.device.type == "cpu":
        tensor = tensor.pin_memory()
    return tensor.to(place, non_blocking=True)


def upload_together(arrays: Sequence[F64], place: device | str) -> list[Tensor]:
    """Return copies of arrays as tensors of a device, sent in one copy; see `upload`. Each begins at
    a multiple of 16 bytes: Triton compiles a kernel once more for a tensor that does not.
    """
    import torch

    flat = [np.append(array, np.zeros(array.size % 2)) for array in arrays]
    pieces = torch.split(upload(np.concatenate(flat), place), [part.size for part in flat])
    return [
        piece[: array.size].view(array.shape) for piece, array in zip(pieces, arrays, strict=True)
    ]


def download(*parts: Tensor) -> list[Any]:
    """Return tensors as arrays, brought to the host in one copy: each copy waits for the device."""
    import torch

    data = torch.cat([part.contiguous().view(-1).view(torch.uint8) for part in parts])
    pieces = torch.split(data.cpu(), [part.nbytes for part in parts])
    return [
        piece.clone().view(part.dtype).view(part.shape).numpy()
        for piece, part in zip(pieces, parts, strict=True)
    ]


Sizes = tuple[tuple[str, tuple[int, ...], "dtype"], ...]  # name, shape and type of tensors


def sizes_of(tensors: Mapping[str, Tensor]) -> Sizes:
    """Return what a graph for these tensors is recorded for."""
    return tuple((name, tuple(part.shape), part.dtype) for name, part in tensors.items())


class CapturedFunction:
    """A function recorded as a CUDA graph: a call copies its tensors in, replays all kernels by
    one launch, and copies the results out.

    Args:
        function: Tensors by name to a tuple of tensors; it must not wait for the device.
        sizes: Of its tensors.
        device: The card.
    """

    def __init__(
        self, function: Callable[..., tuple[Tensor, ...]], sizes: Sizes, device: device
    ) -> None:
        import torch

        self._inputs = {
            name: torch.zeros(shape, dtype=dtype, device=device) for name, shape, dtype in sizes
        }
        self._graph = torch.cuda.CUDAGraph()
        self._lock = Lock()
        with torch.cuda.device(device):
            main, side = torch.cuda.current_stream(), torch.cuda.Stream()  # type: ignore[no-untyped-call]
            side.wait_stream(main)
            with torch.cuda.stream(side):  # libraries choose their kernels in the first calls
                for _ in range(WARM_UP):
                    function(**self._inputs)
            main.wait_stream(side)
            with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
                self._outputs = function(**self._inputs)

    def __call__(self, tensors: Mapping[str, Tensor]) -> list[Tensor]:
        """Return the function's results."""
        with self._lock:
            for name, part in tensors.items():
                self._inputs[name].copy_(part)
            self._graph.replay()
            return [part.clone() for part in self._outputs]


def known_false(mask: Tensor) -> bool:
    """Return whether a mask is false everywhere, where that is known without waiting."""
    return implementation(mask.device, True, False) and not bool(mask.any())


def true_rows(mask: Tensor) -> tuple[Tensor, Tensor]:
    """Return rows ``(S,)`` and their weights ``(S,)``: those where a mask ``(N,)`` is true, with
    weight 1; of a device, whose count the host would wait for, all of them with weights 1 and 0.
    """
    import torch

    if implementation(mask.device, True, False):
        rows = torch.nonzero(mask)[:, 0]
        return rows, torch.ones(len(rows))
    return torch.arange(len(mask), device=mask.device), mask.float()
