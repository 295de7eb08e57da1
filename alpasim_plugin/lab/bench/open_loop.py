"""What a policy plans when it is asked with a series of images along a recorded drive.

Nothing is driven: at every image the ego is where the image was taken from, moves as the recording
moved there, and has the recording's history behind it. Plans of two series of images from the same
places differ only by what the images show, and by what the policy remembers of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from alpasim_plugin.core.errors import InputError, PolicyError
from alpasim_plugin.core.geometry import interpolate, inverse, quat_from_matrix
from alpasim_plugin.core.interfaces import Policy, complete
from alpasim_plugin.core.parts import PartSpec, build
from alpasim_plugin.core.recorded_state import ego_state_from_log
from alpasim_plugin.core.types import (
    F64,
    U8,
    CameraSpec,
    EgoState,
    Frame,
    Observation,
    Plan,
    Scenario,
    SensorSpec,
    Trajectory,
    read_only,
)
from alpasim_plugin.runs.guards import calling, checked_plan, checked_sensors, reset_policy
from alpasim_plugin.world.route import RouteAhead, from_offset

View = Literal["held-out", "never-fitted", "fitted", "drawn"]
MOST_TURN_DEG = 20.0  # between a camera and the one in whose place it is shown
SAME_K_PX = 0.5


@dataclass(frozen=True, eq=False)
class TrueImage:
    """An image that counts as the truth, and where it was taken from.

    Attributes:
        use: What a renderer may know of it; ``drawn``: of a built scene.
        T_world_camera: ``(4, 4)``.
        K: ``(3, 3)`` pixels, of the image.
        rgb: ``(H, W, 3)``.
        distance_m: From the recorded path.
    """

    t_us: int
    use: View
    T_world_camera: F64
    K: F64
    rgb: U8
    distance_m: float


@dataclass(frozen=True, eq=False)
class Role:
    """Which series of images is shown to a policy as which of its cameras.

    Attributes:
        series_by_camera: Name of the series by name of the policy's camera; the first camera's images are the
            instants at which the policy is asked.
        scenario: What the policy is built for: its cameras have the calibration of the images.
        is_moved: Whether another camera's images are shown in the place of the policy's camera.
    """

    series_by_camera: Mapping[str, str]
    scenario: Scenario
    is_moved: bool

    @property
    def front(self) -> CameraSpec:
        """The policy's first camera."""
        return _camera(self.scenario, next(iter(self.series_by_camera)))


def roles_of(
    spec: PartSpec, scenario: Scenario, series: Mapping[str, Sequence[TrueImage]]
) -> tuple[list[Role], list[str]]:
    """Return the ways in which the policy can be asked with the series, and what could not be shown
    to it.

    All cameras of the policy have a series: they are shown as they are. A policy with one camera also
    gets every other series that looks the same way, in the place of its camera: with the calibration
    of the images and the mount of its own camera, so that the ego stands beside the recorded path.

    Args:
        spec: The policy.
        scenario: The drive.
        series: Images by camera, in order of time.

    Raises:
        InputError: The policy has no camera, or no series can be shown to it.
        PolicyError: The policy raised.
    """
    names = [sensor.camera for sensor in sensors_of(spec, scenario)]
    if not names:
        raise InputError(
            f"--policy {spec.name}: it has no camera, so that no image changes its plans",
            "name a policy that sees the road, for example learned",
        )
    roles = []
    notes = []
    if all(name in series for name in names):
        roles.append(Role({name: name for name in names}, scenario, False))
    else:
        lacking = [name for name in names if name not in series]
        notes.append(
            f"{spec.name}: no photograph of camera {', '.join(lacking)} that the fit did not see"
        )
    others = [name for name in series if name not in names]
    for name in others:
        turn_deg = _turn_deg(scenario, names[0], series[name])
        if len(names) > 1:
            notes.append(f"{spec.name}: it has {len(names)} cameras, {name} stands in for none")
        elif turn_deg > MOST_TURN_DEG:
            notes.append(
                f"{spec.name}: camera {name} looks {turn_deg:.0f} degrees away from {names[0]}"
            )
        else:
            roles.append(
                Role({names[0]: name}, _calibrated(scenario, names[0], series[name]), True)
            )
    if not roles:
        raise InputError(
            f"--policy {spec.name}: nothing of {scenario.scene_id} can be shown to it: {'; '.join(notes)}",
            "import the drive with the cameras that the policy has, or choose another policy",
        )
    return roles, notes


def sensors_of(spec: PartSpec, scenario: Scenario) -> list[SensorSpec]:
    """Return the cameras of a policy in a scenario; it is built and closed for that.

    Raises:
        InputError: The scenario lacks a camera that the policy needs.
        PolicyError: The policy raised.
    """
    policy = complete(build(spec, scenario=scenario), Policy)
    with closing(policy):
        return list(checked_sensors(policy))


