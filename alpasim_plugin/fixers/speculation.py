"""Emit frames one by one from blocks that were made beforehand along the plan in force.

At a block's first frame the rest of the block is foretold, rendered and fixed as a draft. A later frame is taken from the draft where the
true poses are within tolerance of the foretold ones; elsewhere a new draft is made from the true frames so far and a new forecast. The
block's last frame completes the block of true poses: that block is what enters the fixer's history, and its last frame is what is shown.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from alpasim_plugin.errors import RendererError
from alpasim_plugin.fixers.block_runner import Shot, Workshop
from alpasim_plugin.fixers.prediction_error import Deviation, deviation, same_view
from alpasim_plugin.fixers.settings import FixerSettings
from alpasim_plugin.types import Fixer, Frame, Renderer, RenderRequest


@dataclass
class Tally:
    """Counts over a rollout; a frame of each camera counts."""

    frames: int = 0
    blocks: int = 0  # complete ones
    foretold: int = 0  # frames for which there was a draft
    hits: int = 0  # of these: within tolerance
    exact: int = 0  # of these: equal bit for bit
    drafts: int = 0
    redrafts: int = 0  # drafts made in the middle of a block
    forecasts: list[Deviation] = field(default_factory=list)  # of foretold frames
    shown: list[Deviation] = field(default_factory=list)  # between the pose of the frame handed out and the true one

    def as_dict(self) -> dict[str, Any]:
        """Return the counts and, in metres and degrees, what the forecasts missed and what was shown all the same."""
        counts = {name: getattr(self, name) for name in ("frames", "blocks", "foretold", "hits", "exact", "drafts", "redrafts")}
        return counts | {"forecast_error": _spread(self.forecasts), "shown_error": _spread(self.shown)}


class SpeculativeRenderer(Renderer):
    """A renderer session whose frames are fixed block by block and handed out one by one.

    Cameras whose frames fall due at the same times go through the fixer together, as views of one batch; cameras of another rhythm have
    a fixer of their own.

    Args:
        workshop: Renders and calls the fixer.
        make_fixer: Makes a fixer at the start of its history.
        settings: Tolerances.
    """

    def __init__(self, workshop: Workshop, make_fixer: Callable[[], Fixer], settings: FixerSettings) -> None:
        self.workshop, self.settings = workshop, settings
        self._make = make_fixer
        self._spare: Fixer | None = make_fixer()
        self.label, self.trained, blocks = self._spare.label, self._spare.trained, self._spare.blocks
        self.lookahead = max(1, max(blocks.first, blocks.then) - 1)  # at least the next frame: cameras are told apart by their rhythm
        self._rhythms: dict[tuple[int, ...], _Rhythm] = {}
        self._rhythm_of: dict[str, _Rhythm] = {}
        self.tally = Tally()

    @property
    def stage_ms(self) -> Mapping[str, float]:  # type: ignore[override]  # computed when it is read
        """Give the times of the last call by stage, the base renderer's left out."""
        return self.workshop.stage_ms

    def facts(self) -> dict[str, Any]:
        """Return what the fixer is and what happened so far."""
        return {"label": self.label, "trained": self.trained, "mode": "speculative"} | self.tally.as_dict()

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame; see `render_batch`."""
        return self.render_batch([request])[0]

    def render_batch(self, requests: Sequence[RenderRequest]) -> list[Frame]:
        """Return the frames of one instant, in the order of the requests.

        Raises:
            RendererError: A camera comes out of its rhythm, or time does not increase.
            FixerError: The fixer broke its contract.
        """
        self.workshop.start_clock()
        groups: dict[int, list[RenderRequest]] = {}
        for request in requests:
            groups.setdefault(id(self._rhythm(request)), []).append(request)
        made: dict[str, Frame] = {}
        for group in groups.values():
            made |= self._rhythm_of[group[0].camera.name].emit(group)
        return [made[request.camera.name] for request in requests]

    def _rhythm(self, request: RenderRequest) -> _Rhythm:
        name = request.camera.name
        if name not in self._rhythm_of:
            times = (request.t_us, *(coming.t_us for coming in request.ahead))
            if times not in self._rhythms:
                fixer, self._spare = self._spare or self._make(), None
                self._rhythms[times] = _Rhythm(self.workshop, fixer, self.settings, self.tally)
            self._rhythm_of[name] = self._rhythms[times]
            self._rhythms[times].cameras.append(name)
        return self._rhythm_of[name]


@dataclass
class _Rhythm:
    """Cameras in step with each other, and the block in progress."""

    workshop: Workshop
    fixer: Fixer
    settings: FixerSettings
    tally: Tally
    cameras: list[str] = field(default_factory=list)
    done: int = 0  # complete blocks
    last_us: int | None = None
    true: list[list[Shot]] = field(default_factory=list)  # instants of the block so far, each a shot per camera
    draft: list[list[tuple[Shot, Frame]]] = field(default_factory=list)  # instants of the block, each per camera

    def emit(self, requests: Sequence[RenderRequest]) -> dict[str, Frame]:
        """Return the frames of one instant by camera."""
        requests = sorted(requests, key=lambda request: request.camera.name)
        self._check(requests)
        place = len(self.true)
        foretold = self.draft[place] if place < len(self.draft) else None
        self.true.append([self._shot(request, foretold, i) for i, request in enumerate(requests)])
        exact = [Deviation(0.0, 0.0, 0.0)] * len(requests)
        forecasts = [deviation(shot.request, now) for (shot, _), now in zip(foretold or (), requests, strict=foretold is not None)]
        hit = bool(forecasts) and all(d.within(self.settings.tolerance_m, self.settings.tolerance_deg) for d in forecasts)
        self._count(len(requests), forecasts, hit, foretold)
        if place + 1 == self.fixer.blocks.frames(self.done):
            frames, shown = self._complete(), exact
        elif hit and foretold is not None:
            frames, shown = [frame for _, frame in foretold], forecasts
        else:
            frames, shown = self._make_draft(requests), exact
        self.tally.shown += shown
        missed: Sequence[Deviation | None] = forecasts or [None] * len(frames)
        return {frame.camera: _measured(frame, off, miss) for frame, off, miss in zip(frames, shown, missed, strict=True)}

    def _shot(self, request: RenderRequest, foretold: list[tuple[Shot, Frame]] | None, i: int) -> Shot:
        if foretold is not None and same_view(foretold[i][0].request, request):
            return foretold[i][0]
        return self.workshop.shoot(request)

    def _complete(self) -> list[Frame]:
        """Take the block of true poses into the history and return its last frames."""
        fixed = self._fix(self.fixer.step, self.true)
        self.done += 1
        self.tally.blocks += 1
        self.true, self.draft = [], []
        return fixed[-1]

    def _make_draft(self, requests: Sequence[RenderRequest]) -> list[Frame]:
        """Fix the true frames so far with the foretold rest of the block and return the newest true ones."""
        left = self.fixer.blocks.frames(self.done) - len(self.true)
        coming = min(left, *(len(request.ahead) for request in requests))
        block = [*self.true, *([self.workshop.shoot(request.ahead[k]) for request in requests] for k in range(coming))]
        fixed = self._fix(self.fixer.preview, block)
        self.draft = [list(zip(shots, frames, strict=True)) for shots, frames in zip(block, fixed, strict=True)]
        self.tally.drafts += 1
        self.tally.redrafts += len(self.true) > 1
        return fixed[len(self.true) - 1]

    def _fix(self, call: Callable[..., Sequence[Frame]], block: Sequence[Sequence[Shot]]) -> list[list[Frame]]:
        flat = self.workshop.fix(self.fixer, call, [shot for shots in block for shot in shots])
        n = len(self.cameras)
        return [flat[i : i + n] for i in range(0, len(flat), n)]

    def _count(self, n: int, off: Sequence[Deviation], hit: bool, foretold: list[tuple[Shot, Frame]] | None) -> None:
        self.tally.frames += n
        self.tally.foretold += len(off)
        self.tally.hits += n if hit else 0
        self.tally.forecasts += off
        if foretold is not None:
            self.tally.exact += sum(shot is before for shot, (before, _) in zip(self.true[-1], foretold, strict=True))

    def _check(self, requests: Sequence[RenderRequest]) -> None:
        names, t_us = sorted(request.camera.name for request in requests), {request.t_us for request in requests}
        if names != sorted(self.cameras) or len(t_us) > 1:
            raise RendererError(
                "rendering for a fixer",
                f"cameras {', '.join(names)} at {sorted(t_us)} us",
                f"the block in progress belongs to {', '.join(self.cameras)} at one instant",
                "ask for cameras of one rhythm together",
            )
        now = next(iter(t_us))
        if self.last_us is not None and now <= self.last_us:
            raise RendererError(
                "rendering for a fixer", f"{now} us", f"the last frame was of {self.last_us} us", "make a new renderer for every rollout"
            )
        self.last_us = now


def _measured(frame: Frame, shown: Deviation, forecast: Deviation | None) -> Frame:
    """Note how far the pose of the frame handed out lies from the true one, and how far the forecast lay."""
    facts = {"pose_error_m": shown.camera_m, "pose_error_deg": shown.camera_deg, "actor_error_m": shown.actor_m}
    if forecast is not None:
        facts |= {"forecast_error_m": forecast.camera_m, "forecast_error_deg": forecast.camera_deg}
    return replace(frame, facts={**frame.facts, **{name: round(value, 6) for name, value in facts.items()}})


def _spread(errors: Sequence[Deviation]) -> dict[str, dict[str, float] | None]:
    """Return median, 95th percentile and maximum of each kind of error; None where no value is finite."""
    out: dict[str, dict[str, float] | None] = {}
    for name in ("camera_m", "camera_deg", "actor_m"):
        values = [value for error in errors if math.isfinite(value := getattr(error, name))]
        p50, p95, top = (round(float(v), 6) for v in np.percentile(values, (50, 95, 100))) if values else (0.0, 0.0, 0.0)
        out[name] = {"p50": p50, "p95": p95, "max": top} if values else None
    return out
