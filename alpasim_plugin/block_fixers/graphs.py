"""Capture a function of tensors once and replay it: CUDA graphs, one per shape of the arguments.

A captured function uses fixed addresses. Arguments are copied into static buffers, the graph runs,
results are copied out; so the caller's tensors are not written to, and results stay valid after the
next call. Other tensors that the function uses (weights, a rolling cache) must keep their address.
Python code in the function runs at capture only: open and close cache blocks around the call.

There is no silent fallback. A call runs eagerly while its shape is new (`warmups`) or when `limit`
shapes have been recorded; `counts` holds how often. A function that cannot be captured is an error.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.utils._pytree import tree_flatten, tree_map_only

from alpasim_plugin.core.errors import InfrastructureError

Function = Callable[..., Any]  # tensors in tuples, lists, dictionaries or None, in and out


@dataclass(frozen=True, eq=False)
class Recording:
    """A captured function: its static output buffers, and how to replay it."""

    outputs: Any
    replay: Callable[[], object]


class Recorder(Protocol):
    """Captures a function for replay on the same addresses."""

    def record(self, function: Callable[[], Any]) -> Recording:
        """Capture ``function``; its outputs are undefined before the first replay."""
        ...


class CudaRecorder:
    """Capture CUDA graphs into one shared memory pool.

    Args:
        device: Where the function runs.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._pool: Any = None  # torch's handle of a memory pool

    def record(self, function: Callable[[], Any]) -> Recording:
        """Run ``function`` once on a side stream, so that libraries allocate their workspaces, then
        capture it.

        Raises:
            InfrastructureError: It cannot be captured, for example because it synchronises with the
                device.
        """
        try:
            with torch.cuda.device(self._device):
                side = torch.cuda.Stream()  # type: ignore[no-untyped-call]
                side.wait_stream(torch.cuda.current_stream())
                with torch.cuda.stream(side):
                    function()
                torch.cuda.current_stream().wait_stream(side)
                graph = torch.cuda.CUDAGraph()
                with torch.cuda.graph(graph, pool=self._pool):
                    outputs = function()
        except RuntimeError as error:
            found = str(error).splitlines()[0]
            raise InfrastructureError(
                f"{self._device}: {found}",
                "run without graphs (for a fixer: --set fixer.graphs=off) and report this",
            ) from error
        self._pool = self._pool or graph.pool()
        return Recording(outputs, graph.replay)


@dataclass(frozen=True, eq=False)
class _Entry:
    inputs: Any
    recording: Recording


class GraphedFunction:
    """Call a function through captured graphs.

    Args:
        function: Takes and returns tensors, bare or in tuples, lists, dictionaries; does not write
            to its arguments.
        recorder: Captures it, such as `CudaRecorder`.
        warmups: Eager calls of a shape before it is recorded, in which kernels are selected and
            caches filled.
        limit: Maximum number of shapes recorded; each keeps its buffers.

    Attributes:
        counts: Calls so far that ran ``eager``, ``recorded`` (and replayed) or ``replayed``, those
            ``beyond limit`` and ``unrecorded``.
    """

    def __init__(
        self, function: Function, recorder: Recorder, warmups: int = 2, limit: int = 4
    ) -> None:
        self._function, self._recorder = function, recorder
        self.warmups, self.limit = warmups, limit
        self.counts: Counter[str] = Counter()
        self._seen: Counter[Hashable] = Counter()
        self._entries: dict[Hashable, _Entry] = {}

    def __call__(self, *args: Any, key: Hashable = ()) -> Any:
        """Run the function.

        Args:
            args: Tensors, bare or in tuples, lists, dictionaries.
            key: Any other state that changes the computation, such as how full a cache is.
        """
        what = self._signature(args, key)
        entry = self._entries.get(what)
        if entry is None:
            full = len(self._entries) >= self.limit
            if full or self._seen[what] < self.warmups:
                self._seen[what] += 1
                self.counts["beyond limit" if full else "eager"] += 1
                return self._function(*args)
            # The copy keeps strides: kernel selection may depend on them.
            inputs = tree_map_only(
                Tensor, lambda x: x.clone(memory_format=torch.preserve_format), args
            )
            entry = self._entries[what] = _Entry(
                inputs, self._recorder.record(lambda: self._function(*inputs))
            )
            self.counts["recorded"] += 1
        else:
            self.counts["replayed"] += 1
            for kept, new in zip(tree_flatten(entry.inputs)[0], tree_flatten(args)[0], strict=True):
                if isinstance(kept, Tensor):
                    kept.copy_(new)
        entry.recording.replay()
        return tree_map_only(
            Tensor, lambda x: x.clone(memory_format=torch.preserve_format), entry.recording.outputs
        )

    def eagerly(self, *args: Any) -> Any:
        """Run the function eagerly; counted as ``unrecorded``."""
        self.counts["unrecorded"] += 1
        return self._function(*args)

    @staticmethod
    def _signature(args: Any, key: Hashable) -> Hashable:
        leaves, structure = tree_flatten(args)
        shapes = tuple(
            (x.shape, x.stride(), x.dtype, x.device) if isinstance(x, Tensor) else x for x in leaves
        )
        return key, str(structure), shapes