def _turn_deg(scenario: Scenario, name: str, images: Sequence[TrueImage]) -> float:
    """Return the angle between the optical axes of images and of the scenario's camera ``name`` on the
    recorded drive, in the middle of them.
    """
    image = images[len(images) // 2]
    T_world_rig = interpolate(scenario.ego_log, image.t_us)
    axis = (T_world_rig @ _camera(scenario, name).T_rig_camera)[:3, 2]
    return float(np.degrees(np.arccos(np.clip(axis @ image.T_world_camera[:3, 2], -1.0, 1.0))))


def _calibrated(scenario: Scenario, name: str, images: Sequence[TrueImage]) -> Scenario:
    """Return a scenario whose camera ``name`` has the size and ``K`` of images, and its own mount.

    Raises:
        InputError: The images have several calibrations.
    """
    K = images[0].K
    size = images[0].rgb.shape
    if any(
        image.rgb.shape != size or np.abs(image.K - K).max() > SAME_K_PX for image in images[1:]
    ):
        raise InputError(
            f"{scenario.scene_id}: photographs of several calibrations cannot be shown as the camera {name!r}",
            "import the drive with one calibration for each camera",
        )
    cameras = tuple(
        replace(camera, width=size[1], height=size[0], K=K, lens=None)
        if camera.name == name
        else camera
        for camera in scenario.cameras
    )
    return replace(scenario, cameras=cameras)


def _camera(scenario: Scenario, name: str) -> CameraSpec:
    return next(camera for camera in scenario.cameras if camera.name == name)


def plans_of(
    spec: PartSpec,
    role: Role,
    series: Mapping[str, Sequence[TrueImage]],
    images: Mapping[str, Sequence[U8]],
    seed: int,
) -> list[Plan | None]:
    """Return a new policy's plan at every instant of the first camera's series, in order of time; None
    where another camera has shown nothing yet.

    Args:
        spec: The policy.
        role: Which series it sees as which camera.
        series: Where and when the images were taken, by series.
        images: What is shown, by series: as many ``(H, W, 3)`` as the series has.
        seed: Of the policy's noise.

    Raises:
        InputError: The recording lacks an instant of the series.
        PolicyError: The policy raised, or broke its contract.
    """
    policy = complete(build(spec, scenario=role.scenario), Policy)
    plans: list[Plan | None] = []
    with closing(policy):
        reset_policy(policy, seed, role.scenario.route)
        route_ahead = RouteAhead(role.scenario.route)
        frames: dict[str, Frame] = {}
        for number, image in enumerate(series[role.series_by_camera[role.front.name]]):
            frames = _newest_frames(role, series, images, image.t_us, number)
            is_complete = len(frames) == len(role.series_by_camera)
            observation = _observation(role, image, frames, route_ahead)
            plans.append(checked_plan(policy, observation) if is_complete else None)
        with calling(policy, "end", PolicyError):
            policy.end(frames)
    return plans


def _newest_frames(
    role: Role,
    series: Mapping[str, Sequence[TrueImage]],
    images: Mapping[str, Sequence[U8]],
    t_us: int,
    number: int,
) -> dict[str, Frame]:
    """Return the newest frame of each camera at ``t_us``, which is that of image ``number`` of the
    first camera.
    """
    frames = {}
    for camera, name in role.series_by_camera.items():
        is_front = camera == role.front.name
        times_us = [image.t_us for image in series[name]]
        newest = number if is_front else int(np.searchsorted(times_us, t_us, side="right")) - 1
        if newest >= 0:
            frames[camera] = read_only(Frame(times_us[newest], camera, images[name][newest]))
    return frames


def _observation(
    role: Role, image: TrueImage, frames: Mapping[str, Frame], route_ahead: RouteAhead
) -> Observation:
    scenario = role.scenario
    ego = ego_at(scenario, image, role.front)
    return Observation(
        image.t_us,
        frames,
        {name: read_only(_camera(scenario, name)) for name in role.series_by_camera},
        read_only(ego),
        read_only(_history(scenario.ego_log, ego)),
        from_offset(route_ahead.in_rig(ego.T_world_rig), scenario.route_offset_m),
    )


def ego_at(scenario: Scenario, image: TrueImage, camera: CameraSpec) -> EgoState:
    """Return the ego whose ``camera`` took an image: where that is, moving as recorded.

    Raises:
        InputError: The image was taken outside the recorded drive.
    """
    recorded = ego_state_from_log(scenario.ego_log, image.t_us, scenario.vehicle)
    return replace(recorded, T_world_rig=image.T_world_camera @ inverse(camera.T_rig_camera))


def _history(log: Trajectory, ego: EgoState) -> Trajectory:
    """Return the recorded rig poses up to now, all shifted as the ego now stands beside them."""
    times_us = np.append(log.t_us[log.t_us < ego.t_us], ego.t_us)
    recorded = interpolate(log, times_us)
    T_rig_ego = inverse(recorded[-1]) @ ego.T_world_rig
    poses = recorded @ T_rig_ego
    return Trajectory(times_us, poses[:, :3, 3], quat_from_matrix(poses[:, :3, :3]))
