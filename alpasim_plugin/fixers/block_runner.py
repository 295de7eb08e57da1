"""Render frames with their semantic maps and run a fixer over blocks of them; every call is checked and timed."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from alpasim_plugin.core.errors import FixerError, SimrunError
from alpasim_plugin.core.types import U8, Actor, Fixer, Frame, RenderRequest
from alpasim_plugin.semantic_map.draw import draw_map
from alpasim_plugin.semantic_map.prepare import PreparedMap, actor_boxes

Call = Callable[[Sequence[Frame], Sequence[U8]], Sequence[Frame]]
DOING = "fixing a block of frames"


@dataclass(frozen=True)
class ConditionedFrame:
    """One rendered frame with the semantic map of the same view."""

    request: RenderRequest
    frame: Frame
    map: U8 | None  # (H, W, 3); None where the fixer uses none


@dataclass
class BlockRunner:
    """Render and fix the blocks of one rollout.

    Attributes:
        render_base: The base renderer; its frames are checked.
        scene_map: The scene's map, or None where the fixer uses none.
        actors: The scenario's, for the sizes of their boxes.
        threads: Threads of the map rasteriser.
        stage_ms: Time since `reset_times` by stage, without the base renderer's.
    """

    render_base: Callable[[RenderRequest], Frame]
    scene_map: PreparedMap | None
    actors: Sequence[Actor]
    threads: int | None = None
    stage_ms: dict[str, float] = field(default_factory=dict)

    def reset_times(self) -> None:
        """Set the time of every stage seen so far to zero."""
        self.stage_ms = dict.fromkeys(self.stage_ms, 0.0)

    def render(self, request: RenderRequest) -> ConditionedFrame:
        """Render one frame and draw its map."""
        frame = self.render_base(request)
        if self.scene_map is None:
            return ConditionedFrame(request, frame, None)
        with self._timed("map"):
            boxes = actor_boxes(request.actors, self.actors)
            image = draw_map(self.scene_map, request.camera, request.T_world_camera[-1], boxes, threads=self.threads)
        return ConditionedFrame(request, frame, image)

    def fix(self, fixer: Fixer, call: Call, block: Sequence[ConditionedFrame]) -> list[Frame]:
        """Fix a block and check the result.

        Args:
            fixer: Gives its name for messages, and the stages it timed itself (``stage_ms``).
            call: Its ``preview`` or ``step``.
            block: Frames with their maps.

        Raises:
            FixerError: The fixer raised, or its frames have another number, time, camera, size or type.
        """
        frames, maps = [item.frame for item in block], [item.map for item in block if item.map is not None]
        name = f"{type(fixer).__name__}, {len(frames)} frames of {frames[0].t_us} to {frames[-1].t_us} us"
        before = dict(fixer.stage_ms)
        with self._timed("fix"):
            try:
                fixed = list(call(frames, maps))
            except SimrunError:
                raise
            except Exception as error:
                raise FixerError(DOING, name, f"{type(error).__name__}: {error}", "see the traceback in the rollout's manifest") from error
        self._add_fixer_stages(before, fixer.stage_ms)
        problem = _problem(frames, fixed)
        if problem:
            raise FixerError(DOING, name, problem, "fix the fixer: as many frames out as in, with the same times, cameras and sizes")
        return fixed

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self.stage_ms[stage] = self.stage_ms.get(stage, 0.0) + 1e3 * (time.perf_counter() - began)

    def _add_fixer_stages(self, before: Mapping[str, float], after: Mapping[str, float]) -> None:
        """Add what a fixer timed itself (running sums) as ``fix: STAGE``, and the rest of its call as ``fix``."""
        for stage, total_ms in after.items():
            part_ms = total_ms - before.get(stage, 0.0)
            name = f"fix: {stage}"
            self.stage_ms[name] = self.stage_ms.get(name, 0.0) + part_ms
            self.stage_ms["fix"] -= part_ms


def _problem(given: Sequence[Frame], fixed: Sequence[Frame]) -> str:
    if len(fixed) != len(given):
        return f"{len(fixed)} frames came back"
    for before, after in zip(given, fixed, strict=True):
        if (before.t_us, before.camera) != (after.t_us, after.camera):
            return f"camera {before.camera!r} at {before.t_us} us came back as {after.camera!r} at {after.t_us} us"
        if before.rgb.shape != after.rgb.shape or before.rgb.dtype != after.rgb.dtype:
            return f"rgb came back as {after.rgb.dtype} {after.rgb.shape}, not {before.rgb.dtype} {before.rgb.shape}"
    return ""
