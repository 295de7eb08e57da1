"""Writes the files of one rollout: the log, per-frame facts and images; collects stage times."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np

from alpasim_plugin.core.clock import Clock
from alpasim_plugin.core.types import (
    F64,
    CameraSpec,
    EgoState,
    Frame,
    Observation,
    Renderer,
    RenderRequest,
    RolloutLog,
    Scenario,
    SensorSpec,
    Trajectory,
)
from alpasim_plugin.log import AslWriter, header_from_scenario, read_asl, write_facts
from alpasim_plugin.log.session import session_uuid
from alpasim_plugin.runtime.path_end import PathEnd
from alpasim_plugin.runtime.pictures import Pictures
from alpasim_plugin.runtime.plan_motion import PlanMotion
from alpasim_plugin.runtime.stages import StageTimes
from alpasim_plugin.world.ego import ego_states_from_log

LOG_NAME, FRAMES_NAME, OUTPUT_NAME = "rollout.asl", "frames.jsonl", "output.log"
NO_PLAN = Trajectory(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 4)))


class Recorder:
    """Records a rollout in the loop's order.

    Args:
        scenario: What is driven.
        seed: Rollout seed, for the log's header.
        folder: Folder to write; by default a temporary one that is deleted with the recorder.
        session: Identifies the rollout in the log; equal rollouts have equal ids.
        images: Encoding of camera frames in the log.
        keep_frames: Keep every frame for a video, not only those of the strip.
        versions: Names of services for the log's header, such as ``{"sensorsim": "3dgs", "egodriver": "lane-camera"}``.
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
    ) -> None:
        self._temporary = tempfile.TemporaryDirectory(prefix="simrun-") if folder is None else None
        self.folder = Path(self._temporary.name) if self._temporary else folder or Path()
        self._scenario, self._seed = scenario, seed
        self._session = session_uuid(seed, session or f"{scenario.scene_id}/{seed}")
        self._images, self._keep_frames, self._versions = images, keep_frames, dict(versions or {})
        self._times = StageTimes()
        self.plan_motion = PlanMotion(scenario.vehicle)
        self._frames: list[dict[str, Any]] = []
        self._pictures: Pictures | None = None
        self._only_watched = False
        self._last_query_us = -1
        self._steps = self._first_call = 0
        self._passed = False
        self._writer: AslWriter | None = None

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        if error is not None and self._writer is not None:
            self._writer.abandon()

    def stage(self, name: str) -> AbstractContextManager[None]:
        """Time one pass through a stage of the loop."""
        return self._times.measure(name)

    def rendering(self, renderer: Renderer, frames: int) -> AbstractContextManager[None]:
        """Time the rendering of ``frames`` frames; stages that the renderer reports are timed under their own names."""
        if self._only_watched:
            return nullcontext()
        self._first_call = self._first_call or frames
        return self._times.measure("render", frames, lambda: renderer.stage_ms)

    def watch(self, scenario: Scenario) -> tuple[SensorSpec, ...]:
        """Return the camera to render for a policy without one: the scenario's first if a video is kept, else none.

        Its frames go into the pictures alone: neither the log nor times nor scores depend on whether somebody watches.
        """
        self._only_watched = self._keep_frames and bool(scenario.cameras)
        return (SensorSpec(scenario.cameras[0].name),) if self._only_watched else ()

    # --- in the loop's order ----------------------------------------------------------------------------------------

    def start(self, clock: Clock, cameras: Mapping[str, CameraSpec]) -> None:
        """Open the log and write its header."""
        if cameras:
            self._pictures = Pictures(clock, next(iter(cameras)), self._keep_frames)
        header = header_from_scenario(self._scenario, self._session, self._seed, clock.n_steps, self._versions)
        self._writer = AslWriter(self.folder / LOG_NAME, header)
        self._writer.begin([] if self._only_watched else list(cameras.values()))

    def poses(self, ego: EgoState, actors: Mapping[str, F64]) -> None:
        """Log the true poses of the ego and the actors."""
        with self.stage("log"):
            self._log.actor_poses(ego.t_us, ego.T_world_rig, actors)

    def frame(self, frame: Frame, request: RenderRequest) -> None:
        """Log one camera frame."""
        if self._only_watched:
            if self._pictures is not None:
                self._pictures.add(frame)
            return
        with self.stage("log"):
            if self._images != "none":
                self._log.render_request([request], self._images)
                self._log.camera_image(frame, self._images, request.camera.shutter_us)
            self._frames.append(
                {
                    "t_us": frame.t_us,
                    "camera": frame.camera,
                    "opacity_mean": None if frame.alpha is None else round(float(frame.alpha.mean()), 5),
                    "rgb_sha256": hashlib.sha256(frame.rgb.tobytes()).hexdigest()[:16],
                    "events": " ".join(frame.events),
                }
                | dict(frame.facts)
            )
            if self._pictures is not None:
                self._pictures.add(frame)

    def policy_query(self, observation: Observation, clock: Clock) -> None:
        """Log a policy query: ego motion and route."""
        with self.stage("log"):
            log, history = self._scenario.ego_log, observation.history.t_us
            unlogged = history[(history > self._last_query_us) & (history < clock.start_us)]
            context = ego_states_from_log(log, unlogged, self._scenario.vehicle) if len(unlogged) else []
            self._log.ego_trajectory([*context, observation.ego])
            self._last_query_us = observation.t_us
            self._log.route(observation.t_us, observation.route_rig)
            self._log.driver_request(observation.t_us, observation.t_us + clock.rates.control_us)

    def policy_plan(self, plan: Trajectory, samples: Sequence[Trajectory]) -> None:
        """Log the policy's plan and its samples, in world coordinates."""
        with self.stage("log"):
            self._log.driver_return(plan, samples)

    def control_step(self, before: EgoState, plan: Trajectory | None, after: EgoState, forced: bool) -> None:
        """Log one control step."""
        with self.stage("log"):
            self._log.controller_request(before, plan if plan is not None else NO_PLAN, after.t_us, forced)
            self._log.controller_return(after)
            self._steps += 1

    def finish(self, path_end: PathEnd) -> None:
        """Close the log and write the per-frame facts."""
        self._passed = path_end.passed
        with self.stage("log"):
            self._log.finish()
            write_facts(self.folder / FRAMES_NAME, self._frames)

    # --- after the rollout ------------------------------------------------------------------------------------------

    def log(self, images: bool = True) -> RolloutLog:
        """Read the finished log back."""
        return read_asl(self.folder / LOG_NAME, images=images)

    def facts(self) -> dict[str, Any]:
        """Return counts and stage times for the manifest."""
        events: dict[str, int] = {}
        for frame in self._frames:
            for event in frame["events"].split():
                events[event] = events.get(event, 0) + 1
        return {
            "frames": len(self._frames),
            "first_call_frames": self._first_call,
            "steps": self._steps,
            "frame_events": events,
            "passed_path_end": self._passed,
            "plan_motion": self.plan_motion.facts(),
            "stage_ms": self._times.as_ms(),
            "session_uuid": self._session,
            "strip_t_us": [] if self._pictures is None else self._pictures.strip_us,
        }

    def save_pictures(self, video: bool) -> None:
        """Write the strip of frames, and the video if requested."""
        if self._pictures is not None:
            self._pictures.save(self.folder, video)

    @property
    def _log(self) -> AslWriter:
        if self._writer is None:
            raise RuntimeError("Recorder.start was not called")
        return self._writer
