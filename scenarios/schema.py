"""The scenario file: versioned, strict, with units in its key names. ``python -m scenarios.schema``
writes the JSON Schema.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Discriminator, Field, Tag, model_validator

from alpasim_plugin.core.files import limits as b
from alpasim_plugin.core.printing import say
from scenarios.schema_parts import (
    ActorSpec,
    BuildingHeight,
    LogSpec,
    MapRoute,
    MapSpec,
    Part,
    PlanRangeSpec,
    RoadSpec,
    field,
    number,
    within,
)

SCHEMA_FILE = Path(__file__).with_name("schema.json")
WIDEST_PINHOLE_DEG = 120  # a wider one is smeared towards its sides
DEFAULT_DURATION_US = 8_000_000  # of the drive on a built road

FAULTS = {  # of a policy, each as tests/runs/test_catches.py drives it
    "blind": "follows the route and looks at no road user",
    "never_brakes": "follows the route at the speed that it has at first",
    "brakes_late": "believes what stands ahead to be farther away than it is",
    "mirrored": "reads its images mirrored",
    "speed_unit": "takes its speed in km/h for m/s",
    "sensor_black": "has a camera that gives black images",
    "latency": "takes images of 0.8 s ago for new ones",
}
Fault = Literal[
    "blind",
    "never_brakes",
    "brakes_late",
    "mirrored",
    "speed_unit",
    "sensor_black",
    "latency",
]

DEGRADATION_KEYS = {
    "reconstruction": ("share", "views_per_s", "depth_error", "pose_error_m"),
    "cycle": ("share", "shift_m", "views_per_s", "depth_error", "pose_error_m"),
    "none": (),
}


class LaneChangeSpec(Part):
    """A lane change of the ego."""

    at_m: float = within(b.DISTANCE_M, "Start of the change, along the ego's path.")
    to_lane: int = within(b.LANE_INDEX, "Target lane.")
    length_m: float = within(b.SEGMENT_M, "Along the road.", 60.0)


class EgoSpec(Part):
    """The expert who drives the recorded drive."""

    lane: int = within(b.LANE_INDEX, "Forward lane at the start; 0: at the centre line.", 0)
    start_m: float = within(
        b.DISTANCE_M,
        "Rear axle from the road's beginning.",
        20.0,
    )
    speed_mps: float = within(b.SPEED_MPS, "Speed at the log's start.", 10.0)
    cruise_mps: float = within(b.CRUISE_MPS, "Desired speed on a free straight.", 10.0)
    max_lateral_accel_mps2: float = within(b.ACCEL_MPS2, "In bends.", 2.0)
    headway_s: float = within(b.HEADWAY_S, "Time gap to a leader.", 1.5)
    lane_changes: tuple[LaneChangeSpec, ...] = Field(
        default=(), max_length=int(b.ELEMENTS.high), description="Lane changes, in driving order."
    )


class EnvironmentSpec(Part):
    """Surroundings generated beside the road."""

    buildings: float = number(0, 1, "Share of the roadside covered by facades.", 0.7)
    building_height_m: tuple[BuildingHeight, BuildingHeight] = field(
        "Least and greatest.", (6.0, 18.0)
    )
    trees_per_100m: float = within(b.TREES_PER_100M, "Trees per road side.", 4.0)
    poles_spacing_m: float = number(0, b.POLES_M.high, "Between lamp posts; 0: none.", 30.0)
    sky: Literal["clear", "overcast", "dusk"] = field("Sky and light.", "clear")
    texture: float = number(0, 1, "Contrast of ground and facades.", 1.0)
    fog_visibility_m: float | None = number(
        10, 100_000, "Distance at which fog leaves 2 % of a contrast.", None
    )
    time: Literal["day", "low_sun", "night"] = field(
        "Light: of day, of a low sun ahead, or of lamps.", "day"
    )
    rain: float = number(0, 200, "Rain, mm/h; 0: dry.", 0.0)
    snow: float = number(0, 10, "Snowfall, mm/h of water; 0: none falls and none lies.", 0.0)
    friction: float | None = Field(
        default=None, gt=0, le=1.5, description="Coefficient of tyres on the road; none: no slip."
    )

    @model_validator(mode="after")
    def _ordered(self) -> EnvironmentSpec:
        if self.building_height_m[0] > self.building_height_m[1]:
            raise ValueError(
                f"building_height_m = {list(self.building_height_m)} | give the smaller height first"
            )
        if 0 < self.poles_spacing_m < b.POLES_M.low:
            raise ValueError(
                f"poles_spacing_m = {self.poles_spacing_m} | give at least {b.POLES_M.low:g} m, or 0 for none"
            )
        return self


class CameraModel(Part):
    """A camera on the rig."""

    name: str = Field(default="front", min_length=1, description="Name that policies request.")
    width: int = within(b.IMAGE_SIDE_PX, "Pixels.", 256)
    height: int = within(b.IMAGE_SIDE_PX, "Pixels.", 144)
    lens: Literal["pinhole", "opencv", "fisheye", "ftheta"] = field(
        "Equations: docs/cameras.md.", "pinhole"
    )
    hfov_deg: float = Field(
        default=75.0,
        gt=1,
        lt=221,
        description="Of pinhole and opencv at most 120.",
    )
    focal_px: tuple[float, float] | None = field("In x and y, in place of hfov_deg.", None)
    centre_px: tuple[float, float] | None = field(
        "Where the axis meets the image; none: the middle.", None
    )
    coefficients: tuple[float, ...] = Field(
        default=(),
        max_length=12,
        description="opencv: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4. fisheye: k1 to k4. ftheta: a0, a1, ...",
    )
    max_angle_deg: float | None = Field(
        default=None, gt=0, le=110, description="Black beyond this angle from the axis."
    )
    x_m: float = within(b.MOUNT_M, "Ahead of the rear axle.", 1.6)
    y_m: float = within(b.MOUNT_M, "To the left.", 0.0)
    z_m: float = Field(default=1.5, gt=0, le=b.MOUNT_M.high, description="Above the ground.")
    yaw_deg: float = number(-180, 180, "Turned to the left.", 0.0)
    pitch_down_deg: float = Field(default=4.0, gt=-90, lt=90, description="Tilted downwards.")
    shutter_us: int = within(
        b.SHUTTER_US,
        "From the first row's exposure to the last one's.",
        0,
    )
    interval_us: int = number(
        0,
        int(b.PERIOD_US.high),
        "Between frames, a multiple of rates.control_us; 0: rates.camera_us.",
        0,
    )

    @model_validator(mode="after")
    def _fitting(self) -> CameraModel:
        if self.lens == "pinhole" and (self.coefficients or self.max_angle_deg is not None):
            raise ValueError("coefficients or max_angle_deg of a pinhole | say which lens it has")
        if self.focal_px is not None and min(self.focal_px) <= 0:
            raise ValueError(f"focal_px = {list(self.focal_px)} | give positive focal lengths")
        wide_deg = self.hfov_deg
        if self.focal_px is not None:
            wide_deg = math.degrees(2 * math.atan(0.5 * self.width / self.focal_px[0]))
        if self.lens in ("pinhole", "opencv") and wide_deg > WIDEST_PINHOLE_DEG:
            raise ValueError(
                f"hfov_deg = {wide_deg:.0f} of a {self.lens}, at most {WIDEST_PINHOLE_DEG} | say lens: fisheye or ftheta, or narrow it"
            )
        return self


class CameraSet(Part):
    """Cameras of a shipped rig, or of a calibration, in place of a list."""

    rig: Literal["alpasim-4", "alpasim-4-and-front", "alpasim-6", "front", "surround-6"] | None = (
        field("Name of a shipped rig.", None)
    )
    from_: str | None = Field(
        default=None,
        alias="from",
        description="Calibration: Argoverse 2 log, AlpaSim .usdz or transforms.json, relative to this file.",
    )
    names: tuple[str, ...] = Field(
        default=(),
        max_length=int(b.CAMERAS.high),
        description="Which of its cameras; none: all.",
    )
    width: int | None = number(
        b.IMAGE_SIDE_PX.low, b.IMAGE_SIDE_PX.high, "Of every camera; its height follows.", None
    )
    shutter_us: int = within(b.SHUTTER_US, "Rolling shutter of every camera.", 0)

    @model_validator(mode="after")
    def _one(self) -> CameraSet:
        if (self.rig is None) == (self.from_ is None):
            raise ValueError("neither or both of rig and from | give one of them")
        return self


class Rigs(Part):
    """The shipped rigs."""

    rigs: dict[str, tuple[CameraModel, ...]]


class RatesSpec(Part):
    """Periods; those of cameras and policy are multiples of the control period."""

    control_us: int = within(b.PERIOD_US, "Control period.", 100_000)
    camera_us: int = within(b.PERIOD_US, "Camera period.", 100_000)
    policy_us: int = within(b.PERIOD_US, "Policy period.", 100_000)


class TimingSpec(Part):
    """Which part of the log is driven."""

    start_us: int = within(b.TIME_US, "First frame, after the log's first pose.", 500_000)
    duration_us: int | None = Field(
        default=None,
        gt=0,
        le=b.TIME_US.high,
        description="From the first frame; none: 8 s on a built road, to the end of a log, and on a map 1.5 times as long as the expert needs and a cycle of a light.",
    )
    warmup_us: int = within(b.TIME_US, "How long the log is forced from then.", 500_000)
    stop_at_path_end: bool = field(
        "End at a goal, or where the known road or the recorded images end.", True
    )
    timeline: Literal["scenario", "alpasim"] = field(
        "alpasim: start at the recording's first camera frame and force 1.7 s.", "scenario"
    )
    start_time_offset_us: int = within(
        b.TIME_US,
        "With timeline alpasim: skipped at the start.",
        0,
    )


class RouteSpec(Part):
    """The route that a policy receives, as 20 points 4.21 m apart."""

    start_offset_m: float = number(
        0, 80, "How far ahead of the ego its points begin; nearer ones are left out.", 0.0
    )


class LatencySpec(Part):
    """Delay from observation to the plan taking effect."""

    kind: Literal["none", "fixed", "measured"] = field(
        "No delay, a fixed one, or the measured one.", "none"
    )
    fixed_us: int = within(b.TIME_US, "Delay where kind is fixed.", 0)
    fixer: bool = field("With kind measured: the policy also waits for the fixer.", False)

    @model_validator(mode="after")
    def _fitting(self) -> LatencySpec:
        if self.fixer and self.kind != "measured":
            raise ValueError(
                f"fixer = true with kind: {self.kind}, to which it means nothing | say kind: measured, or remove fixer"
            )
        return self


class DegradationSpec(Part):
    """How the renderer 3dgs differs from the scene as built."""

    kind: Literal["reconstruction", "cycle", "none"] = field(
        "A model stopped early; one fitted to views to the left of the path; none.",
        "reconstruction",
    )
    share: float = Field(
        default=0.15,
        gt=0,
        le=1,
        description="Share of the fit's whole schedule.",
    )
    shift_m: float = number(-10, 10, "Cycle: how far to the left the views lie.", 1.0)
    views_per_s: float = Field(
        default=6.0,
        gt=0,
        le=30,
        description="Views per second of log that are fitted.",
    )
    depth_error: float = number(0, 0.5, "Spread of the first points' depth.", 0.1)
    pose_error_m: float = number(0, 1, "Spread of the poses of these views.", 0.0)

    @model_validator(mode="after")
    def _fitting(self) -> DegradationSpec:
        for name in sorted(self.model_fields_set - {"kind"}):
            kinds = [kind for kind, names in DEGRADATION_KEYS.items() if name in names]
            if self.kind not in kinds:
                setting = f"{name} = {getattr(self, name)} with kind: {self.kind}"
                raise ValueError(
                    f"{setting}, to which it means nothing | say kind: {' or '.join(kinds)}, or remove {name}"
                )
        return self


class BackgroundSpec(Part):
    """A Gaussian file as background."""

    file: str = Field(min_length=1, description="Path, relative to this file.")
    transform: tuple[tuple[float, float, float, float], ...] | None = Field(
        default=None,
        min_length=4,
        max_length=4,
        description="4 x 4 matrix from the file to the world; may scale.",
    )
    keep_road: bool = field("Draw the built road too.", False)


class VehicleSpec(Part):
    """The ego's body and chassis."""

    length_m: float = within(b.VEHICLE_M, "Body length.", 4.855)
    width_m: float = within(b.VEHICLE_M, "Body width.", 1.88)
    height_m: float = within(b.VEHICLE_M, "Body height.", 1.6)
    rear_axle_to_centre_m: float = within(b.AXLE_M, "From the rear axle to the body's middle.", 1.4)
    wheelbase_m: float = within(b.VEHICLE_M, "Between the axles.", 2.85)
    max_steer_rad: float = Field(
        default=0.6,
        ge=b.STEER_RAD.low,
        lt=b.STEER_RAD.high,
        description="Of the road wheels.",
    )
    max_steer_rate_radps: float = within(b.STEER_RATE_RADPS, "Largest steering rate.", 0.8)
    max_accel_mps2: float = within(b.ACCEL_MPS2, "Largest acceleration.", 3.5)
    max_brake_mps2: float = within(b.ACCEL_MPS2, "Largest deceleration.", 8.0)


