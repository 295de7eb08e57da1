"""The only data that crosses from one stage to the next: frozen dataclasses with shapes, units and
frames.

Conventions (docs/architecture.md): time is integer microseconds; world is ENU metres in float64
    around a local origin; rig is x forward,
y left, z up with its origin on the ground under the rear axle; cameras are OpenCV (x right, y down,
z forward); a matrix ``T_a_b`` maps coordinates in b to coordinates in a; quaternions are ``wxyz``;
images are HWC uint8 sRGB.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, Protocol, Self, TypeVar, cast

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.map_types import F64 as F64
from alpasim_plugin.core.map_types import Box as Box
from alpasim_plugin.core.map_types import HeightField as HeightField
from alpasim_plugin.core.map_types import Lane as Lane
from alpasim_plugin.core.map_types import LaneMap as LaneMap
from alpasim_plugin.core.map_types import LaneMarkType as LaneMarkType
from alpasim_plugin.core.map_types import Marking as Marking
from alpasim_plugin.core.map_types import Route as Route
from alpasim_plugin.core.map_types import Signal as Signal
from alpasim_plugin.core.metric_types import Aggregation as Aggregation
from alpasim_plugin.core.metric_types import Direction as Direction
from alpasim_plugin.core.metric_types import MetricInfo as MetricInfo

F32 = npt.NDArray[np.float32]
I64 = npt.NDArray[np.int64]
U8 = npt.NDArray[np.uint8]
Bool = npt.NDArray[np.bool_]
FloatArray = npt.NDArray[np.floating]  # of either precision
RecordT = TypeVar("RecordT")


# --- motion


@dataclass(frozen=True)
class Trajectory:
    """Poses of one body over time; the frame of the poses is said where a trajectory is used."""

    t_us: I64  # (T,) int64 microseconds, strictly increasing
    xyz: F64  # (T, 3) metres, world
    quat: F64  # (T, 4) wxyz, unit, body to world

    def __len__(self) -> int:
        return int(self.t_us.shape[0])


@dataclass(frozen=True)
class Vehicle:
    """The ego's body and chassis. The box centre lies at ``(rear_axle_to_centre_m, 0, box.height_m
    / 2)`` in the rig frame.
    """

    box: Box = Box(4.855, 1.88, 1.6)
    rear_axle_to_centre_m: float = 1.4
    wheelbase_m: float = 2.85
    max_steer_rad: float = 0.6
    max_steer_rate_radps: float = 0.8
    max_accel_mps2: float = 3.5
    max_brake_mps2: float = 8.0
    friction: float | None = None  # coefficient between tyres and road; None: they do not slip


@dataclass(frozen=True)
class EgoState:
    """True state of the ego at one instant."""

    t_us: int  # of the state
    T_world_rig: F64  # (4, 4)
    speed_mps: float  # along rig x; negative in reverse
    accel_mps2: float = 0.0  # along rig x
    yaw_rate_radps: float = 0.0  # to the left positive
    steer_rad: float = 0.0  # road-wheel angle, left positive


# --- actors


@dataclass(frozen=True)
class Behaviour:
    """How an actor moves once the loop is closed.

    ``replay``: on its track. ``yield``: on its track, but it waits where it would walk into the
    ego's way. ``idm``: it follows its lane behind a leader. ``adversary``: along its track at a speed
    by which it is ahead of the ego at a place; then it takes another speed.
    """

    kind: Literal["replay", "yield", "idm", "adversary"] = "replay"
    # idm: desired_speed_mps, headway_s, min_gap_m, accel_mps2, brake_mps2; adversary: gap_m, act_us,
    # speed_mps, end_speed_mps, decel_mps2
    params: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Actor:
    """A road user or obstacle with its recorded or scripted track (pose of the box centre in the
    world).
    """

    actor_id: str
    label: str  # car | truck | bus | pedestrian | cyclist | motorcycle | other
    box: Box
    track: Trajectory
    is_static: bool = False
    behaviour: Behaviour = Behaviour()
    appearance: str | None = None  # a Gaussian file in the box's frame; None: built


# --- sensors


@dataclass(frozen=True)
class LensModel:
    """What a lens does to rays, beside the ``K`` of its camera; equations in `cameras.lens`."""

    kind: Literal["opencv", "fisheye", "ftheta"]
    # opencv: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4. fisheye: k1 to k4. ftheta: the distance from the
    # middle, pixels, as a polynomial of the angle from the axis, radians, from the constant upwards
    coefficients: tuple[float, ...] = ()
    pixel_to_angle: tuple[float, ...] = ()  # ftheta: the other way round; goes before coefficients
    linear: tuple[float, float, float] = (1.0, 0.0, 0.0)  # ftheta: c, d, e of [[c, d], [e, 1]]
    max_angle_rad: float = 0.0  # sees nothing beyond it; 0: as far as the distance grows


@dataclass(frozen=True)
class CameraSpec:
    """A camera on the rig, a pinhole unless it has a ``lens``."""

    name: str  # in the scenario
    width: int  # pixels
    height: int  # pixels
    K: F64  # (3, 3) pixels; of an ftheta lens only the middle counts
    T_rig_camera: F64  # (4, 4)
    shutter_us: int = 0  # rows are exposed one after another, top to bottom, within it; 0: at once
    lens: LensModel | None = None  # None: a pinhole
    interval_us: int = 0  # between frames; 0: the scenario's camera period


@dataclass(frozen=True)
class SensorSpec:
    """What a policy asks for: a camera by name, every ``interval_us`` (0: at the camera's own
    rate).
    """

    camera: str  # its name in the scenario
    interval_us: int = 0  # between its images; 0: the camera's own
    device: bool = False  # its image as a tensor, see `Observation.image`


@dataclass(frozen=True, eq=False)
class Exposure:
    """When a rolling shutter exposes the pixels of a frame; see `cameras.shutter`."""

    # (H, W), (H, 1) or (1, W): 0 at shutter start, 1 at its end; NaN: nobody looks at that pixel
    share: F32
    # T_world_box (4, 4) at shutter start, of the same actors as at its end
    actors_start: Mapping[str, F64]


@dataclass(frozen=True)
class RenderRequest:
    """One frame to render."""

    t_us: int  # shutter end
    camera: CameraSpec  # its calibration
    T_world_camera: F64  # (2, 4, 4): at shutter start and at shutter end
    actors: Mapping[str, F64]  # actor id -> T_world_box (4, 4), only actors present at t_us
    # forecast of this camera's next requests; only for a renderer with `lookahead`
    ahead: Sequence[RenderRequest] = ()
    # of a rolling shutter; None: all pixels are exposed at the shutter's end
    exposure: Exposure | None = None

    def __post_init__(self) -> None:
        shape = np.shape(self.T_world_camera)
        if shape != (2, 4, 4):
            raise InputError(
                f"RenderRequest: T_world_camera of shape {shape}, where (2, 4, 4) is needed",
                "Give the poses at shutter start and shutter end: np.stack([start, end]).",
            )


# Facts of a frame that a fixer made of recorded ones: shares of the image, 0 to 1, and both by
# cell (`fixers.trust`).
RECORDED_SHARE = "recorded_share"
GUESSED_SHARE = "guessed_share"
TRUST_CELLS = "trust_cells"
OPACITY_MEAN = "opacity_mean"  # of a frame whose opacity stayed on a device


class DevicePlanes(Protocol):
    """The planes of a frame as tensors of a device."""

    rgb: Any  # (H, W, 3) uint8
    alpha: Any  # (H, W) float32
    depth: Any  # (H, W) float32
    pairs: Any  # () int64, downloaded with what is made of the planes, and given to `had_room`
    references: Any  # (K, H, W, 4) uint8, recorded frames warped into the view; None: none

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        ...

    @property
    def arrays(self) -> Mapping[str, Any]:
        """All planes by name, brought to the host in one copy when they are first read."""
        ...

    @property
    def had_room(self) -> Callable[[int], bool]:
        """Whether the device had room for all pairs; otherwise splats are missing."""
        ...

    @property
    def again(self) -> Callable[[], DevicePlanes]:
        """Draw the planes once more, with more room."""
        ...

    def changed(self, change: Callable[[Any], Mapping[str, Any]]) -> DevicePlanes:
        """Return them with other planes, which they also have when they are drawn again."""
        ...


class _Plane:
    """An image plane of a frame (colour, opacity or depth): an array, or the one on the device."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, frame: Frame | None, owner: type) -> Any:
        if frame is None:  # the class is asked for the default
            return None
        plane = frame.__dict__[self.name]
        if plane is None and frame.on_device is not None:
            return frame.on_device.arrays[self.name]
        return plane

    def __set__(self, frame: Frame, plane: Any) -> None:
        frame.__dict__[self.name] = plane


