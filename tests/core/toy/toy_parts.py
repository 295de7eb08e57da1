"""One part of every kind, as another package would bring them."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from alpasim_plugin.core.types import (
    Box,
    EgoState,
    Frame,
    Lane,
    LaneMap,
    MetricInfo,
    Plan,
    SensorSpec,
    Trajectory,
    Vehicle,
)
from alpasim_plugin.world.ground import flat
from evaluators import series
from scenarios.recorded import RecordedLog

LEVEL = 40
SPEED_MPS = 5.0
DIVISOR = 1.0


class Grey:
    """A renderer: one grey level."""

    def render(self, request):
        shape = (request.camera.height, request.camera.width, 3)
        return Frame(request.t_us, request.camera.name, np.full(shape, LEVEL, dtype=np.uint8))


class Remote(Grey):
    """A renderer whose pictures are made elsewhere: nothing here says what they are."""

    is_remote = True

    def __init__(self, address):
        self.address = address


class Brighten:
    """A fixer of one frame at a time: adds what its file of weights says."""

    files = ("gain.txt",)
    trained = True

    def reset(self, seed):
        self.gain = int(Path(__file__).with_name("gain.txt").read_text())

    def __init__(self, seed):
        self.reset(seed)

    def step(self, block, maps):
        return [replace(frame, rgb=frame.rgb + np.uint8(self.gain)) for frame in block]


class Straight:
    """A policy: straight on."""

    def __init__(self, scenario):
        self.sensors = [SensorSpec(scenario.cameras[0].name)]

    def reset(self, seed, route):
        pass

    def act(self, observation):
        times_us = observation.t_us + 100_000 * np.arange(30, dtype=np.int64)
        x = SPEED_MPS * 1e-6 * (times_us - observation.t_us)
        return Plan(observation.t_us, times_us, np.stack([x, 0 * x], axis=1), 0 * x)


class Jump:
    """A controller: the ego is at the plan's nearest pose."""

    def advance(self, state, plan, to_us):
        if plan is None:
            return replace(state, t_us=to_us)
        i = int(np.argmin(np.abs(plan.t_us - to_us)))
        pose = state.T_world_rig.copy()
        pose[:3, 3] = plan.xyz[i]
        return EgoState(to_us, pose, SPEED_MPS)


class Wobble:
    """A metric of its own."""

    metrics: ClassVar = {
        "toy_wobble_m": MetricInfo("m", "lower", "max", "largest lateral coordinate, for a test")
    }

    def __call__(self, rollout, scene):
        return [series("toy_wobble_m", rollout.ego.t_us, np.abs(rollout.ego.xyz[:, 1]) / DIVISOR)]


class Csv:
    """A source: a text file of ``t_us,x,y`` lines."""

    help = "toy drive (.toycsv)"

    def matches(self, path):
        return path.suffix == ".toycsv"

    def read(self, path, ego):
        data = path.read_bytes()
        rows = np.array([line.split(",") for line in data.decode().split()], dtype=np.float64)
        xyz = np.column_stack([rows[:, 1:], np.zeros(len(rows))])
        drive = Trajectory(
            rows[:, 0].astype(np.int64), xyz, np.tile([1.0, 0.0, 0.0, 0.0], (len(rows), 1))
        )
        lateral_m = np.array([0.0, 2.0, 0.0])
        lane = Lane("lane", xyz, xyz + lateral_m, xyz - lateral_m)
        return RecordedLog(
            path.stem,
            "toy",
            LaneMap({"lane": lane}),
            flat(0.0),
            drive,
            Vehicle(Box(4.0, 1.8, 1.5)),
            (),
            (),
            (0.0, 0.0, 0.0),
            hashlib.sha256(data).hexdigest(),
        )
