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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
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


EXACT = Deviation(0.0, 0.0, 0.0)


def deviation(predicted: RenderRequest, true: RenderRequest) -> Deviation:
    """Compare two requests of one camera and instant."""
    before = predicted.T_world_camera
    now = true.T_world_camera
    moved = float(np.linalg.norm(before[:, :3, 3] - now[:, :3, 3], axis=1).max())
    turned = max(rotation_rad(one, two) for one, two in zip(before, now, strict=True))
    actors = [0.0]
    for key in predicted.actors.keys() | true.actors.keys():
        one = predicted.actors.get(key)
        two = true.actors.get(key)
        latest = predicted.actors[key] if two is None else two
        ray = latest[:3, 3] - now[-1, :3, 3]
        if float(ray @ now[-1, :3, 2]) < -BEHIND_M:
            continue
        if one is None or two is None:
            actors.append(math.inf)
            continue
        apart = float(np.linalg.norm(one[:3, 3] - two[:3, 3])) + ARM_M * rotation_rad(one, two)
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
    forecasts: list[Deviation] = field(default_factory=list)  # of predicted frames
    # between the pose of the frame shown and the true one
    shown: list[Deviation] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """Return the counts and, in metres and degrees, the largest errors of the forecasts and of
        the frames shown.
        """
        counts = {key: value for key, value in vars(self).items() if isinstance(value, int)}
        return {
            **counts,
            "forecast_error": _largest(self.forecasts),
            "shown_error": _largest(self.shown),
        }


class SpeculativeRenderer(FixedRenderer):
    """A session whose frames are fixed block by block and returned one by one.

    Cameras with the same frame times are one group and go through the fixer together, as views of
    one batch; every group has its own fixer.

    Args:
        runner: Renders and calls the fixer.
        make_fixer: Makes a fixer at the start of its history.
        settings: Tolerances.
        first: The fixer of the first group.
    """

    def __init__(
        self,
        runner: BlockRunner,
        make_fixer: Callable[[], Fixer],
        settings: FixerSettings,
        first: Fixer,
    ) -> None:
        super().__init__(runner, first, "speculative")
        self.settings = settings
        self._make = make_fixer
        # At least the next frame, which distinguishes cameras of other rates.
        self.lookahead = max(1, first.blocks.first - 1, first.blocks.then - 1)
        self._groups: dict[tuple[int, ...], _CameraGroup] = {}
        self._group_of: dict[str, _CameraGroup] = {}
        self.stats = SpeculationStats()

    def counts(self) -> dict[str, Any]:
        """Return the counts so far."""
        return self.stats.as_dict()

    def render_batch(self, requests: Sequence[RenderRequest]) -> list[Frame]:
        """Return the frames of one instant, in the order of the requests.

        Raises:
            RendererError: A camera without the others of its group, or time that does not increase.
            FixerError: The fixer broke its contract.
        """
        self.runner.reset_times()
        groups: dict[int, list[RenderRequest]] = {}
        for request in requests:
            groups.setdefault(id(self._group(request)), []).append(request)
        made: dict[str, Frame] = {}
        for group in groups.values():
            made |= self._group_of[group[0].camera.name].emit(group)
        return [made[request.camera.name] for request in requests]

    def _group(self, request: RenderRequest) -> _CameraGroup:
        name = request.camera.name
        if name not in self._group_of:
            times = (request.t_us, *(coming.t_us for coming in request.ahead))
            if times not in self._groups:
                fixer = self._make() if self._groups else self.fixer
                self._groups[times] = _CameraGroup(self.runner, fixer, self.settings, self.stats)
            self._group_of[name] = self._groups[times]
            self._groups[times].cameras.append(name)
        return self._group_of[name]