@dataclass(frozen=True)
class Frame:
    """One camera frame. ``alpha`` and ``depth`` are None where a renderer cannot give them (remote,
    video). A frame that was drawn on a device downloads its planes when one is first read.
    """

    t_us: int  # shutter end
    camera: str  # its name
    rgb: U8 = cast(U8, _Plane())  # (H, W, 3) sRGB
    # (H, W) opacity of what the renderer shows, 0..1: low where it has holes; sky counts as opaque
    alpha: F32 | None = cast(F32 | None, _Plane())
    # (H, W) metres along the optical axis, through a lens from the camera's centre; 0 where no surface
    # is, or it is less than half opaque
    depth: F32 | None = cast(F32 | None, _Plane())
    events: tuple[str, ...] = ()  # what a guard saw: "nan", "black", "frozen", ...
    # about this frame, for the log, such as "pose_error_m"
    facts: Mapping[str, float | str] = field(default_factory=dict)
    # (H, W, 4) recorded frames, warped into the view, nearest first; the last channel: where they
    # hold
    references: tuple[U8, ...] = ()
    on_device: DevicePlanes | None = None  # of a frame that a device drew
    fixed: tuple[U8, Any] | None = None  # an image that a fixer made, and the same as a tensor

    @property
    def pending(self) -> DevicePlanes | None:
        """The planes of a device, if the frame's image is theirs."""
        return self.on_device if self.is_pending("rgb") else None

    def references_on_host(self) -> tuple[U8, ...]:
        """Return the references as arrays, also those that a device holds: there they are carried once
        more where the view lacked splats.
        """
        planes = self.on_device
        if self.references or planes is None or planes.references is None:
            return self.references
        while not planes.had_room(int(planes.pairs)):
            planes = planes.again()
        return tuple(planes.references.cpu().numpy())

    @property
    def device(self) -> Any:
        """The device that drew it, also if its image was changed on the host since."""
        return "cpu" if self.on_device is None else self.on_device.rgb.device

    def image(self) -> Any:
        """Return a copy of the image as a tensor of the device that made it."""
        import torch

        if self.pending is not None:
            return self.pending.rgb.clone()
        if self.fixed is not None and self.fixed[0] is self.rgb:  # nobody has changed it since
            return self.fixed[1].clone()
        return torch.tensor(self.rgb)

    def is_pending(self, plane: str) -> bool:
        """Return whether a plane is that of a device, downloaded or not."""
        return self.on_device is not None and self.__dict__[plane] is None

    @property
    def size(self) -> tuple[int, int]:
        """Height and width; nothing is downloaded."""
        height, width = self.pending.size if self.pending else self.rgb.shape[:2]
        return height, width

    def changed(self, **values: Any) -> Self:
        """Return a copy with other values; planes of a device stay there."""
        copy = object.__new__(type(self))
        copy.__dict__.update(self.__dict__ | values)
        return copy


