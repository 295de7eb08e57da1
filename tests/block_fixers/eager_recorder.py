"""A recorder that runs the function again at every replay: the reference of `CudaRecorder`, for
machines without a GPU.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_flatten, tree_map_only

from alpasim_plugin.block_fixers.graphs import Recording


class EagerRecorder:
    """Replay by calling the function; as with a graph, outputs are static buffers and undefined
    before the first replay.
    """

    def record(self, function: Callable[[], Any]) -> Recording:
        """Allocate output buffers, full of NaN."""
        outputs = tree_map_only(
            Tensor,
            lambda x: torch.full_like(x, torch.nan if x.is_floating_point() else 0),
            function(),
        )

        def replay() -> None:
            for kept, new in zip(
                tree_flatten(outputs)[0], tree_flatten(function())[0], strict=True
            ):
                if isinstance(kept, Tensor):
                    kept.copy_(new)

        return Recording(outputs, replay)
