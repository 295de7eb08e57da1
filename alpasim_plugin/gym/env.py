"""The environment: the closed loop of a rollout, paused at every policy query."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple, SupportsFloat

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict

from alpasim_plugin.control import make_controller
from alpasim_plugin.control.bicycle import Command, step
from alpasim_plugin.control.tracker import check_interval, planar, spatial
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.places import temporary_folder
from alpasim_plugin.core.interfaces import Controller
from alpasim_plugin.core.plan_check import plan_problem
from alpasim_plugin.core.seeding import derive_seed
from alpasim_plugin.core.types import (
    F64,
    U8,
    EgoState,
    Observation,
    Plan,
    Scenario,
    SensorSpec,
    Trajectory,
    Vehicle,
)
from alpasim_plugin.gym.reward import Instant, Reward, Scorer
from alpasim_plugin.log.run_folder.schema import FRAMES_NAME, LOG_NAME
from alpasim_plugin.runs.recorder import Recorder
from alpasim_plugin.runs.renderer import make_renderer
from alpasim_plugin.runs.rollout import Loop
from alpasim_plugin.runs.scoring import score_log
from scenarios.load import load_scenario

# Of the plan that stands in the log for a held command
PREDICTED_US = 2_000_000
PREDICTED_STEP_US = 100_000
# Bounds of a trajectory, rig frame
FORWARD_M = 200.0
BACKWARD_M = 50.0
LATERAL_M = 100.0
ROUTE_POINTS = 20  # rows of the route
ROUTE_M = 200.0  # bound of its coordinates
SPEED_MPS = 100.0
ROLLOUT_SEEDS = 2**31


class Controls:
    """``(2,)`` in -1..1: steering angle of the wheels as a share of the vehicle's limit, left
    positive; throttle above 0, brake below.

    The vehicle's own limits apply, its steering rate too. The brake ends at a standstill. The
    command is held from the instant at which a plan made now would be followed: after the
    scenario's latency.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self.space = Box(-1.0, 1.0, (2,), np.float32)
        self.controller = HeldCommand(vehicle)
        self._vehicle = vehicle

    def plan(self, action: F64, observation: Observation) -> Plan:
        """Hold the command, and return where it leads in two seconds."""
        steer, pedal = np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0)
        command = self.controller.commands[observation.t_us] = Command(
            float(steer) * self._vehicle.max_steer_rad,
            float(max(pedal, 0.0) * self._vehicle.max_accel_mps2),
            float(max(-pedal, 0.0) * self._vehicle.max_brake_mps2),
        )
        times = observation.t_us + np.arange(0, PREDICTED_US + 1, PREDICTED_STEP_US)
        step_s = PREDICTED_STEP_US * 1e-6
        states = [replace(planar(observation.ego), x_m=0.0, y_m=0.0, yaw_rad=0.0)]
        for _ in times[1:]:
            states.append(step(states[-1], command, step_s, self._vehicle, step_s))
        rows = np.array([(state.x_m, state.y_m, state.yaw_rad) for state in states])
        return Plan(observation.t_us, times, rows[:, :2], rows[:, 2])


