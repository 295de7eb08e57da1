"""Fix frames one by one as they are rendered: no look-ahead, no chunk, no speculation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from alpasim_plugin.core.types import Fixer, Frame, Renderer, RenderRequest
from alpasim_plugin.fixers.block_runner import BlockRunner


class PerFrameRenderer(Renderer):
    """A renderer session whose frames are fixed at once, at every camera's own rate; the cameras of an instant are one batch.

    Args:
        runner: Renders and calls the fixer.
        fixer: At the start of its history; its blocks are single frames.
    """

    def __init__(self, runner: BlockRunner, fixer: Fixer) -> None:
        self.runner, self.fixer = runner, fixer
        self.frames = 0

    @property
    def stage_ms(self) -> Mapping[str, float]:  # type: ignore[override]  # computed when it is read
        """Times of the last call by stage, without the base renderer's."""
        return self.runner.stage_ms

    def facts(self) -> dict[str, Any]:
        """Return the fixer's label and the number of frames so far."""
        fixer = self.fixer
        return {"label": fixer.label, "trained": fixer.trained, "mode": "frame", "frames": self.frames, "chosen": dict(fixer.chosen)}

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame; see `render_batch`."""
        return self.render_batch([request])[0]

    def render_batch(self, requests: Sequence[RenderRequest]) -> list[Frame]:
        """Return the frames of one instant, in the order of the requests.

        Raises:
            FixerError: The fixer broke its contract.
        """
        self.runner.reset_times()
        fixed = self.runner.fix(self.fixer, self.fixer.step, [self.runner.render(request) for request in requests])
        self.frames += len(fixed)
        return fixed
