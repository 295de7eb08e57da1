"""Writes the files of one rollout: the log, per-frame facts, and on request a
video; collects stage times.
"""

from __future__ import annotations

import hashlib
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Literal

import numpy as np

from alpasim_plugin.core.clock import Clock
from alpasim_plugin.core.errors import SimrunError
from alpasim_plugin.core.files.places import temporary_folder
from alpasim_plugin.core.files.stage import announce
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.core.path_end import PathEnd
from alpasim_plugin.core.recorded_state import ego_states_from_log
from alpasim_plugin.core.types import (
    F64,
    OPACITY_MEAN,
    CameraSpec,
    EgoState,
    Frame,
    Observation,
    RenderRequest,
    RolloutLog,
    Scenario,
    Trajectory,
)
from alpasim_plugin.log import (
    AslWriter,
    RolloutHeader,
    read_asl,
    write_facts,
)
from alpasim_plugin.log.debug import FULL, MOST_BYTES, debug_row, size_of
from alpasim_plugin.log.run_folder.schema import (
    DEBUG_NAME,
    FRAMES_NAME,
    LOG_NAME,
)
from alpasim_plugin.log.schema import session_uuid
from alpasim_plugin.runs.film import Film

NO_PLAN = Trajectory(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 4)))


class StageTimes:
    """Collects durations by stage name."""

    def __init__(self) -> None:
        self._ms: dict[str, list[float]] = defaultdict(list)

    @contextmanager
    def measure(
        self, stage: str, shares: int = 1, within: Callable[[], Mapping[str, float]] | None = None
    ) -> Iterator[None]:
        """Time one pass through a stage; a stage that raises is timed as well.

        Args:
            stage: Its name.
            shares: Number of equal passes it counts as (frames of a block); 0 records nothing.
            within: Called after the pass; returns the parts of it, in milliseconds, that belong to
                other stages.
        """
        began = time.perf_counter()
        try:
            yield
        finally:
            parts = dict(within()) if within is not None and shares else {}
            all_ms = 1e3 * (time.perf_counter() - began)
            parts[stage] = parts.get(stage, 0.0) + all_ms - sum(parts.values())
            for name, part_ms in parts.items():
                self._ms[name] += [part_ms / max(shares, 1)] * shares

    def as_ms(self) -> dict[str, list[float]]:
        """Return all durations in milliseconds, rounded to a microsecond."""
        return {
            stage: [round(ms, 3) for ms in all_ms] for stage, all_ms in self._ms.items() if all_ms
        }


