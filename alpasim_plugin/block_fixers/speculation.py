"""Speculative rendering: frames are returned one by one from blocks that were fixed along predicted
poses.

At a block's first frame the rest of the block is predicted from the plan in force, rendered and
fixed as a draft. A later frame is taken from the draft if the true poses are within tolerance of
the predicted ones; otherwise a new draft is made from the true frames so far and a new forecast.
The block's last frame completes the block of true poses, which enters the fixer's history; its last
frame is shown.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import RendererError
from alpasim_plugin.core.interfaces import Fixer
from alpasim_plugin.core.types import F64, Frame, RenderRequest
from alpasim_plugin.fixers.loop import BlockRunner, ConditionedFrame, FixedRenderer
from alpasim_plugin.fixers.settings import FixerSettings

# beyond this distance an actor's displacement counts in proportion to its size in the image
NEAR_M = 10.0
ARM_M = 2.5  # an actor's rotation counts as the displacement of a point this far from its centre
BEHIND_M = (
    10.0  # an actor whose centre lies further than this behind the camera is not in the image
)


@dataclass(frozen=True)
class Deviation:
    """Pose errors of a predicted request."""

    camera_m: float  # displacement of the camera, the larger of shutter start and end
    camera_deg: float  # its rotation
    # largest displacement of an actor in view, scaled to a distance of `NEAR_M`; infinite if one
    # appeared or left
    actor_m: float

    def within(self, tolerance_m: float, tolerance_deg: float) -> bool:
        """Return whether camera and actors are within tolerance."""
        return max(self.camera_m, self.actor_m) <= tolerance_m and self.camera_deg <= tolerance_deg

    def largest(self, others: Sequence[Deviation]) -> Deviation:
        """Return the largest of each kind of error, of those that are finite."""
        columns = zip(*(vars(error).values() for error in (self, *others)), strict=True)
        return Deviation(*(max(filter(math.isfinite, column)) for column in columns))


EXACT = Deviation(0.0, 0.0, 0.0)


def deviation(predicted: RenderRequest, true: RenderRequest) -> Deviation:
    """Compare two requests of one camera and instant."""
    before = predicted.T_world_camera
    now = true.T_world_camera
    moved = float(np.linalg.norm(before[:, :3, 3] - now[:, :3, 3], axis=1).max())
    turned = max(
        rotation_rad(predicted_pose, two) for predicted_pose, two in zip(before, now, strict=True)
    )
    actors = [0.0]
    for key in predicted.actors.keys() | true.actors.keys():
        predicted_pose = predicted.actors.get(key)
        two = true.actors.get(key)
        latest = predicted.actors[key] if two is None else two
        ray = latest[:3, 3] - now[-1, :3, 3]
        if float(ray @ now[-1, :3, 2]) < -BEHIND_M:
            continue
        if predicted_pose is None or two is None:
            actors.append(math.inf)
            continue
        apart = float(np.linalg.norm(predicted_pose[:3, 3] - two[:3, 3])) + ARM_M * rotation_rad(
            predicted_pose, two
        )
        actors.append(apart * NEAR_M / max(NEAR_M, float(np.linalg.norm(ray))))
    return Deviation(moved, math.degrees(turned), max(actors))


def rotation_rad(a: F64, b: F64) -> float:
    """Return the angle between the rotations of two transforms ``(4, 4)``, exact to rounding for
    small angles too.
    """
    chord = float(np.linalg.norm(a[:3, :3] - b[:3, :3]))
    return 2.0 * math.asin(min(1.0, chord / math.sqrt(8.0)))


@dataclass
class SpeculationStats:
    """Counts over a rollout; a frame of each camera counts."""

    frames: int = 0
    blocks: int = 0  # complete ones
    predicted: int = 0  # frames with a draft
    hits: int = 0  # of these: within tolerance
    drafts: int = 0
    redrafts: int = 0  # drafts made in the middle of a block
    # largest errors of predicted frames, and between the pose of the frame shown and the true one
    forecast_error: Deviation = EXACT
    shown_error: Deviation = EXACT

    def as_dict(self) -> dict[str, Any]:
        """Return the counts and errors, in metres and degrees."""
        forecast = _rounded(vars(self.forecast_error)) if self.predicted else {}
        shown_error = _rounded(vars(self.shown_error))
        return vars(self) | {"forecast_error": forecast, "shown_error": shown_error}


class SpeculativeRenderer(FixedRenderer):
    """A session whose frames are fixed block by block and returned one by one; its cameras have
    the same frame times and go through the fixer together, as views of one batch.

    Args:
        runner: Renders and calls the fixer.
        settings: Tolerances.
        first: A fixer at the start of its history.
    """

    def __init__(self, runner: BlockRunner, settings: FixerSettings, first: Fixer) -> None:
        super().__init__(runner, first, "speculative")
        self.settings = settings
        self.lookahead = max(1, first.blocks.first - 1, first.blocks.then - 1)
        self.stats = SpeculationStats()
        self.cameras: list[str] = []
        self.last_us: int | None = None
        # Instants of the block so far, and of its draft; each a frame per camera, by name.
        self.true: list[list[ConditionedFrame]] = []
        self.draft: list[list[tuple[ConditionedFrame, Frame]]] = []

    def counts(self) -> dict[str, Any]:
        """Return the counts so far."""
        return self.stats.as_dict()

    def render_batch(self, requests: Sequence[RenderRequest]) -> list[Frame]:
        """Return the frames of one instant, in the order of the requests.

        Raises:
            RendererError: Other cameras than before, or time that does not increase.
            FixerError: The fixer broke its contract.
        """
        self.runner.reset_times()
        ordered = sorted(requests, key=lambda request: request.camera.name)
        self._check(ordered)
        place = len(self.true)
        predicted = self.draft[place] if place < len(self.draft) else []
        self.true.append(self.runner.render(ordered))
        forecasts = [
            deviation(item.request, request)
            for (item, _), request in zip(predicted, ordered, strict=bool(predicted))
        ]
        limits = self.settings.tolerance_m, self.settings.tolerance_deg
        is_hit = bool(predicted) and all(error.within(*limits) for error in forecasts)
        shown_errors = [EXACT] * len(ordered)
        if place + 1 == self.fixer.blocks.frames(self.stats.blocks):
            # The block of true poses joins the history; its last frames are shown.
            fixed = self._fix(self.fixer.step, self.true)
            self.stats.blocks += 1
            self.true = []
            self.draft = []
            frames = fixed[-1]
        elif is_hit:
            frames = [frame for _, frame in predicted]
            shown_errors = forecasts
        else:
            frames = self._fix_draft(ordered)
        self.stats.frames += len(ordered)
        self.stats.predicted += len(forecasts)
        self.stats.hits += len(ordered) if is_hit else 0
        self.stats.forecast_error = self.stats.forecast_error.largest(forecasts)
        self.stats.shown_error = self.stats.shown_error.largest(shown_errors)
        made = {
            frame.camera: _measured(frame, shown_errors[i], forecasts[i] if forecasts else None)
            for i, frame in enumerate(frames)
        }
        return [made[request.camera.name] for request in requests]

    def _fix(
        self, call: Callable[..., Sequence[Frame]], block: Sequence[Sequence[ConditionedFrame]]
    ) -> list[list[Frame]]:
        flat = self.runner.fix(self.fixer, call, [item for items in block for item in items])
        n = len(self.cameras)
        return [flat[i : i + n] for i in range(0, len(flat), n)]

    def _fix_draft(self, requests: Sequence[RenderRequest]) -> list[Frame]:
        """Fix the true frames so far with the predicted rest of the block, and return the frames of
        this instant.
        """
        left = self.fixer.blocks.frames(self.stats.blocks) - len(self.true)
        coming = min(left, *(len(request.ahead) for request in requests))
        block = list(self.true)
        block += [
            self.runner.render([request.ahead[k] for request in requests]) for k in range(coming)
        ]
        fixed = self._fix(self.fixer.preview, block)
        self.draft = [list(zip(*pair, strict=True)) for pair in zip(block, fixed, strict=True)]
        self.stats.drafts += 1
        self.stats.redrafts += len(self.true) > 1
        return fixed[len(self.true) - 1]

    def _check(self, requests: Sequence[RenderRequest]) -> None:
        names = [request.camera.name for request in requests]
        times = sorted({request.t_us for request in requests})
        self.cameras = self.cameras or names
        if names != self.cameras or len(times) > 1:
            raise RendererError(
                f"cameras {', '.join(names)} at {times} us, after {', '.join(self.cameras)} at one instant",
                "Give the policy's cameras one rate, or take a fixer of single frames",
            )
        if self.last_us is not None and times[0] <= self.last_us:
            raise RendererError(
                f"{times[0]} us: the last frame was of {self.last_us} us",
                "make a new renderer for every rollout",
            )
        self.last_us = times[0]


def _measured(frame: Frame, shown_error: Deviation, forecast: Deviation | None) -> Frame:
    """Add the pose errors of the frame shown and of the forecast to its facts."""
    facts = {"pose_error_m": shown_error.camera_m}
    if forecast is not None:
        facts["forecast_error_m"] = forecast.camera_m
    return replace(frame, facts={**frame.facts, **_rounded(facts)})


def _rounded(values: Mapping[str, float]) -> dict[str, float]:
    return {name: round(value, 6) for name, value in values.items()}