@dataclass(frozen=True)
class Photograph:
    """An image of the recorded drive in a file, undistorted, and where it was taken, as the
    reconstruction believes.
    """

    t_us: int
    camera: str
    width: int
    height: int
    K: F64  # (3, 3) pixels
    T_world_camera: F64  # (4, 4)
    path: str  # of the image
    # by the reconstruction; never-fitted: all of a further camera
    use: Literal["fitted", "held-out", "never-fitted"] = "fitted"
    # gain of each channel, by which the reconstruction explains this image
    exposure: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class RecordedFrame:
    """A frame of the recorded drive that a renderer declares, for a fixer to look at."""

    t_us: int
    camera: str
    K: F64  # (3, 3) pixels, of the image
    T_world_camera: F64  # (4, 4), as the reconstruction believes
    actors: Mapping[str, F64]  # actor id -> T_world_box (4, 4) of those present
    # (H, W, 3) sRGB; (H, W) metres, as the renderer sees it from there, 0 where it shows nothing or
    # sky; along the optical axis, through a lens from the camera's centre
    read: Callable[[], tuple[U8, F32]]
    lens: LensModel | None = None  # None: the pinhole K


# --- policy


def read_only(record: RecordT) -> RecordT:
    """Return a record whose arrays are views that cannot be written, for code that is not ours."""
    views = {
        name: array.view() for name, array in vars(record).items() if isinstance(array, np.ndarray)
    }
    for view in views.values():
        view.flags.writeable = False
    copy = object.__new__(type(record))
    vars(copy).update(vars(record) | views)
    return copy


