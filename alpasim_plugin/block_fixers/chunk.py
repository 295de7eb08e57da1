"""Fix whole blocks of true frames: the loop advances block by block, with one policy query at the
end of each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from alpasim_plugin.core.errors import RendererError
from alpasim_plugin.core.interfaces import Fixer
from alpasim_plugin.core.types import Frame, RenderRequest
from alpasim_plugin.fixers.loop import BlockRunner, FixedRenderer
from alpasim_plugin.fixers.settings import FixerSettings


class ChunkRenderer(FixedRenderer):
    """A session that renders all frames of a block at once, of all cameras.

    Args:
        runner: Renders and calls the fixer.
        make_fixer: Makes a fixer at the start of its history; not used.
        settings: Not used.
        first: A fixer that is made already.
    """

    def __init__(
        self,
        runner: BlockRunner,
        make_fixer: Callable[[], Fixer],
        settings: FixerSettings,
        first: Fixer,
    ) -> None:
        super().__init__(runner, first, "chunk")
        self.block = first.blocks
        self.frames = self.blocks = 0

    def counts(self) -> dict[str, Any]:
        """Return the number of frames and of blocks so far."""
        return {"frames": self.frames, "blocks": self.blocks}

    def render_batch(self, requests: Sequence[RenderRequest]) -> list[Frame]:
        """Return the frames of one block, in the order of the requests.

        Raises:
            RendererError: A camera has another number of frames than the block.
            FixerError: The fixer broke its contract.
        """
        due = self.fixer.blocks.frames(self.blocks)
        counts: dict[str, int] = {}
        for request in requests:
            counts[request.camera.name] = counts.get(request.camera.name, 0) + 1
        if set(counts.values()) != {due}:
            raise RendererError(
                f"block {self.blocks}: frames by camera: {counts}; the block has {due}",
                "request whole blocks",
            )
        self.runner.reset_times()
        fixed = self.runner.fix(
            self.fixer, self.fixer.step, [self.runner.render(request) for request in requests]
        )
        self.blocks += 1
        self.frames += len(fixed)
        return fixed
