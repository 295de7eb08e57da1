"""What policies of others are met with: what is wrong with a plan or with sensors, in a sentence,
and a scenario that says nothing.

A policy may return anything; nothing here assumes more than an object.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from alpasim_plugin.core.types import (
    I64,
    CameraSpec,
    Degradation,
    Environment,
    HeightField,
    LaneMap,
    Latency,
    Rates,
    Route,
    Scenario,
    SensorSpec,
    Trajectory,
    Vehicle,
)

REACH_M = 20_000.0  # of a plan, from where it is made
LONGEST_S = 600.0  # of a plan; what is longer counts in nanoseconds
MOST_SAMPLES = 1000  # of a plan: a log holds each at every query
MOST_POSES = 100_000  # of a plan and its samples together, for the same reason
STALE_S = 10.0  # between now and the first pose that somebody else's clock gave a plan
ARRAYS = ("times_us", "xy", "yaw")
UNITS = (
    (100.0, "centimetres"),
    (1000.0, "millimetres"),
    (0.001, "kilometres"),
    (3.28, "feet"),
    (3.6, "km/h taken for m/s"),
)


def unit_guess(ratio: float) -> str:
    """Name the unit in which lengths come out ``ratio`` times as large as in metres; empty where
    none fits.

    Example:
        >>> unit_guess(97.0), unit_guess(1.1)
        ('centimetres', '')
    """
    fits = [
        (abs(ratio / factor - 1.0), unit) for factor, unit in UNITS if 0.7 <= ratio / factor <= 1.3
    ]
    return min(fits)[1] if fits else ""


def sensors_problem(sensors: Any) -> str:
    """Say why ``sensors`` of a policy is not a sequence of `SensorSpec`; empty if it is one."""
    if isinstance(sensors, Sequence) and all(isinstance(sensor, SensorSpec) for sensor in sensors):
        odd = next((sensor for sensor in sensors if not isinstance(sensor.camera, str)), None)
        kind = "" if odd is None else type(odd.camera).__name__
        return f"SensorSpec of a {kind}, not of a camera's name such as 'front'" if kind else ""
    return f"sensors is {sensors!r:.80}, not a tuple of SensorSpec (alpasim_plugin.core.types)"


def shape_problem(plan: Any, min_rows: int = 1) -> str:
    """Say what keeps a plan from being read: another type, arrays of other shapes, values that are
    not finite; empty if nothing.

    Args:
        plan: What a policy's ``act`` returned.
        min_rows: Least number of poses.
    """
    absent = [name for name in ARRAYS if not hasattr(plan, name)]
    if absent:
        size = f" of shape {plan.shape}" if isinstance(plan, np.ndarray) else ""
        return f"act returned {_a(plan)}{size}, not a Plan (alpasim_plugin.core.types.Plan): it has no {', '.join(absent)}"
    for name in ARRAYS:
        value = getattr(plan, name)
        if not isinstance(value, np.ndarray):
            return f"{name} is {_a(value)}, not a numpy array"
        if value.dtype.kind not in "iuf":
            return f"{name} holds {value.dtype}, not numbers"
    n = len(plan.times_us) if plan.times_us.ndim == 1 else -1
    if n < min_rows or plan.xy.shape != (n, 2) or plan.yaw.shape != (n,):
        shapes = f"times_us {plan.times_us.shape}, xy {plan.xy.shape}, yaw {plan.yaw.shape}"
        guess = "; xy looks transposed" if plan.xy.shape == (2, n) else ""
        return f"the plan has {shapes}; needed are (T,), (T, 2), (T,) with T >= {min_rows}{guess}"
    bad = ~(np.isfinite(plan.xy).all(axis=1) & np.isfinite(plan.yaw))
    if bad.any():
        return f"the plan is not finite in {int(bad.sum())} of {n} rows, first in row {int(np.argmax(bad))}"
    far_m = float(np.abs(plan.xy).max(initial=0.0))
    if far_m > REACH_M:
        return f"the plan reaches {far_m:.3g} m, farther than the {REACH_M:g} m of the longest road"
    debug = getattr(plan, "debug", {})
    if not isinstance(debug, Mapping):
        return f"debug is {_a(debug)}, not a dictionary"
    return _samples_problem(getattr(plan, "samples", ()), n)


def _samples_problem(samples: Any, n: int) -> str:
    """Say what keeps the sampled alternatives of a plan of ``n`` poses from being read."""
    if not isinstance(samples, list | tuple):
        return f"samples is {_a(samples)}, not a tuple of arrays"
    if len(samples) > MOST_SAMPLES:
        return f"the plan has {len(samples):,} sampled alternatives; {MOST_SAMPLES:,} are the most that a log takes"
    if n * (1 + len(samples)) > MOST_POSES:
        beside = f", {len(samples):,} sampled alternatives included" if samples else ""
        return f"the plan has {n * (1 + len(samples)):,} poses{beside}; {MOST_POSES:,} are the most that a log takes"
    for sample in samples:
        if not isinstance(sample, np.ndarray) or sample.dtype.kind not in "iuf":
            return f"a sampled alternative is {_a(sample)}, not an array of numbers"
        if sample.shape != (n, 3) or not (np.abs(sample) <= REACH_M).all():
            return f"a sampled alternative has shape {sample.shape}, not ({n}, 3), is not finite, or reaches farther than {REACH_M:g} m"
    return ""


def plan_problem(plan: Any, now_us: int) -> str:
    """Say what keeps a plan made at ``now_us`` from being followed; empty if nothing."""
    problem = shape_problem(plan)
    if problem:
        return problem
    if plan.times_us.dtype.kind not in "iu":
        return f"times_us is {plan.times_us.dtype}, not integer microseconds"
    if int(plan.times_us[0]) != now_us:
        return f"times_us starts at {int(plan.times_us[0])} us, the observation is at {now_us} us"
    reach_s = (int(plan.times_us[-1]) - now_us) * 1e-6
    if reach_s > LONGEST_S:
        return f"the plan reaches {reach_s:,.0f} s ahead: its times are not in microseconds"
    steps = np.diff(plan.times_us.astype(np.int64))
    return (
        f"times_us does not increase strictly after row {int(np.argmax(steps <= 0))}"
        if (steps <= 0).any()
        else ""
    )


def clock_problem(times_us: I64, now_us: int) -> str:
    """Say what is wrong with the absolute times of a plan that another process made for ``now_us``:
    its clock, or its unit of time, is another one; empty if nothing.

    Args:
        times_us: ``(T,)`` increasing, T at least 1.
        now_us: When it was asked for.

    Example:
        >>> clock_problem(np.array([1_700_000_000]), 1_700_000_000_000_000)
        'the plan ends 1,699,998,300 s before now: times are microseconds of the clock of the query'
    """
    before_s = (now_us - int(times_us[-1])) * 1e-6
    away_s = (int(times_us[0]) - now_us) * 1e-6
    problem = ""
    if before_s > 0:
        problem = f"the plan ends {before_s:,.0f} s before now"
    elif abs(away_s) > STALE_S:
        problem = f"the plan begins {away_s:,.0f} s from now"
    return f"{problem}: times are microseconds of the clock of the query" if problem else ""


def _a(value: Any) -> str:
    return "nothing" if value is None else f"a {type(value).__name__}"


def blank_scenario(
    scene_id: str, ego_log: Trajectory, cameras: Sequence[CameraSpec] = ()
) -> Scenario:
    """Return a scenario with a flat ground, an empty map and no actors; all of the drive is the
    rollout.

    Args:
        scene_id: Its id.
        ego_log: Recorded rig poses, world.
        cameras: Its cameras.
    """
    return Scenario(
        scene_id=scene_id,
        source="yaml",
        seed=0,
        lane_map=LaneMap({}),
        ground=HeightField(0.0, 0.0, 1.0, np.zeros((2, 2))),
        ego_log=ego_log,
        vehicle=Vehicle(),
        route=Route(ego_log.xyz),
        actors=(),
        cameras=tuple(cameras),
        rates=Rates(),
        start_us=int(ego_log.t_us[0]),
        end_us=int(ego_log.t_us[-1]),
        warmup_us=0,
        latency=Latency(),
        environment=Environment(),
        degradation=Degradation(),
    )
