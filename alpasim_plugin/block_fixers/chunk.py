"""Fix whole blocks of true frames: the loop advances block by block, with one policy query at the
end of each.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from alpasim_plugin.core.errors import RendererError
from alpasim_plugin.core.interfaces import Fixer, Renderer
from alpasim_plugin.core.types import Frame, RenderRequest
from alpasim_plugin.fixers.loop import BlockRunner
from alpasim_plugin.fixers.settings import FixerSettings


class ChunkRenderer(Renderer):
    """A renderer session that renders all frames of a block at once, of all cameras.

    Args:
        runner: Renders and calls the fixer.
        make_fixer: Makes a fixer at the start of its history.
        settings: Not used.
        first: One that is made already.
    """

    def __init__(
        self,
        runner: BlockRunner,
        make_fixer: Callable[[], Fixer],
        settings: FixerSettings,
        first: Fixer | None = None,
    ) -> None:
        self.runner, self.fixer = runner, first or make_fixer()
        self.block = self.fixer.blocks
        self.frames = self.blocks = 0

    @property
    def stage_ms(self) -> Mapping[str, float]:  # type: ignore[override]  # computed when it is read
        """Times of the last call by stage, without the base renderer's."""
        return self.runner.stage_ms

    def facts(self) -> dict[str, Any]:
        """Return the fixer's label and the counts so far."""
        fixer = self.fixer
        return {
            "label": fixer.label,
            "trained": fixer.trained,
            "mode": "chunk",
            "frames": self.frames,
            "blocks": self.blocks,
        }

    def render(self, request: RenderRequest) -> Frame:
        """Render a block of one frame; see `render_batch`."""
        return self.render_batch([request])[0]

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
