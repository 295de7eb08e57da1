"""Record a function of tensors once and replay it: CUDA graphs, one per shape of the arguments.

A recorded function sees fixed addresses. Arguments are copied into buffers of the recording, the recording runs, results are copied out;
so the caller's tensors stay his, and results stay valid after the next call. What the function reaches besides its arguments (weights, a
rolling cache) must keep its address, and what Python does in it happens at recording only: open and close cache blocks around the call.

Nothing falls back silently. A call runs eagerly while its shape is new (`warmups`) or when `limit` shapes have been recorded; `counts`
says how often. A function that cannot be recorded is an error.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.utils._pytree import tree_flatten, tree_map_only

from alpasim_plugin.errors import InfrastructureError

Function = Callable[..., Any]  # tensors in tuples, lists, dictionaries or None, in and out


@dataclass(frozen=True, eq=False)
class Recording:
    """What was recorded: where its results appear, and how to run it again."""

    outputs: Any
    replay: Callable[[], object]


class Recorder(Protocol):
    """Something that can run a function again on the same addresses."""

    def record(self, function: Callable[[], Any]) -> Recording:
        """Record ``function``; its outputs hold nothing before the first replay."""
        ...


class CudaRecorder:
    """Record CUDA graphs into one shared memory pool.

    Args:
        device: Where the function runs.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._pool: Any = None  # torch's handle of a memory pool

    def record(self, function: Callable[[], Any]) -> Recording:
        """Run ``function`` once beside the current stream, so that libraries make their workspaces, then capture it.

        Raises:
            InfrastructureError: It cannot be captured, for example because it waits for the device.
        """
        try:
            with torch.cuda.device(self._device):
                beside = torch.cuda.Stream()  # type: ignore[no-untyped-call]
                beside.wait_stream(torch.cuda.current_stream())
                with torch.cuda.stream(beside):
                    function()
                torch.cuda.current_stream().wait_stream(beside)
                graph = torch.cuda.CUDAGraph()
                with torch.cuda.graph(graph, pool=self._pool):
                    outputs = function()
        except RuntimeError as error:
            found = str(error).splitlines()[0]
            do = "run without graphs (for a fixer: --set fixer.graphs=off) and report this"
            raise InfrastructureError("recording a CUDA graph", str(self._device), found, do) from error
        self._pool = self._pool or graph.pool()
        return Recording(outputs, graph.replay)


class EagerRecorder:
    """Run the function anew at every replay: the readable twin, which a CPU can run.

    As with a graph, results appear at fixed places and are not there before the first replay.
    """

    def record(self, function: Callable[[], Any]) -> Recording:
        """Prepare buffers like the function's results, full of NaN."""
        outputs = tree_map_only(Tensor, lambda x: torch.full_like(x, torch.nan if x.is_floating_point() else 0), function())

        def replay() -> None:
            for kept, new in zip(tree_flatten(outputs)[0], tree_flatten(function())[0], strict=True):
                if isinstance(kept, Tensor):
                    kept.copy_(new)

        return Recording(outputs, replay)


@dataclass(frozen=True, eq=False)
class _Entry:
    inputs: Any
    recording: Recording


class GraphedFunction:
    """Call a function through recordings.

    Args:
        function: Takes and returns tensors, bare or in tuples, lists, dictionaries; reads its arguments only.
        recorder: `CudaRecorder`, or `EagerRecorder` where there is no device.
        warmups: Eager calls of a shape before it is recorded: kernels are chosen and caches filled in them.
        limit: Shapes recorded at most; each holds its buffers for good.

    Attributes:
        counts: Calls so far that ran ``eager``, ``recorded`` (and replayed) or ``replayed``, those ``beyond limit`` and ``unrecorded``.

    Example:
        >>> double = GraphedFunction(lambda x: 2 * x, EagerRecorder(), warmups=1)
        >>> [float(double(torch.tensor(float(i)))) for i in range(3)], dict(double.counts)
        ([0.0, 2.0, 4.0], {'eager': 1, 'recorded': 1, 'replayed': 1})
    """

    def __init__(self, function: Function, recorder: Recorder, warmups: int = 2, limit: int = 4) -> None:
        self._function, self._recorder = function, recorder
        self.warmups, self.limit = warmups, limit
        self.counts: Counter[str] = Counter()
        self._seen: Counter[Hashable] = Counter()
        self._entries: dict[Hashable, _Entry] = {}

    def __call__(self, *args: Any, key: Hashable = ()) -> Any:
        """Run the function.

        Args:
            args: Tensors, bare or in tuples, lists, dictionaries.
            key: Everything besides shapes that changes what the function does, such as how full a cache is.
        """
        what = self._signature(args, key)
        entry = self._entries.get(what)
        if entry is None:
            full = len(self._entries) >= self.limit
            if full or self._seen[what] < self.warmups:
                self._seen[what] += 1
                self.counts["beyond limit" if full else "eager"] += 1
                return self._function(*args)
            # The copy keeps strides: kernels may be chosen by them.
            inputs = tree_map_only(Tensor, lambda x: x.clone(memory_format=torch.preserve_format), args)
            entry = self._entries[what] = _Entry(inputs, self._recorder.record(lambda: self._function(*inputs)))
            self.counts["recorded"] += 1
        else:
            self.counts["replayed"] += 1
            for kept, new in zip(tree_flatten(entry.inputs)[0], tree_flatten(args)[0], strict=True):
                if isinstance(kept, Tensor):
                    kept.copy_(new)
        entry.recording.replay()
        return tree_map_only(Tensor, lambda x: x.clone(memory_format=torch.preserve_format), entry.recording.outputs)

    def eagerly(self, *args: Any) -> Any:
        """Run the function as it is, on request; counted as ``unrecorded``."""
        self.counts["unrecorded"] += 1
        return self._function(*args)

    @staticmethod
    def _signature(args: Any, key: Hashable) -> Hashable:
        leaves, structure = tree_flatten(args)
        shapes = tuple((x.shape, x.stride(), x.dtype, x.device) if isinstance(x, Tensor) else x for x in leaves)
        return key, str(structure), shapes
