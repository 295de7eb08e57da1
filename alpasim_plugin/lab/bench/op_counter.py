"""Count the operations of network code: floating-point work, memory traffic, peak memory; also on
the ``meta`` device, without numbers.

FLOPs are those of `torch.utils.flop_counter`. Traffic is what each operation reads and writes when
it runs alone, as unfused kernels do. Views cost nothing. Attention is one operation that reads
queries, keys and values and writes its result, as fused kernels do.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

ATTENTION = torch.ops.aten.scaled_dot_product_attention
# Operations that run no kernel: allocation, aliases, shape queries.
FREE = {
    "empty",
    "empty_like",
    "new_empty",
    "empty_strided",
    "detach",
    "alias",
    "lift_fresh",
    "_local_scalar_dense",
    "is_same_size",
}


@dataclass(frozen=True)
class Op:
    """One operation as it ran."""

    name: str
    flops: int  # two per multiply-add; only of products and convolutions
    bytes: int  # read and written
    dtype: torch.dtype  # of its result


class OpCounter(TorchDispatchMode):
    """Record every operation that runs inside ``with counter:``; may be entered again to add more.

    Run the code under `torch.inference_mode`: elsewhere attention is expanded before it can be
    counted as one operation.

    Attributes:
        ops: What ran, in order.
        peak_bytes: Most bytes alive at once of all tensors made while counting.

    Example:
        >>> with torch.inference_mode(), OpCounter() as counter:
        ...     _ = torch.empty(2, 3, device="meta") @ torch.empty(3, 5, device="meta")
        >>> counter.flops, counter.bytes
        (60, 124)
    """

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.ops: list[Op] = []
        self.peak_bytes = 0
        self._alive: dict[int, tuple[StorageWeakRef, int]] = {}

    @property
    def flops(self) -> int:
        """Floating-point operations of all products and convolutions."""
        return sum(op.flops for op in self.ops)

    @property
    def bytes(self) -> int:
        """Bytes read and written, every operation alone."""
        return sum(op.bytes for op in self.ops)

    def __torch_dispatch__(
        self,
        func: Any,
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        kwargs = kwargs or {}
        name = func._schema.name.removeprefix("aten::")
        if func._overloadpacket is ATTENTION:
            out = (
                torch.empty_like(args[0]) if args[0].is_meta else func(*args, **kwargs)
            )  # meta would expand the scores
            flops = sdpa_flop_count(*(x.shape for x in args[:3]))  # type: ignore[no-untyped-call]
        else:
            with FlopCounterMode(display=False) as counter:
                out = func(*args, **kwargs)
            flops = counter.get_total_flops()
        self._track(out, (args, kwargs))
        results = [x for x in tree_leaves(out) if isinstance(x, Tensor)]
        if results and name not in FREE and not _is_view(func):
            self.ops.append(Op(name, flops, _moved(name, args, kwargs, results), results[0].dtype))
        return out

    def _track(self, made: Any, given: Any) -> None:
        """Note which storages are new and which are gone; a result in the storage of an argument is
        not new.
        """
        old = {x.untyped_storage()._cdata for x in tree_leaves(given) if _is_strided(x)}
        for x in tree_leaves(made):
            if _is_strided(x) and (storage := x.untyped_storage())._cdata not in old:
                self._alive[storage._cdata] = (StorageWeakRef(storage), storage.nbytes())  # type: ignore[no-untyped-call]
        self._alive = {key: kept for key, kept in self._alive.items() if not kept[0].expired()}  # type: ignore[no-untyped-call]
        self.peak_bytes = max(self.peak_bytes, sum(size for _, size in self._alive.values()))


def _moved(
    name: str, args: tuple[Any, ...], kwargs: Mapping[str, Any], results: list[Tensor]
) -> int:
    if name in {
        "index_copy_",
        "index_copy",
    }:  # touches the rows it writes, not the buffer around them
        return 2 * _bytes(args[3]) + _bytes(args[2])
    return sum(_bytes(x) for x in tree_leaves((args, kwargs, results)) if isinstance(x, Tensor))


def _bytes(x: Tensor) -> int:
    """Return the bytes that a tensor covers; a broadcast dimension is stored once."""
    if x.layout != torch.strided:
        return x.numel() * x.element_size()
    return (
        math.prod(n for n, step in zip(x.shape, x.stride(), strict=True) if step or n == 0)
        * x.element_size()
    )


def _is_strided(x: Any) -> bool:
    return isinstance(x, Tensor) and x.layout == torch.strided


def _is_view(func: Any) -> bool:
    returned = func._schema.returns
    return bool(returned) and all(
        r.alias_info is not None and not r.alias_info.is_write for r in returned
    )
