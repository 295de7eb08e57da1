"""Drive by a small network trained by imitation on clean frames: images, speed and a navigation
command in, trajectory out.
"""

from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from alpasim_plugin.core.devices import download, upload
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import direction_of
from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64, Observation, Plan, Route, Scenario, SensorSpec
from policies.base import MIN_CRUISE_MPS, camera_frame, plan_times, seconds
from policies.lane_plan import N_SAMPLES, NOISE_SPEED, correlated_noise, sampled
from policies.learned_input import (
    COMMANDS,
    route_command,
    view_camera,
)

FOLDER = Path(__file__).parent / "weights"
WEIGHTS = FOLDER / "learned.safetensors"
EARLIER_US = 500_000  # age of the earlier frame, which shows motion
EARLIEST_US = 700_000
MAX_SIGMA_M = 0.5
MAX_SIGMA_SPEED = 0.15
STANDS_MPS = 0.3


class Learned(Policy):
    """Predict a path and a speed profile with a network, and drive a sample of the prediction.

    It reads two frames, 0.5 s apart, of each camera that its weights declare, the car's speed, the
    initial speed of the drive as the desired speed, and one of five commands computed from the route
    (`policies.learned_input`). It gets no other information on the route: the position in the lane
    comes from the image. It was trained on frames of the renderer ``clean`` only.

    Args:
        scenario: Gives the cameras, the scene's id for the random streams, and nothing else.
        weights: File that ``simrun train policy`` wrote; None takes the class's ``files``. In runs,
            name a subclass whose ``files`` is the file: a rollout's content key holds that file's
            digest.
        temperature: Scale of the network's own standard deviations when a plan is drawn; 0 drives
            the mean.

    Raises:
        InputError: No camera for a view of the weights, the weights are missing or of another
            network, or the temperature is negative.
    """

    files: ClassVar[tuple[Path, ...]] = (WEIGHTS,)  # part of a rollout's key
    trained = True

    def __init__(
        self, scenario: Scenario, weights: Path | str | None = None, temperature: float = 1.0
    ) -> None:
        from policies.learned_net import knot_weights, load_net, path_grid  # imports torch

        if not (np.isfinite(temperature) and temperature >= 0):
            raise InputError(
                f"temperature: {temperature}",
                "give 0 or a positive number",
            )
        self.scene_id = scenario.scene_id
        self.temperature = float(temperature)
        self.net = load_net(type(self).files[0] if weights is None else Path(weights))
        self.cameras = [view_camera(scenario, view) for view in self.net.views]
        self.sensors: Sequence[SensorSpec] = tuple(
            SensorSpec(camera.name, device=True) for camera in self.cameras
        )
        self.grid_m = path_grid()
        self.weights = knot_weights()
        self.reset(0, scenario.route)

    def reset(self, seed: int, route: Route) -> None:
        """Start a new rollout."""
        self.seed, self.step, self.acted_us = seed, 0, 0
        self.noise: F64 | None = None  # errors of the samples, correlated over seconds
        self.desired_mps: float | None = None
        self.histories: list[deque[tuple[int, Any]]] = [deque() for _ in self.cameras]
        self.cutters: list[Any] = []  # one a view, made for the device of the first image

    def act(self, observation: Observation) -> Plan:
        """Return a plan sampled from the network's prediction for the newest frames.

        Raises:
            PolicyError: The observation has no frame of a camera, or one of another size.
        """
        frames = [camera_frame(observation, camera, "learned") for camera in self.cameras]
        if not self.cutters:
            self._begin_on(observation.image(self.cameras[0].name).device)
        for frame, cut, history in zip(frames, self.cutters, self.histories, strict=True):
            if not history or frame.t_us > history[-1][0]:
                image = upload(observation.image(frame.camera), self.device)
                history.append((frame.t_us, cut(image)))
            while history[0][0] < frame.t_us - EARLIEST_US:
                history.popleft()
        speed = max(observation.ego.speed_mps, 0.0)
        if self.desired_mps is None:
            self.desired_mps = max(speed, MIN_CRUISE_MPS)
        command = route_command(observation.route_rig)
        heading, speed_change, sigma = self._predict(speed, command)
        times = plan_times(observation.t_us)
        xy, yaw = self._mean(heading, speed_change, speed, seconds(times))
        random = stream(self.scene_id, self.seed, "policy", self.step)
        self.noise = correlated_noise(self.noise, (observation.t_us - self.acted_us) * 1e-6, random)
        self.step = self.step + 1
        self.acted_us = observation.t_us
        lateral_m, share = self.temperature * np.minimum(sigma, [MAX_SIGMA_M, MAX_SIGMA_SPEED])
        noise = np.concatenate([np.zeros((1, 2)), self.noise * [1.0, share / NOISE_SPEED]])
        plans = (
            sampled(xy, yaw, noise, float(lateral_m))[1:]
            if self.temperature
            else [np.column_stack([xy, yaw])] * N_SAMPLES
        )
        debug: dict[str, Any] = {"command": command, "desired_mps": self.desired_mps}
        debug.update(sigma_m=float(sigma[0]), sigma_speed=float(sigma[1]))
        return Plan(
            observation.t_us,
            times,
            plans[0][:, :2].copy(),
            plans[0][:, 2].copy(),
            tuple(plans[1:]),
            debug,
        )

    def _begin_on(self, device: Any) -> None:
        """Take images from a device, and run the network there."""
        from policies.learned_views import cutter

        self.device = device
        self.net.to(device)
        pairs = zip(self.cameras, self.net.views, strict=True)
        self.cutters = [cutter(camera, view, device) for camera, view in pairs]

    def _predict(self, speed_mps: float, command: str) -> tuple[F64, F64, F64]:
        """Return headings at the knots ``(9,)``, changes of speed ``(8,)`` and the standard
        deviations ``(2,)``.
        """
        import torch

        from policies.learned_net import SPEED_UNIT_MPS
        from policies.learned_views import network_input

        images = []
        real = True  # every camera has an earlier frame
        for history in self.histories:
            t_us, now = history[-1]
            earlier_us, earlier = min(history, key=lambda past: abs(t_us - EARLIER_US - past[0]))
            if t_us - earlier_us <= EARLIER_US // 2:
                earlier = now
                real = False
            images.append(network_input(now, earlier))
        assert self.desired_mps is not None
        state = [speed_mps / SPEED_UNIT_MPS, self.desired_mps / SPEED_UNIT_MPS, float(real)]
        threads = torch.get_num_threads()
        if threads != 1:
            # The order of summation in a convolution depends on the thread count
            torch.set_num_threads(1)
        try:
            with torch.no_grad():
                numbers = upload(torch.tensor([state]), self.device)
                word = upload(torch.tensor([COMMANDS.index(command)]), self.device)
                prediction = self.net(images, numbers, word)
        finally:
            if threads != 1:
                torch.set_num_threads(threads)
        heading, speed_change, sigma = (
            part[0].astype(np.float64)
            for part in download(prediction.heading, prediction.speed, prediction.sigma)
        )
        return heading, speed_change, sigma

    def _mean(self, heading: F64, speed_change: F64, speed_mps: float, t_s: F64) -> tuple[F64, F64]:
        """Return positions ``(T, 2)`` and headings ``(T,)`` at times ``(T,)`` of the mean
        prediction.
        """
        from policies.learned_net import TIMES_S

        speeds = np.maximum(
            np.interp(t_s, [0.0, *TIMES_S], speed_mps + np.array([0.0, *speed_change])), 0.0
        )
        speeds[speeds < STANDS_MPS * min(1.0, speed_mps)] = 0.0
        progress = np.concatenate(
            [[0.0], np.cumsum(0.5 * (speeds[1:] + speeds[:-1]) * np.diff(t_s))]
        )
        yaw = self.weights @ heading
        middle = 0.5 * (yaw[1:] + yaw[:-1])
        xy = np.concatenate(
            [
                np.zeros((1, 2)),
                np.cumsum(direction_of(middle), axis=0),
            ]
        )
        over = np.maximum(progress - self.grid_m[-1], 0.0)  # straight beyond the last knot
        pose_columns = [
            np.interp(progress, self.grid_m, column) for column in (xy[:, 0], xy[:, 1], yaw)
        ]
        return np.column_stack(
            [pose_columns[0] + over * np.cos(yaw[-1]), pose_columns[1] + over * np.sin(yaw[-1])]
        ), pose_columns[2]


class LearnedMean(Learned):
    """The same network at temperature 0."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario, temperature=0.0)


class LearnedThree(Learned):
    """The network with cameras to the front, the left and the right, which lets pass who comes from
    a side.
    """

    files = (FOLDER / "learned-three.safetensors",)