class HeldCommand(Controller):
    """A kinematic bicycle under commands: of a plan it takes when it was made, and holds the command
    of that instant; none, straight on at its speed, where there is no such command.

    Attributes:
        commands: By the time of the query that they answered.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self.commands: dict[int, Command] = {}

    def advance(self, state: EgoState, plan: Trajectory | None, to_us: int) -> EgoState:
        """Return the state at ``to_us``; see `Controller.advance`."""
        dt_s = check_interval(state, to_us)
        made_us = None if plan is None else int(plan.t_us[0])
        command = Command(0.0)
        if made_us is not None:
            command = self.commands.get(made_us, command)
        after = step(planar(state), command, dt_s, self._vehicle)
        z_m = float(state.T_world_rig[2, 3])
        accel = (after.speed_mps - state.speed_mps) / dt_s
        return spatial(after, to_us, z_m, accel, self._vehicle)


class Trajectories:
    """``(T, 3)``: x, y (metres) and yaw (radians) in the rig frame, at equal steps after now, the
    first step ahead.

    The tracking controller of runs follows it, as it follows a policy's plan.
    """

    def __init__(self, vehicle: Vehicle, horizon_us: int, step_us: int) -> None:
        n = horizon_us // step_us
        low = np.tile([-BACKWARD_M, -LATERAL_M, -np.pi], (n, 1))
        self.space = Box(low, np.tile([FORWARD_M, LATERAL_M, np.pi], (n, 1)), dtype=np.float64)
        self.controller = make_controller("bicycle", vehicle)
        self._after_us = step_us * np.arange(n + 1)

    def plan(self, action: F64, observation: Observation) -> Plan:
        """Return the action as a plan, which begins at the ego."""
        rows = np.vstack([np.zeros(3), np.asarray(action, dtype=np.float64)])
        return Plan(observation.t_us, observation.t_us + self._after_us, rows[:, :2], rows[:, 2])


class _Episode(NamedTuple):
    """An episode: the loop of its rollout, and what records and scores it."""

    folder: TemporaryDirectory[str]
    recorder: _Watching
    loop: Loop
    driving: Generator[Observation, Plan, None]
    scorer: Scorer


class DriveEnv(gymnasium.Env[dict[str, Any], Any]):  # type: ignore[misc]  # gymnasium is an extra
    """Drive a scenario; an episode is a rollout, with the loop, the renderer and the evaluators of
    a run.

    Observation, a dictionary: ``camera`` ``(H, W, 3)`` uint8 sRGB; ``speed`` ``(1,)`` float32 m/s;
    ``route`` ``(20, 3)`` float32, x and y in the rig frame (metres) and 1, or zeros after the
    route's end. Actions: `Controls` or `Trajectories`. Reward: `Reward`. An episode terminates with
    a collision or off the road, or where the recorded path ends, and is truncated when its time is
    up. ``info`` then holds ``ended`` and ``metrics``, the scores of the whole rollout as ``simrun
    score`` would give them.

    Args:
        scenario: File, recorded log, or shipped name.
        actions: ``controls`` or ``trajectory``.
        renderer: As `make_renderer` takes it.
        camera: Which camera; None: the scenario's first. An empty name: none, and nothing is
            rendered.
        scene_seeds: Each episode drives the scene of one of these seeds.
        overrides: ``key=value`` for the scenario, such as ``cameras=[{width: 64, height: 36}]``.
        preset: Evaluator preset: ``paper`` or ``strict``.
        reward: Weights.
        horizon_us: Of a trajectory.
        step_us: Between its poses.
        render_mode: ``rgb_array``: `render` returns the newest frame.

    Raises:
        InputError: Anything wrong with the arguments or the scenario.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  # Gymnasium's own form

    def __init__(
        self,
        scenario: str | Path = "smoke/curve",
        actions: Literal["controls", "trajectory"] = "controls",
        renderer: str = "clean",
        camera: str | None = None,
        scene_seeds: Sequence[int] = (0,),
        overrides: Sequence[str] = (),
        preset: Literal["paper", "strict"] = "strict",
        reward: Reward = Reward(),
        horizon_us: int = 2_000_000,
        step_us: int = 200_000,
        render_mode: str | None = None,
    ) -> None:
        self._scenarios = [load_scenario(scenario, seed, tuple(overrides)) for seed in scene_seeds]
        _check(self._scenarios, actions, preset, horizon_us, step_us)
        self._preset = preset
        self._reward = reward
        self._renderer = renderer
        self.render_mode = render_mode
        self._scenario = self._scenarios[0]
        names = [camera.name for camera in self._scenario.cameras]
        name = camera if camera is not None else names[0] if names else ""
        if name and name not in names:
            raise InputError(
                f"camera {name!r}: the scenario has {names}",
                "name one of them, or camera='' for none",
            )
        self._sensors = (SensorSpec(name),) if name else ()
        if not name:
            self.metadata = self.metadata | {"render_modes": []}
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise InputError(
                f"render_mode={render_mode!r}: it has {self.metadata['render_modes']}",
                "rgb_array needs a camera",
            )
        self._camera = next(
            (camera for camera in self._scenario.cameras if camera.name == name), None
        )
        vehicle = self._scenario.vehicle
        self._actions = (
            Controls(vehicle)
            if actions == "controls"
            else Trajectories(vehicle, horizon_us, step_us)
        )
        self.action_space = self._actions.space
        spaces: dict[str, Any] = {
            "speed": Box(-SPEED_MPS, SPEED_MPS, (1,), np.float32),
            "route": Box(-ROUTE_M, ROUTE_M, (ROUTE_POINTS, 3), np.float32),
        }
        if self._camera is not None:
            spaces["camera"] = Box(0, 255, (self._camera.height, self._camera.width, 3), np.uint8)
        self.observation_space = Dict(spaces)
        self._episode: _Episode | None = None
        self._over = True
        self._observation: Observation | None = None

    @property
    def scenario(self) -> Scenario:
        """Give what the present episode drives."""
        return self._scenario

    @property
    def observation(self) -> Observation:
        """Give the observation as policies get it: with times, poses and camera models."""
        if self._observation is None:
            raise InputError("an environment: no episode has begun", "call reset() first")
        return self._observation

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode; its scene and its rollout seed follow from the seed of the last `reset`
        that had one.

        Args:
            seed: Of the episodes from here on.
            options: ``scene_seed``: index into ``scene_seeds``; ``seed``: the rollout seed of this
                episode.
        """
        super().reset(seed=seed)
        self.close()
        # Both are drawn in any case, so that options change one episode only.
        drawn_scene = int(self.np_random.integers(len(self._scenarios)))
        drawn_seed = int(self.np_random.integers(ROLLOUT_SEEDS))
        wanted = {"scene_seed": drawn_scene, **(options or {})}
        scenario = self._scenario = self._scenarios[int(wanted["scene_seed"])]
        derived = derive_seed(scenario.scene_id, drawn_seed, "gym") % ROLLOUT_SEEDS
        seed = int(wanted.get("seed", derived))
        folder = temporary_folder("simrun-gym-")
        recorder = _Watching(scenario, seed, Path(folder.name))
        session = make_renderer(self._renderer, scenario, seed, threads=1)
        loop = Loop(scenario, session, self._sensors, self._actions.controller, recorder)
        driving = loop.drive()
        scorer = Scorer(scenario, self._preset, self._reward)
        if isinstance(self._actions, Controls):
            self._actions.controller.commands.clear()
        self._episode = _Episode(folder, recorder, loop, driving, scorer)
        self._over = False
        observation = next(driving)
        while observation.t_us < scenario.start_us + scenario.warmup_us:
            # The recording is forced: nothing to decide.
            # A plan that keeps heading and speed for two seconds.
            times = observation.t_us + np.arange(0, PREDICTED_US + 1, PREDICTED_STEP_US)
            ahead = observation.ego.speed_mps * (times - times[0]) * 1e-6
            still = np.zeros(len(times))
            observation = driving.send(
                Plan(observation.t_us, times, np.column_stack([ahead, still]), still)
            )
        self._observation = observation
        *_, facts = scorer.score(recorder.taken())
        info = {"seed": seed, "scene": scenario.scene_id, "t_us": observation.t_us, **facts}
        return self._values(), info

    def step(self, action: Any) -> tuple[dict[str, Any], SupportsFloat, bool, bool, dict[str, Any]]:
        """Act for one policy period.

        Raises:
            InputError: No episode runs, or the action is none.
        """
        episode = self._episode
        if episode is None or self._over:
            raise InputError("an environment: no episode runs", "call reset() first")
        plan = self._actions.plan(np.asarray(action), self.observation)
        problem = plan_problem(plan, self.observation.t_us)
        if problem:
            raise InputError(f"an action: {problem}", "give finite numbers within the action space")
        try:
            self._observation = episode.driving.send(plan)
        except StopIteration:
            self._over = True
        worth, ended, facts = episode.scorer.score(episode.recorder.taken())
        timed_out = self._over and not ended and not episode.loop.path_end.passed
        if self._over and not ended:
            ended = "time" if timed_out else "path_end"
        info: dict[str, Any] = {"t_us": episode.loop.state.ego.t_us, **facts}
        if ended:
            self._over = True
            episode.driving.close()
            episode.recorder.finish(episode.loop.path_end)
            folder = episode.recorder.folder
            _, scored = score_log(
                folder / LOG_NAME, folder / FRAMES_NAME, self._scenario, self._preset
            )
            info |= {
                "ended": ended,
                "metrics": {
                    name: entry.value if entry.valid else None
                    for name, entry in scored.metrics.items()
                },
            }
            cameras = {} if self._camera is None else {self._camera.name: self._camera}
            self._observation = episode.loop.state.observe(cameras)
        return self._values(), worth, bool(ended) and not timed_out, timed_out, info

    def render(self) -> U8 | None:
        """Return the newest frame ``(H, W, 3)``; None without render mode."""
        if self.render_mode is None:
            return None
        assert self._camera is not None, "a render mode needs a camera"
        return np.array(self.observation.frames[self._camera.name].rgb)

    def close(self) -> None:
        """End the episode, if one runs."""
        if self._episode is None:
            return
        if not self._over:  # the log of an episode that was left is not kept
            self._episode.driving.close()
            self._episode.recorder.__exit__(GeneratorExit, GeneratorExit(), None)
        self._episode.folder.cleanup()
        self._episode = None

    def _values(self) -> dict[str, Any]:
        """Return the newest observation as `observation_space` has it: a point of the route that is
        not known is 0, and so is its third number.
        """
        observation = self.observation
        speed = np.clip([observation.ego.speed_mps], -SPEED_MPS, SPEED_MPS)
        is_known = np.isfinite(observation.route_rig).all(axis=1)
        route = np.zeros((ROUTE_POINTS, 3), dtype=np.float32)
        route[is_known, :2] = np.clip(observation.route_rig[is_known, :2], -ROUTE_M, ROUTE_M)
        route[is_known, 2] = 1.0
        values = {"speed": speed.astype(np.float32), "route": route}
        if self._camera is not None:
            values["camera"] = np.array(observation.frames[self._camera.name].rgb)
        return values


class _Watching(Recorder):
    """Records a rollout without images, and keeps the instants that nobody has scored yet."""

    def __init__(self, scenario: Scenario, seed: int, folder: Path) -> None:
        super().__init__(scenario, seed, folder, images="none")
        self._new: list[Instant] = []

    def poses(self, ego: EgoState, actors: Mapping[str, F64]) -> None:
        super().poses(ego, actors)
        self._new.append((ego, dict(actors)))

    def taken(self) -> list[Instant]:
        """Return the instants since the last call."""
        new = self._new
        self._new = []
        return new


def _check(
    scenarios: Sequence[Scenario], actions: str, preset: str, horizon_us: int, step_us: int
) -> None:
    faults = {
        f"scene_seeds={()}": not scenarios,
        "latency=measured": "measured" in {scenario.latency.kind for scenario in scenarios},
        f"actions={actions!r}": actions not in ("controls", "trajectory"),
        f"preset={preset!r}": preset not in ("paper", "strict"),
        f"horizon_us={horizon_us}, step_us={step_us}": not 0 < step_us <= horizon_us
        or horizon_us % step_us > 0,
    }
    for argument, wrong in faults.items():
        if wrong:
            raise InputError(f"an environment cannot have {argument}", "see docs/gym.md")