class Recorder:
    """Records a rollout in the loop's order.

    Args:
        scenario: What is driven.
        seed: Rollout seed, for the log's header.
        folder: Folder to write; by default a temporary one that is deleted with the recorder.
        session: Identifies the rollout in the log; equal rollouts have equal ids.
        images: Encoding of camera frames in the log.
        keep_frames: Keep the cameras' frames for a video.
        versions: Names of services for the log's header, such as ``{"sensorsim": "3dgs",
            "egodriver": "lane-camera"}``.
        digests: Digest of each of these services that has one.

    Attributes:
        film: The frames that were kept.
    """

    def __init__(
        self,
        scenario: Scenario,
        seed: int = 0,
        folder: Path | None = None,
        session: str = "",
        images: Literal["none", "jpeg", "png"] = "jpeg",
        keep_frames: bool = False,
        versions: Mapping[str, str] | None = None,
        digests: Mapping[str, str] | None = None,
    ) -> None:
        self._temporary = temporary_folder("simrun-") if folder is None else None
        self.folder = Path(self._temporary.name) if self._temporary else folder or Path()
        self._scenario = scenario
        self._seed = seed
        self._session = session_uuid(seed, session or f"{scenario.scene_id}/{seed}")
        self._images = images
        self._keep_frames = keep_frames
        self._versions = dict(versions or {})
        self._digests = dict(digests or {})
        self._times = StageTimes()
        self._frames: list[JsonObject] = []
        self._debug: list[JsonObject] = []
        self._debug_bytes = 0
        self.film = Film()
        self._last_query_us = -1
        self._steps = 0
        self._n_steps = 0
        self._first_call = 0
        self._passed = False
        self._ended = "time"
        self._writer: AslWriter | None = None

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *failure: object) -> None:
        if failure[0] is not None and self._writer is not None:
            self._writer.abandon()
            with suppress(SimrunError):  # the failure of the rollout says more
                self._write_rows()

    def stage(self, name: str) -> AbstractContextManager[None]:
        """Time one pass through a stage of the loop."""
        return self._times.measure(name)

    def rendering(self, renderer: Renderer, frames: int) -> AbstractContextManager[None]:
        """Time the rendering of ``frames`` frames; stages that the renderer reports are timed under
        their own names.
        """
        self._first_call = self._first_call or frames
        return self._times.measure("render", frames, lambda: renderer.stage_ms)

    # --- in the loop's order

    def start(self, clock: Clock, cameras: Mapping[str, CameraSpec]) -> None:
        """Open the log and write its header."""
        self._n_steps = clock.n_steps
        scenario = self._scenario
        header = RolloutHeader(
            scene_id=scenario.scene_id,
            session_uuid=self._session,
            vehicle=scenario.vehicle,
            actors=scenario.actors,
            ego_log=scenario.ego_log,
            render_start_us=scenario.start_us,
            force_gt_us=scenario.warmup_us,
            control_us=scenario.rates.control_us,
            n_steps=clock.n_steps,
            seed=self._seed,
            versions=self._versions,
            digests=self._digests,
        )
        self._writer = AslWriter(self.folder / LOG_NAME, header)
        self._writer.begin(list(cameras.values()))

    def poses(self, ego: EgoState, actors: Mapping[str, F64]) -> None:
        """Log the true poses of the ego and the actors."""
        with self.stage("log"):
            self._log.actor_poses(ego.t_us, ego.T_world_rig, actors)

    def frame(self, frame: Frame, request: RenderRequest) -> None:
        """Log one camera frame."""
        with self.stage("log"):
            if self._images != "none":
                self._log.render_request(request, self._images)
                self._log.camera_image(frame, self._images, request.camera.shutter_us)
            opacity = frame.facts.get(OPACITY_MEAN)
            if opacity is None and frame.alpha is not None:
                opacity = round(float(frame.alpha.mean()), 5)
            facts = {
                "t_us": frame.t_us,
                "camera": frame.camera,
                OPACITY_MEAN: opacity,
                "rgb_sha256": hashlib.sha256(frame.rgb.tobytes()).hexdigest()[:16],
                "events": " ".join(frame.events),
            }
            self._frames.append(facts | dict(frame.facts))
        if self._keep_frames:
            self.film.add(frame)

    def policy_query(self, observation: Observation, clock: Clock) -> None:
        """Log a policy query: ego motion and route."""
        with self.stage("log"):
            log = self._scenario.ego_log
            history = observation.history.t_us
            unlogged = history[(history > self._last_query_us) & (history < clock.start_us)]
            context = (
                ego_states_from_log(log, unlogged, self._scenario.vehicle) if len(unlogged) else []
            )
            self._log.ego_trajectory([*context, observation.ego])
            self._last_query_us = observation.t_us
            self._log.route(observation.t_us, observation.route_rig)
            self._log.driver_request(observation.t_us, observation.t_us + clock.rates.control_us)

    def policy_plan(self, plan: Trajectory, samples: Sequence[Trajectory], debug: JsonView) -> None:
        """Log the policy's plan and its samples, in world coordinates, and what it says of them."""
        with self.stage("log"):
            self._log.driver_return(plan, samples)
            if debug and self._debug_bytes < MOST_BYTES:
                row = debug_row(debug)
                self._debug_bytes += size_of(row)
                if self._debug_bytes >= MOST_BYTES:
                    row = debug_row({"debug": FULL})
                self._debug.append({"t_us": int(plan.t_us[0]), **row})

    def control_step(
        self, before: EgoState, plan: Trajectory | None, after: EgoState, forced: bool
    ) -> None:
        """Log one control step."""
        with self.stage("log"):
            self._log.controller_request(
                before, plan if plan is not None else NO_PLAN, after.t_us, forced
            )
            self._log.controller_return(after)
            self._steps += 1
            announce(f"driving {self._scenario.scene_id}: {self._steps} of {self._n_steps} steps")

    def finish(self, path_end: PathEnd) -> None:
        """Close the log and write the per-frame facts."""
        self._passed = path_end.passed
        self._ended = path_end.kind if path_end.passed else "time"
        with self.stage("log"):
            self._log.finish()
            self._write_rows()

    def _write_rows(self) -> None:
        """Write what the log has no place for: facts of frames, and the policy's debug output."""
        write_facts(self.folder / FRAMES_NAME, self._frames)
        if self._debug:
            write_facts(self.folder / DEBUG_NAME, self._debug)

    # --- after the rollout

    def log(self, images: bool = True) -> RolloutLog:
        """Read the finished log back."""
        return read_asl(self.folder / LOG_NAME, images=images)

    def facts(self) -> JsonObject:
        """Return counts and stage times for the manifest."""
        events = Counter(event for frame in self._frames for event in frame["events"].split())
        return {
            "frames": len(self._frames),
            "first_call_frames": self._first_call,
            "steps": self._steps,
            "frame_events": dict(events),
            "passed_path_end": self._passed,
            "ended": self._ended,
            "stage_ms": self._times.as_ms(),
            "session_uuid": self._session,
        }

    @property
    def _log(self) -> AslWriter:
        if self._writer is None:
            raise RuntimeError("Recorder.start was not called")
        return self._writer
