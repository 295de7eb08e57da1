"""Compose a renderer and a fixer into a renderer: render frames with their semantic maps and run
the fixer over them, checked and timed.

A fixer of single frames fixes each frame as it is rendered. How the loop calls a fixer of blocks is
a mode, which the package that holds it registers in the entry-point group ``simrun.fixer_modes``.
"""

import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from alpasim_plugin.cameras.lens import blackened
from alpasim_plugin.cameras.lens_cover import LensCover
from alpasim_plugin.core.errors import FixerError, FixerFault, InputError
from alpasim_plugin.core.interfaces import BlockRule, Fixer, Renderer
from alpasim_plugin.core.lazy import installed
from alpasim_plugin.core.parts import complete
from alpasim_plugin.core.parts.blame import blaming, defined, is_own
from alpasim_plugin.core.parts.spec import MODES
from alpasim_plugin.core.types import (
    U8,
    Actor,
    Frame,
    RecordedFrame,
    RenderRequest,
    Scenario,
    read_only,
)
from alpasim_plugin.fixers.references import ReferenceSession, session_of
from alpasim_plugin.fixers.semantic_map.draw import draw_exposed_maps
from alpasim_plugin.fixers.semantic_map.prepare import PreparedMap, prepare_map
from alpasim_plugin.fixers.settings import FixerSettings
from alpasim_plugin.gaussians.raster.stages import map_on_threads, thread_count

Call = Callable[[Sequence[Frame], Sequence[U8]], Sequence[Frame]]
ONE_BY_ONE = BlockRule(1, 1)


@dataclass(frozen=True)
class ConditionedFrame:
    """One rendered frame with the semantic map of the same view."""

    request: RenderRequest
    frame: Frame
    map: Any  # (H, W, 3) uint8, of the host or of a device; None where the fixer uses none


@dataclass
class BlockRunner:
    """Render and fix the blocks of one rollout.

    Attributes:
        render_base: The base renderer, of the frames of an instant; they are checked.
        scene_map: The scene's map, or None where the fixer uses none.
        actors: The scenario's, for the sizes of their boxes.
        references: Warps recorded frames into each view; None where the fixer reads none, or the
            renderer declares none.
        threads: Threads of the map rasteriser.
        on_device: Whether the fixer takes the references and the map of a frame that a device drew
            from there.
        cover: The pinholes that are rendered of lenses where ``draws_lenses`` does not say that the
            base renderer draws these; the fixer sees the lens's image.
        stage_ms: Time since `reset_times` by stage, without the base renderer's.
    """

    render_base: Callable[[Sequence[RenderRequest]], Sequence[Frame]]
    scene_map: PreparedMap | None
    actors: Sequence[Actor]
    threads: int | None = None
    references: ReferenceSession | None = None
    on_device: bool = False
    cover: LensCover = field(default_factory=LensCover)
    draws_lenses: bool = False
    stage_ms: dict[str, float] = field(default_factory=dict)

    def reset_times(self) -> None:
        """Set the time of every stage seen so far to zero."""
        self.stage_ms = dict.fromkeys(self.stage_ms, 0.0)

    def render(self, requests: Sequence[RenderRequest]) -> list[ConditionedFrame]:
        """Render the frames of an instant, warp their references and draw their maps."""
        if self.cover.sides and not self.draws_lenses:
            return self._covered(requests)
        frames = self._with_references(requests, self.render_base(requests))
        maps = self._maps(requests, self._map_device(frames))
        return list(map(ConditionedFrame, requests, frames, maps))

    def _covered(self, requests: Sequence[RenderRequest]) -> list[ConditionedFrame]:
        """Render the pinholes of each lens and join their frames; the map is drawn through the lens."""
        cuts = [self.cover.requests(request) for request in requests]
        pinholes = [part for cut in cuts for part in cut]
        parts = iter(self._with_references(pinholes, self.render_base(pinholes)))
        lens_parts = [
            (request.camera.name, [next(parts) for _ in cut])
            for request, cut in zip(requests, cuts, strict=True)
        ]
        with self._timed("lens"):
            frames = map_on_threads(
                thread_count(self.threads), lambda lens: self.cover.frame(*lens), lens_parts
            )
        maps = self._maps(requests, self._map_device(frames))
        return list(map(ConditionedFrame, requests, frames, maps))

    def _with_references(
        self, requests: Sequence[RenderRequest], frames: Sequence[Frame]
    ) -> Sequence[Frame]:
        """Return frames with the recorded ones that are carried into them."""
        if self.references is None:
            return frames
        with self._timed("references"):
            return self.references.added(requests, frames, self.on_device)

    def _map_device(self, frames: Sequence[Frame]) -> Any:
        """Return what draws the maps of frames: the device that drew them, where the fixer reads it."""
        return frames[0].device if self.on_device else "cpu"

    def _maps(self, requests: Sequence[RenderRequest], device: Any) -> Sequence[Any]:
        """Return the maps of requests, through their lenses; None where the fixer uses none."""
        if self.scene_map is None:
            return [None] * len(requests)
        with self._timed("map"):
            return draw_exposed_maps(self.scene_map, requests, self.actors, self.threads, device)

    def fix(self, fixer: Fixer, call: Call, block: Sequence[ConditionedFrame]) -> list[Frame]:
        """Fix a block and check the result.

        Args:
            fixer: Gives its name for messages.
            call: Its ``preview`` or ``step``.
            block: Frames with their maps.

        Raises:
            FixerError: The fixer raised, or its frames have another number, time, camera, size or
                type.
        """
        frames = [item.frame for item in block]
        maps = [item.map for item in block if item.map is not None]
        name = f"{type(fixer).__name__}, {len(frames)} frames of {frames[0].t_us} to {frames[-1].t_us} us"
        kind = FixerError if is_own(fixer) else FixerFault
        definition = defined(fixer, "step")
        inputs = frames if is_own(fixer) else [read_only(frame) for frame in frames]
        with self._timed("fix"), blaming(kind, name, definition, not is_own(fixer)):
            fixed = list(call(inputs, maps))
            problem = _problem(frames, fixed)
        if problem:
            raise kind(
                f"{name}: {problem}{definition}",
                "fix the fixer: as many frames out as in, with the same times, cameras and sizes",
            )
        out = []
        for frame in fixed:
            blind = self.cover.blind.get(frame.camera)
            image = {} if blind is None else {"rgb": blackened(frame.rgb, blind)}
            out.append(frame.changed(references=(), **image))
        return out

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self.stage_ms[stage] = self.stage_ms.get(stage, 0.0) + 1e3 * (time.perf_counter() - began)


