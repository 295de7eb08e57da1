"""Fix whole blocks of true frames: the loop runs in blocks as well, one question to the policy at the end of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from alpasim_plugin.errors import RendererError
from alpasim_plugin.fixers.block_runner import Workshop
from alpasim_plugin.types import Fixer, Frame, Renderer, RenderRequest


class ChunkRenderer(Renderer):
    """A renderer session that takes all frames of a block at once, of all cameras.

    Args:
        workshop: Renders and calls the fixer.
        fixer: At the start of its history.
    """

    def __init__(self, workshop: Workshop, fixer: Fixer) -> None:
        self.workshop, self.fixer = workshop, fixer
        self.block = fixer.blocks
        self.frames = self.blocks = 0

    @property
    def stage_ms(self) -> Mapping[str, float]:  # type: ignore[override]  # computed when it is read
        """Give the times of the last call by stage, the base renderer's left out."""
        return self.workshop.stage_ms

    def facts(self) -> dict[str, Any]:
        """Return what the fixer is and what happened so far."""
        fixer = self.fixer
        return {"label": fixer.label, "trained": fixer.trained, "mode": "chunk", "frames": self.frames, "blocks": self.blocks}

    def render(self, request: RenderRequest) -> Frame:
        """Refuse: one frame is no block, unless a block has one frame."""
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
                "rendering a block", f"block {self.blocks}", f"frames by camera: {counts}; the block has {due}", "ask for whole blocks"
            )
        self.workshop.start_clock()
        fixed = self.workshop.fix(self.fixer, self.fixer.step, [self.workshop.shoot(request) for request in requests])
        self.blocks += 1
        self.frames += len(fixed)
        return fixed
