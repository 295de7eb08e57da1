"""Count what a piece of network code does: operations, floating-point work, memory traffic; also on the ``meta`` device, without numbers.

Traffic is what each operation reads and writes when it runs alone, which is what eager kernels do. Views cost nothing. Attention counts
as one operation that reads queries, keys and values and writes its result, as fused kernels do; on ``meta`` it is not expanded.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

FREE = {"empty", "empty_like", "new_empty", "empty_strided", "detach", "alias", "lift_fresh", "_local_scalar_dense", "is_same_size"}


@dataclass(frozen=True)
class Op:
    """One operation as it ran."""

    name: str
    flops: int  # two a multiply-add; only of products and convolutions
    bytes: int  # read and written
    dtype: torch.dtype  # of its result


@dataclass
class Ledger:
    """Operations in the order they ran.

    Args:
        ops: What ran.
        peak_bytes: Most bytes that were alive at once of everything made while counting.
    """

    ops: list[Op] = field(default_factory=list)
    peak_bytes: int = 0

    @property
    def flops(self) -> int:
        """Floating-point operations of all products and convolutions."""
        return sum(op.flops for op in self.ops)

    @property
    def bytes(self) -> int:
        """Bytes read and written, every operation alone."""
        return sum(op.bytes for op in self.ops)

    def by_name(self) -> dict[str, tuple[int, int, int]]:
        """Return calls, flops and bytes of every kind of operation, most bytes first."""
        sums: dict[str, tuple[int, int, int]] = {}
        for op in self.ops:
            calls, flops, moved = sums.get(op.name, (0, 0, 0))
            sums[op.name] = (calls + 1, flops + op.flops, moved + op.bytes)
        return dict(sorted(sums.items(), key=lambda item: -item[1][2]))


@contextmanager
def counting() -> Iterator[Ledger]:
    """Count everything that runs inside.

    Example:
        >>> with counting() as ledger:
        ...     _ = torch.empty(2, 3, device="meta") @ torch.empty(3, 5, device="meta")
        >>> ledger.flops, ledger.bytes
        (60, 124)
    """
    ledger = Ledger()
    dispatch = _Dispatch(ledger)
    with _Attention(ledger, dispatch), dispatch:
        yield ledger


class _Attention(TorchFunctionMode):
    """Count attention as one operation, before it is expanded."""

    def __init__(self, ledger: Ledger, dispatch: _Dispatch) -> None:
        self.ledger, self.dispatch = ledger, dispatch

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        if func is not F.scaled_dot_product_attention:
            return func(*args, **kwargs)
        q, k, v = args[:3]
        flops = 2 * math.prod(q.shape[:-1]) * k.shape[-2] * (q.shape[-1] + v.shape[-1])
        shape = (*q.shape[:-1], v.shape[-1])
        moved = sum(_bytes(x) for x in (q, k, v)) + math.prod(shape) * q.element_size()
        self.ledger.ops.append(Op("attention", flops, moved, q.dtype))
        self.dispatch.paused = True
        try:
            # As fused kernels lay it out: tokens before heads in memory where the queries came that way.
            return torch.empty_like(q, memory_format=torch.preserve_format) if q.is_meta else func(*args, **kwargs)
        finally:
            self.dispatch.paused = False


class _Dispatch(TorchDispatchMode):
    """Count everything else, as it reaches the kernels."""

    def __init__(self, ledger: Ledger) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.ledger, self.paused = ledger, False
        self._alive: dict[int, tuple[StorageWeakRef, int]] = {}

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None) -> Any:
        out = func(*args, **(kwargs or {}))
        self._watch(out, (args, kwargs))
        name = func._schema.name.removeprefix("aten::")
        if self.paused or name.split(".")[0] in FREE or _is_view(func):
            return out
        results = [x for x in tree_leaves(out) if isinstance(x, Tensor)]
        if results:
            moved = _moved(name, args, kwargs or {}, results)
            self.ledger.ops.append(Op(name, _flops(name, args, results[0]), moved, results[0].dtype))
        return out

    def _watch(self, made: Any, given: Any) -> None:
        """Note which storages came to life and which are gone; results that lie in an argument's storage are not new."""
        old = {x.untyped_storage()._cdata for x in tree_leaves(given) if _is_plain(x)}
        for x in tree_leaves(made):
            if _is_plain(x) and (storage := x.untyped_storage())._cdata not in old:
                self._alive[storage._cdata] = (StorageWeakRef(storage), storage.nbytes())  # type: ignore[no-untyped-call]
        self._alive = {key: kept for key, kept in self._alive.items() if not kept[0].expired()}  # type: ignore[no-untyped-call]
        self.ledger.peak_bytes = max(self.ledger.peak_bytes, sum(size for _, size in self._alive.values()))


def _flops(name: str, args: tuple[Any, ...], out: Tensor) -> int:
    if name in {"mm", "bmm", "linear", "_int_mm"}:
        return 2 * out.numel() * int(args[0].shape[-1])
    if name in {"addmm", "baddbmm"}:
        return 2 * out.numel() * int(args[1].shape[-1])
    if "conv" in name and len(args) > 1 and isinstance(args[1], Tensor) and args[1].ndim > 2:  # a kernel holds its own share of the inputs
        return 2 * out.numel() * math.prod(args[1].shape[1:])
    return 0


def _moved(name: str, args: tuple[Any, ...], kwargs: Mapping[str, Any], results: list[Tensor]) -> int:
    if name in {"index_copy_", "index_copy"}:  # touches the rows it writes, not the buffer around them
        return 2 * _bytes(args[3]) + _bytes(args[2])
    return sum(_bytes(x) for x in tree_leaves((args, kwargs, results)) if isinstance(x, Tensor))


def _bytes(x: Tensor) -> int:
    """Return the bytes that a tensor covers; a broadcast dimension is stored once."""
    if x.layout != torch.strided:
        return x.numel() * x.element_size()
    return math.prod(n for n, step in zip(x.shape, x.stride(), strict=True) if step or n == 0) * x.element_size()


def _is_plain(x: Any) -> bool:
    return isinstance(x, Tensor) and x.layout == torch.strided


def _is_view(func: Any) -> bool:
    returned = func._schema.returns
    return bool(returned) and all(r.alias_info is not None and not r.alias_info.is_write for r in returned)