def _problem(rendered: Sequence[Frame], fixed: Sequence[Frame]) -> str:
    if len(fixed) != len(rendered):
        return f"{len(fixed)} frames came back"
    for before, after in zip(rendered, fixed, strict=True):
        if (before.t_us, before.camera) != (after.t_us, after.camera):
            return f"camera {before.camera!r} at {before.t_us} us came back as {after.camera!r} at {after.t_us} us"
        if after.rgb.shape != (*before.size, 3) or after.rgb.dtype != np.uint8:
            return f"rgb came back as {after.rgb.dtype} {after.rgb.shape}, not of {before.size}"
    return ""


class FixedRenderer(Renderer):
    """A renderer session whose frames are fixed: what every way to call a fixer shares.

    Args:
        runner: Renders and calls the fixer.
        fixer: At the start of its history.
        mode: Its name, for facts.
    """

    def __init__(self, runner: BlockRunner, fixer: Fixer, mode: str) -> None:
        self.runner = runner
        self.fixer = fixer
        self.mode = mode

    @property
    def stage_ms(self) -> Mapping[str, float]:  # type: ignore[override]  # computed when it is read
        """Times of the last call by stage, without the base renderer's."""
        return self.runner.stage_ms

    def facts(self) -> dict[str, Any]:
        """Return the fixer's label and the counts so far."""
        label = self.fixer.label
        trained = self.fixer.trained
        return {"label": label, "trained": trained, "mode": self.mode, **self.counts()}

    def counts(self) -> dict[str, Any]:
        """Return what was counted so far."""
        return {}

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame; see ``render_batch``."""
        return self.render_batch([request])[0]

    @abstractmethod
    def render_batch(self, requests: Sequence[RenderRequest]) -> list[Frame]:
        """Return the frames of the requests, in their order."""


class PerFrameRenderer(FixedRenderer):
    """A session whose frames are fixed at once, at every camera's own rate; the cameras of an
    instant are one batch.

    Args:
        runner: Renders and calls the fixer.
        fixer: At the start of its history; its blocks are single frames.
    """

    def __init__(self, runner: BlockRunner, fixer: Fixer) -> None:
        super().__init__(runner, fixer, "frame")
        self.frames = 0

    def counts(self) -> dict[str, Any]:
        """Return the number of frames so far."""
        return {"frames": self.frames}

    def render_batch(self, requests: Sequence[RenderRequest]) -> list[Frame]:
        """Return the frames of one instant, in the order of the requests.

        Raises:
            FixerError: The fixer broke its contract.
        """
        self.runner.reset_times()
        fixed = self.runner.fix(self.fixer, self.fixer.step, self.runner.render(requests))
        self.frames += len(fixed)
        return fixed


def fixed_renderer(
    render: Callable[[Sequence[RenderRequest]], Sequence[Frame]],
    make_fixer: Callable[[], Fixer],
    settings: FixerSettings,
    scenario: Scenario,
    threads: int | None = None,
    recorded: Sequence[RecordedFrame] = (),
    cover: LensCover = LensCover(),
    draws_lenses: bool = False,
) -> Renderer:
    """Return one rollout's renderer whose frames are fixed.

    A fixer of single frames fixes each as it is rendered. Others work in blocks (5 frames first,
    then 8), but the poses of a block's later frames are not known when its first frame falls due:
    ``settings.mode`` names what is done about it.

    Args:
        render: The base renderer of the same rollout, of the frames of an instant; they are
            checked.
        make_fixer: Makes a fixer without history.
        settings: Mode, tolerances, and whether the fixer wants semantic maps.
        scenario: Its map and its actors' boxes are what the semantic map shows.
        threads: Threads of the map rasteriser; None leaves numba's number.
        recorded: Frames of the recorded drive that the base renderer declares.
        cover: The pinholes of the scenario's lenses.
        draws_lenses: Whether the base renderer draws lenses itself, and not these pinholes.

    Raises:
        InputError: No installed package has the mode.
    """
    scene_map = prepare_map(scenario.lane_map) if settings.uses_map else None
    references = session_of(settings, scenario, recorded, threads)
    first = complete(make_fixer(), Fixer)
    on_device = first.reads_device
    sources = render, scene_map, scenario.actors
    runner = BlockRunner(*sources, threads, references, on_device, cover, draws_lenses)
    if first.blocks == ONE_BY_ONE:
        return PerFrameRenderer(runner, first)
    modes = installed(MODES)
    if settings.mode not in modes:
        raise InputError(
            f"{settings.name}, fixer.mode={settings.mode}: no installed package has this mode (entry points {MODES}); known: {', '.join(modes) or 'none'}",
            "install simrun with its block fixers, or take a fixer of single frames, such as onefixer",
        )
    return modes[settings.mode].load()(runner, settings, first)