def shielded(value: Any) -> Any:
    """Return data for code that is not ours: all arrays in it are views that cannot be written, and
    records and mappings are copies, so that nothing that is done to them reaches ours.
    """
    if isinstance(value, np.ndarray):
        view = value.view()
        view.flags.writeable = False
        return view
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*map(shielded, value))
    if isinstance(value, tuple | list):
        return type(value)(map(shielded, value))
    if isinstance(value, dict):
        return {key: shielded(item) for key, item in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        copy = object.__new__(type(value))
        vars(copy).update({name: shielded(item) for name, item in vars(value).items()})
        return copy
    return value


@dataclass(frozen=True)
class Observation:
    """What a policy may know at ``t_us``: frames, its own motion so far, and the route ahead."""

    t_us: int  # now
    frames: Mapping[str, Frame]  # newest frame per camera it asked for
    cameras: Mapping[str, CameraSpec]  # calibration of each camera, by name
    ego: EgoState  # at t_us
    history: Trajectory  # rig poses in the world up to t_us
    # (20, 3) metres, rig frame now, from `Scenario.route_offset_m` on; rows of NaN behind its end
    route_rig: F64
    images: Mapping[str, Any] = field(
        default_factory=dict
    )  # images that lie on a device; `image` gives any
    # where the other road users are, ``T_world_box`` ``(4, 4)`` by id; None unless the policy declares
    # `alpasim_plugin.core.interfaces.Policy.sees_road_users`
    road_users: Mapping[str, F64] | None = None

    def image(self, camera: str) -> Any:
        """Return a camera's image as a tensor ``(H, W, 3)`` uint8 that the policy may change: of
        the device that made it where the policy's `SensorSpec` says ``device``, else of the CPU.
        """
        if camera in self.images:
            return self.images[camera]
        import torch

        return torch.tensor(self.frames[camera].rgb)

    def with_frames(self, frames: Mapping[str, Frame]) -> Observation:
        """Return the observation with other frames, in `image` as well: what a device holds of the
        former frames is dropped.
        """
        return replace(self, frames=frames, images={})


@dataclass(frozen=True)
class Plan:
    """Future rig poses in the rig frame at ``t_us``; the first row is the pose at ``t_us``
    itself.
    """

    t_us: int  # when it was made
    times_us: I64  # (T,) absolute, strictly increasing, times_us[0] == t_us
    xy: F64  # (T, 2) metres
    yaw: F64  # (T,) radians
    samples: tuple[F64, ...] = ()  # alternatives, each (T, 3): x, y, yaw at times_us
    # diagnostics of the policy, such as scores or detections; stored in debug.jsonl
    debug: Mapping[str, Any] = field(default_factory=dict)


# --- scene


@dataclass(frozen=True)
class Rates:
    """Integer periods; camera and policy periods are multiples of the control period."""

    control_us: int = 100_000
    camera_us: int = 100_000
    policy_us: int = 100_000


@dataclass(frozen=True)
class Environment:
    """What is built around the road when a scene is dressed in Gaussians, and its weather."""

    buildings: float = 0.7  # share of free roadside frontage covered by facades, 0..1
    building_height_m: tuple[float, float] = (6.0, 18.0)
    trees_per_100m: float = 4.0  # per road side
    poles_spacing_m: float = 30.0  # 0: none
    sky: Literal["clear", "overcast", "dusk"] = "clear"
    texture: float = 1.0  # contrast of ground and facade texture, 0..1
    # distance at which 2 % of a contrast is left; None: clear
    fog_visibility_m: float | None = None
    time: Literal["day", "low_sun", "night"] = "day"
    rain: float = 0.0  # mm/h
    snow: float = 0.0  # mm/h of water

    @property
    def in_clear_day(self) -> Environment:
        """Return the same surroundings without weather: what is built and reconstructed."""
        return replace(self, fog_visibility_m=None, time="day", rain=0.0, snow=0.0)


@dataclass(frozen=True)
class Degradation:
    """How the renderer ``3dgs`` differs from the scene as built.

    ``reconstruction``: an under-trained model fitted to the frames of the logged drive. ``cycle``:
        a model fitted to frames seen at a lateral offset, rendered on the path (OneFixer,
        App. A). ``none``: the scene as built.
    """

    kind: Literal["reconstruction", "cycle", "none"] = "reconstruction"
    share: float = 0.15  # of the fit's schedule, 0..1; reconstruction and cycle
    # sideways, left positive, of the views that the cycle's model is fitted to
    shift_m: float = 1.0
    # of the log, that the model is fitted to; reconstruction and cycle, as are the next two
    views_per_s: float = 6.0
    depth_error: float = 0.1  # spread of the distance of the points it starts from, as a share
    pose_error_m: float = 0.0  # spread of the poses that the views are believed to have


@dataclass(frozen=True)
class Latency:
    """Delay from observation to the plan taking effect: none, a fixed time, or the measured one, of
    the fixer too if ``fixer``.
    """

    kind: Literal["none", "fixed", "measured"] = "none"
    fixed_us: int = 0
    fixer: bool = False


@dataclass(frozen=True)
class BackgroundFile:
    """A Gaussian file used as background, placed by ``T_world_file``."""

    path: str
    T_world_file: F64  # (4, 4), may scale
    keep_road: bool = False  # whether the built road is drawn with it


# What stands there: all of it among the actors, or found in a reconstruction.
Standing = Literal["known", "found"]

# What the end of a scene's path is: a place to arrive at, the end of the road that is known, or the
# end of the recorded images and map, behind which nothing is known.
PathEndKind = Literal["goal", "road", "record"]

# ids of actors found in a reconstruction begin so: it shows them, nobody draws them once more
STANDING_ID = "obstacle-"


@dataclass(frozen=True)
class MeasuredRange:
    """How far from the recorded path a reconstruction was compared with photographs that its fit did
    not see.
    """

    lateral_m: float  # of the camera farthest from the path of the fitted photographs
    turn_deg: float  # of its axis, in plan view, from that of the camera to drive by
    n_photographs: int  # that were compared; 0: nothing was


@dataclass(frozen=True)
class PlanRange:
    """How far beside the recorded path of a built scene the plans that a policy makes behind a renderer
    are near those that it makes behind `clean`.
    """

    renderer: str  # its name, as a run has it
    policy: str  # its name, as a run has it
    near_to_m: float | None  # to either side; None: not even on the path
    is_current: bool = True  # whether it was looked for on the scene as it is now
    renderer_digest: str | None = None  # of the renderer with which it was looked for
    policy_digest: str | None = None  # of the policy with which it was looked for


@dataclass(frozen=True)
class Scene:
    """What evaluators may see of a scenario: the map and the human drive, never pixels."""

    scene_id: str  # its name
    lane_map: LaneMap  # lanes, edges and signals
    ego_log: Trajectory  # recorded rig poses (rear axle on the ground), world
    vehicle: Vehicle  # the ego's size and axles
    # the same road as AlpaSim's own loader reads it, where that differs
    alpasim_map: LaneMap | None = None
    standing: Standing = "known"  # all that stands there is among the actors, or it was found
    # (N, 3) metres, world: the lane behind the recorded drive, as far as a rollout may go
    path_beyond: F64 = field(default_factory=lambda: np.zeros((0, 3)))
    path_end: PathEndKind = "record"  # what the end of the path is
    measured: MeasuredRange | None = None  # of a reconstructed drive; None: the scene is built
    plan_ranges: tuple[PlanRange, ...] = ()  # of a built scene, where they were looked for


@dataclass(frozen=True)
class Scenario:
    """A complete test case, the same type for every source."""

    scene_id: str  # its name
    source: str  # yaml | argoverse | commonroad | drive | osi | usdz
    seed: int  # scene seed: geometry, textures, scripted actors
    lane_map: LaneMap  # lanes, edges and signals
    ground: HeightField  # height of the ground
    ego_log: Trajectory  # rig poses, world
    vehicle: Vehicle  # the ego's size and axles
    route: Route  # that the policy is given
    actors: tuple[Actor, ...]  # other road users
    cameras: tuple[CameraSpec, ...]  # however they are listed: ahead first, wide first, by name
    rates: Rates  # periods of cameras, policy and control
    start_us: int  # first frame; the log before it is context
    end_us: int  # last instant of a rollout
    warmup_us: int  # the log is forced until start_us + warmup_us
    latency: Latency  # from an observation to its plan taking effect
    environment: Environment  # what stands around the road, and the weather
    degradation: Degradation  # how `3dgs` differs from the scene as built
    background: BackgroundFile | None = None  # trained Gaussians that are shown; None: built
    # what was subtracted from the source's coordinates, metres
    world_origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    content_hash: str = ""  # digest of all that a rollout can depend on
    notes: tuple[str, ...] = ()  # what the loader left out or assumed; goes to run.json
    # the same road as AlpaSim's own loader reads it, where that differs
    alpasim_map: LaneMap | None = None
    source_part: str | None = None  # the source that read the log, as named; None: a built road
    # key of the scenario file -> (as written, as drawn by the seed)
    varied: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)
    recording: tuple[Photograph, ...] = ()  # the drive's photographs, of an imported drive
    # folder of the reconstruction fitted to them, which 3dgs shows; then nothing was built and
    # `clean` is refused
    model: str | None = None
    standing: Standing = "known"  # all that stands there is among the actors, or it was found
    # (N, 3) metres, world: the lane behind the recorded drive, as far as the fastest admissible drive
    # comes; empty where nothing is known there
    path_beyond: F64 = field(default_factory=lambda: np.zeros((0, 3)))
    path_end: PathEndKind = "record"  # what the end of the path is
    stop_at_path_end: bool = True  # see `alpasim_plugin.core.path_end`
    # how far ahead of the ego the points of `Observation.route_rig` begin
    route_offset_m: float = 0.0
    measured: MeasuredRange | None = None  # of a reconstructed drive; None: the scene is built
    plan_ranges: tuple[PlanRange, ...] = ()  # of a built scene, where they were looked for
    # what the loader read beside the scenario file: path -> digest of the content
    files: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", tuple(sorted(self.cameras, key=_camera_order)))

    def period_us(self, sensor: SensorSpec) -> int:
        """Return the time between the frames of a camera that a policy asks for."""
        interval_by_camera = {camera.name: camera.interval_us for camera in self.cameras}
        return (
            sensor.interval_us or interval_by_camera.get(sensor.camera, 0) or self.rates.camera_us
        )

    @property
    def recorded_until_us(self) -> int:
        """Give the last instant for which the recorded drive says where the ego was: a scene with a
        goal goes on, for those who are slower.
        """
        return min(self.end_us, int(self.ego_log.t_us[-1]))

    @property
    def shown_files(self) -> list[str]:
        """Give the paths of what renderers and fixers read: Gaussians of the background and of
        actors, the files of a model, photographs.
        """
        paths = [] if self.background is None else [self.background.path]
        paths += [actor.appearance for actor in self.actors if actor.appearance is not None]
        if self.model is not None:
            inside = (
                Path(folder, name) for folder, _, names in os.walk(self.model) for name in names
            )
            paths += sorted(str(path) for path in inside)
        return paths + [photograph.path for photograph in self.recording]

    @property
    def scene(self) -> Scene:
        """Give the part that evaluators may see."""
        return Scene(
            self.scene_id,
            self.lane_map,
            self.ego_log,
            self.vehicle,
            self.alpasim_map,
            self.standing,
            self.path_beyond,
            self.path_end,
            self.measured,
            self.plan_ranges,
        )