@dataclass
class _CameraGroup:
    """Cameras with the same frame times, and the block in progress."""

    runner: BlockRunner
    fixer: Fixer
    settings: FixerSettings
    stats: SpeculationStats
    cameras: list[str] = field(default_factory=list)
    done: int = 0  # complete blocks
    last_us: int | None = None
    true: list[list[ConditionedFrame]] = field(
        default_factory=list
    )  # instants of the block so far, a frame per camera each
    draft: list[list[tuple[ConditionedFrame, Frame]]] = field(
        default_factory=list
    )  # instants of the block, each per camera

    def emit(self, requests: Sequence[RenderRequest]) -> dict[str, Frame]:
        """Return the frames of one instant by camera."""
        requests = sorted(requests, key=lambda request: request.camera.name)
        self._check(requests)
        place = len(self.true)
        predicted = self.draft[place] if place < len(self.draft) else []
        self.true.append([self.runner.render(request) for request in requests])
        forecasts = [
            deviation(item.request, request)
            for (item, _), request in zip(predicted, requests, strict=bool(predicted))
        ]
        limits = self.settings.tolerance_m, self.settings.tolerance_deg
        is_hit = bool(predicted) and all(error.within(*limits) for error in forecasts)
        shown = [EXACT] * len(requests)
        if place + 1 == self.fixer.blocks.frames(self.done):
            frames = self._complete()
        elif is_hit:
            frames = [frame for _, frame in predicted]
            shown = forecasts
        else:
            frames = self._make_draft(requests)
        self.stats.frames += len(requests)
        self.stats.predicted += len(forecasts)
        self.stats.hits += len(requests) if is_hit else 0
        self.stats.forecasts += forecasts
        self.stats.shown += shown
        return {
            frame.camera: _measured(frame, shown[i], forecasts[i] if forecasts else None)
            for i, frame in enumerate(frames)
        }

    def _complete(self) -> list[Frame]:
        """Add the block of true poses to the history and return its last frames."""
        fixed = self._fix(self.fixer.step, self.true)
        self.done += 1
        self.stats.blocks += 1
        self.true = []
        self.draft = []
        return fixed[-1]

    def _make_draft(self, requests: Sequence[RenderRequest]) -> list[Frame]:
        """Fix the true frames so far with the predicted rest of the block and return the newest
        true ones.
        """
        left = self.fixer.blocks.frames(self.done) - len(self.true)
        coming = min(left, *(len(request.ahead) for request in requests))
        block = list(self.true)
        block += [
            [self.runner.render(request.ahead[k]) for request in requests] for k in range(coming)
        ]
        fixed = self._fix(self.fixer.preview, block)
        self.draft = [list(zip(*pair, strict=True)) for pair in zip(block, fixed, strict=True)]
        self.stats.drafts += 1
        self.stats.redrafts += len(self.true) > 1
        return fixed[len(self.true) - 1]

    def _fix(
        self, call: Callable[..., Sequence[Frame]], block: Sequence[Sequence[ConditionedFrame]]
    ) -> list[list[Frame]]:
        flat = self.runner.fix(self.fixer, call, [item for items in block for item in items])
        n = len(self.cameras)
        return [flat[i : i + n] for i in range(0, len(flat), n)]

    def _check(self, requests: Sequence[RenderRequest]) -> None:
        names = [request.camera.name for request in requests]
        times = sorted({request.t_us for request in requests})
        if names != sorted(self.cameras) or len(times) > 1:
            raise RendererError(
                f"cameras {', '.join(names)} at {times} us: the block in progress belongs to {', '.join(self.cameras)} at one instant",
                "request cameras with the same frame times together",
            )
        if self.last_us is not None and times[0] <= self.last_us:
            raise RendererError(
                f"{times[0]} us: the last frame was of {self.last_us} us",
                "make a new renderer for every rollout",
            )
        self.last_us = times[0]


def _measured(frame: Frame, shown: Deviation, forecast: Deviation | None) -> Frame:
    """Add the pose errors of the frame shown and of the forecast to its facts."""
    facts = {
        "pose_error_m": shown.camera_m,
        "pose_error_deg": shown.camera_deg,
        "actor_error_m": shown.actor_m,
    }
    if forecast is not None:
        facts |= {"forecast_error_m": forecast.camera_m, "forecast_error_deg": forecast.camera_deg}
    rounded = {name: round(value, 6) for name, value in facts.items()}
    return replace(frame, facts={**frame.facts, **rounded})


def _largest(errors: Sequence[Deviation]) -> dict[str, float | None]:
    """Return the largest of each kind of error; None where no value is finite."""
    out: dict[str, float | None] = {}
    for name in ("camera_m", "camera_deg", "actor_m"):
        values = (getattr(error, name) for error in errors)
        out[name] = max((round(v, 6) for v in values if math.isfinite(v)), default=None)
    return out