class JitterSpec(Part):
    """Ranges within which scenes of other seeds than 0 differ; uniform, relative unless in a unit."""

    length: float = number(0, 0.5, "Of elements.", 0.05)
    curvature: float = number(0, 0.5, "Of curvatures.", 0.1)
    lane_width: float = number(0, 0.2, "Of lanes.", 0.02)
    speed: float = number(0, 0.5, "Of ego and actors.", 0.05)
    position_m: float = number(0, 20, "Of actors along the road.", 1.5)
    time_us: int = within(b.TIME_US, "Of scripted moments.", 150_000)


class RangeSpec(Part):
    """A number drawn uniformly."""

    low: float = field("Smallest value.")
    high: float = field("Largest value.")

    @model_validator(mode="after")
    def _ordered(self) -> RangeSpec:
        if self.low > self.high:
            raise ValueError(f"low = {self.low} is above high = {self.high} | swap them")
        return self


class ChoiceSpec(Part):
    """One of several values, drawn with equal chance."""

    choice: tuple[Any, ...] = Field(
        min_length=1, max_length=int(b.LISTED.high), description="Values to choose from."
    )


class ScenarioSpec(Part):
    """One scenario file."""

    version: Literal[1] = field("Version of this schema: 1.")
    scene_id: str | None = Field(
        default=None,
        max_length=100,
        pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]*(@@[-+.0-9e]+){0,2}$",
        description="None: the file's folder and name.",
    )
    description: str = field("One sentence.", "")
    tags: tuple[str, ...] = Field(
        default=(), max_length=int(b.LISTED.high), description="Keywords."
    )
    catches: tuple[Fault, ...] = Field(
        default=(),
        max_length=len(FAULTS),
        description="Faults of a policy that end in an event there (docs/scenarios.md).",
    )
    seed: int = number(
        0, int(b.SEED.high), "Scene seed; 0: as written, others jitter the numbers.", 0
    )
    road: RoadSpec | None = field("A road to build; give this, log or map.", None)
    log: LogSpec | None = field("A recorded drive to use.", None)
    map: MapSpec | None = field("A map to drive on.", None)
    ego: EgoSpec = field("The expert that drives a built road or a map.", EgoSpec())
    actors: tuple[ActorSpec, ...] = Field(
        default=(), max_length=int(b.ACTOR_ENTRIES.high), description="Other road users."
    )
    environment: EnvironmentSpec = field("Surroundings.", EnvironmentSpec())
    cameras: (
        Annotated[
            Annotated[
                tuple[CameraModel, ...],
                Field(min_length=1, max_length=int(b.CAMERAS.high)),
                Tag("(list)"),
            ]
            | Annotated[CameraSet, Tag("(set)")],
            Discriminator(lambda value: "(list)" if isinstance(value, list | tuple) else "(set)"),
        ]
        | None
    ) = field("None: the log's own, or one named front.", None)
    rates: RatesSpec = field("Periods of the loop.", RatesSpec())
    timing: TimingSpec = field("Start, length and warm-up.", TimingSpec())
    route: RouteSpec = field("The route that a policy receives.", RouteSpec())
    latency: LatencySpec = field("Delay of the policy.", LatencySpec())
    degradation: DegradationSpec = field("Degradation of the renderer 3dgs.", DegradationSpec())
    background: BackgroundSpec | None = field("A Gaussian file as background.", None)
    vehicle: VehicleSpec | None = field("The ego; none: the log's, or the default one.", None)
    plan_ranges: tuple[PlanRangeSpec, ...] = Field(
        default=(),
        max_length=int(b.LISTED.high),
        description="Of a built scene: up to where plans are near those behind clean (simrun bench real --range).",
    )
    jitter: JitterSpec = field("How other scene seeds than 0 differ.", JitterSpec())
    variations: dict[str, RangeSpec | ChoiceSpec] = field(
        "Dotted key to {low, high} or {choice: [...]}, drawn with the scene seed.", {}
    )

    @property
    def built_until_us(self) -> int:
        """Return the end of the drive on a built road, after the log's first pose."""
        duration_us = self.timing.duration_us
        return self.timing.start_us + (DEFAULT_DURATION_US if duration_us is None else duration_us)

    @model_validator(mode="after")
    def _one_source(self) -> ScenarioSpec:
        if sum(source is not None for source in (self.road, self.log, self.map)) != 1:
            raise ValueError(
                "give exactly one of 'road', 'log' and 'map' | add road: {segments: [...]}, log: {commonroad: FILE} or map: {opendrive: FILE}"
            )
        if self.map is not None:
            plain = EgoSpec()
            for name in ("lane", "start_m", "lane_changes"):
                if getattr(self.ego, name) != getattr(plain, name):
                    raise ValueError(f"ego.{name} with map | give map.route, and remove ego.{name}")
        pairs = [(entry.renderer, entry.policy) for entry in self.plan_ranges]
        if len(set(pairs)) < len(pairs):
            raise ValueError(
                "plan_ranges name a renderer with a policy twice | keep one entry of each pair"
            )
        if self.log is not None and self.log.drive is not None:
            if self.plan_ranges:
                raise ValueError(
                    "plan_ranges with log.drive, whose photographs say how far it was compared | remove plan_ranges"
                )
            built = {
                "degradation": self.degradation,
                "background": self.background,
                "environment": self.environment.model_copy(
                    update={"fog_visibility_m": None, "time": "day", "rain": 0.0}
                ),
            }
            fields = type(self).model_fields
            keys = [key for key, value in built.items() if value != fields[key].default]
            if keys:
                raise ValueError(
                    f"{keys[0]} with log.drive, whose look is its reconstruction's | remove {keys[0]}"
                )
        return self