def _camera_order(camera: CameraSpec) -> tuple[float, float, str]:
    ahead = round(float(camera.T_rig_camera[0, 2]), 3)  # cosine between the optical axis and rig x
    return -ahead, float(camera.K[0, 0]) / camera.width, camera.name


# --- log and scores


@dataclass(frozen=True)
class LoggedPlan:
    """A plan as it stands in a log: absolute poses."""

    now_us: int
    query_us: int
    trajectory: Trajectory  # rig poses, world, the first at now_us
    samples: tuple[Trajectory, ...] = ()
    # (N, 2) metres, rig frame: the route that the driver received; NaN where a point is missing
    route: F64 = field(default_factory=lambda: np.zeros((0, 2)))


@dataclass(frozen=True)
class LoggedImage:
    """An encoded camera image in a log."""

    camera: str
    start_us: int
    end_us: int
    data: bytes


@dataclass(frozen=True)
class RolloutLog:
    """One rollout as evaluators see it, whoever wrote the log."""

    scene_id: str  # of the scenario
    session_uuid: str  # of the rollout
    ego_box: Box  # size of the ego
    T_rig_box: F64  # (4, 4) pose of the box centre in the rig frame
    ego: Trajectory  # box centre, world
    actors: Mapping[str, Actor]  # ego excluded; track = logged poses of the box centre
    plans: tuple[LoggedPlan, ...]  # in the order of their queries
    images: tuple[LoggedImage, ...]  # that the policy received
    ego_log: Trajectory  # recorded rig poses, world
    start_us: int  # first recorded rig pose
    render_start_us: int  # first frame
    force_gt_us: int  # until then the recorded poses are driven
    control_us: int  # period of the control steps
    seed: int = 0  # of the rollout
    info: Mapping[str, Any] = field(default_factory=dict)  # facts that the writer stored besides
    warnings: tuple[str, ...] = ()  # what the reader noticed
    # how far the ego had come along its recorded path by the first pose; None: as far as the recording
    along_m: float | None = None


@dataclass(frozen=True)
class MetricSeries:
    """Values of one metric over a rollout; a value is never bare: it has validity and, where
    invalid, a reason.
    """

    metric: MetricInfo  # what it is
    t_us: I64  # (T,)
    value: F64  # (T,); NaN where invalid
    valid: Bool  # (T,)
    reason: str = ""  # why values are invalid, if any is

    @property
    def name(self) -> str:
        """Give the metric's name."""
        return self.metric.name
