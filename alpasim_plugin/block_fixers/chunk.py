"""Fix whole blocks of true frames: the loop advances block by block, with one policy query at the
end of each.
"""

from collections.abc import Sequence
from typing import Any

from alpasim_plugin.core.interfaces import Fixer
from alpasim_plugin.core.types import Frame, RenderRequest
from alpasim_plugin.fixers.loop import BlockRunner, PerFrameRenderer
from alpasim_plugin.fixers.settings import FixerSettings


class ChunkRenderer(PerFrameRenderer):
    """A session that renders all frames of a block at once, of all cameras.

    Args:
        runner: Renders and calls the fixer.
        settings: Not used.
        first: A fixer at the start of its history.
    """

    def __init__(self, runner: BlockRunner, settings: FixerSettings, first: Fixer) -> None:
        super().__init__(runner, first)
        self.mode = "chunk"
        self.block = first.blocks
        self.blocks = 0

    def counts(self) -> dict[str, Any]:
        """Return the number of frames and of blocks so far."""
        return {"frames": self.frames, "blocks": self.blocks}

    def render_batch(self, requests: Sequence[RenderRequest]) -> list[Frame]:
        """Return the frames of one block, in the order of the requests.

        Raises:
            FixerError: The fixer broke its contract.
        """
        fixed = super().render_batch(requests)
        self.blocks += 1
        return fixed