def json_schema() -> str:
    """Return the JSON Schema as committed text."""
    schema = ScenarioSpec.model_json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "simrun scenario"
    return json.dumps(schema, indent=1, sort_keys=True) + "\n"


def models() -> dict[str, type[BaseModel]]:
    """Return every section's model by the key path under which it stands in a file, for the
    documentation.
    """
    from scenarios.schema_parts import ACTOR_KINDS, SEGMENT_KINDS

    out: dict[str, type[BaseModel]] = {
        "": ScenarioSpec,
        "road": RoadSpec,
        "log": LogSpec,
        "map": MapSpec,
        "map.route": MapRoute,
        "ego": EgoSpec,
    }
    out["ego.lane_changes[]"] = LaneChangeSpec
    out |= {f"road.segments[] kind: {kind}": model for kind, model in SEGMENT_KINDS.items()}
    out |= {f"actors[] kind: {kind}": model for kind, model in ACTOR_KINDS.items()}
    out |= {
        "environment": EnvironmentSpec,
        "cameras[]": CameraModel,
        "cameras (a set)": CameraSet,
        "rates": RatesSpec,
        "timing": TimingSpec,
        "route": RouteSpec,
        "latency": LatencySpec,
        "degradation": DegradationSpec,
        "background": BackgroundSpec,
        "vehicle": VehicleSpec,
        "jitter": JitterSpec,
        "variations.KEY (a range)": RangeSpec,
        "variations.KEY (a choice)": ChoiceSpec,
    }
    return out


if __name__ == "__main__":
    SCHEMA_FILE.write_text(json_schema(), encoding="utf-8")
    say(f"wrote {SCHEMA_FILE}")
