"""The sections of a scenario file that say where things are: the road or the log in its place, and
the actors.
"""

from __future__ import annotations

import itertools
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, model_validator

from alpasim_plugin.core.files import limits as b

Angle = Annotated[float, Field(ge=-1e4, le=1e4)]  # radians, not wrapped
Turn = Literal["left", "straight", "right"]
CentrePaint = Literal[
    "double_yellow", "solid_yellow", "dashed_yellow", "dashed_white", "solid_white", "none"
]
SHIPPED = ("argoverse", "commonroad", "drive", "osi", "usdz")
Label = Literal["car", "truck", "bus", "motorcycle", "cyclist", "pedestrian", "other"]
ActorId = Annotated[
    str, Field(max_length=100, pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]*$", description="Unique name.")
]


def within(bound: b.Bound, description: str | None = None, default: Any = ...) -> Any:
    """Return the field of a number within a bound, which is required without a default; alone, the
    constraint for a type.
    """
    return Field(default, ge=bound.low, le=bound.high, description=description)


def number(low: float, high: float, description: str, default: Any = ...) -> Any:
    """Return the field of a number from ``low`` to ``high``; see `within`."""
    return Field(default, ge=low, le=high, description=description)


def field(description: str, default: Any = ...) -> Any:
    """Return the field of any other value, which is required without a default."""
    return Field(default, description=description)


BuildingHeight = Annotated[float, within(b.BUILDING_M)]
Side = Annotated[float, within(b.BODY_M)]  # of a body
Speed = Annotated[float, within(b.SPEED_MPS)]
Moment = Annotated[float, within(b.MOMENT_S)]
Coordinate = Annotated[float, within(b.COORDINATE_M)]


class Part(BaseModel):
    """A section: frozen, and no key that the schema does not know."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class StraightSegment(Part):
    """A straight."""

    kind: Literal["straight"]
    length_m: float = within(b.SEGMENT_M, "Length.")


class ArcSegment(Part):
    """A circular bend."""

    kind: Literal["arc"]
    length_m: float = within(b.SEGMENT_M, "Length along the road's middle.")
    curvature_per_m: float = within(b.CURVATURE_PER_M, "1 / radius; left is positive.")


class ClothoidSegment(Part):
    """A transition whose curvature is linear in length."""

    kind: Literal["clothoid"]
    length_m: float = within(b.SEGMENT_M, "Length along the road's middle.")
    start_curvature_per_m: float = within(
        b.CURVATURE_PER_M, "Curvature at the start; left is positive.", 0.0
    )
    end_curvature_per_m: float = within(b.CURVATURE_PER_M, "Curvature at the end.", 0.0)


class MergeSegment(Part):
    """A straight on which the rightmost forward lane ends."""

    kind: Literal["merge"]
    length_m: float = within(b.SEGMENT_M, "Length of the taper.", 60.0)


class SplitSegment(Part):
    """A straight on which a new rightmost forward lane opens."""

    kind: Literal["split"]
    length_m: float = within(b.SEGMENT_M, "Length of the taper.", 40.0)


class IntersectionSegment(Part):
    """A junction; the road goes on by ``turn``."""

    kind: Literal["intersection"]
    turn: Turn = field("Where the road goes on.", "straight")
    arms: tuple[Turn, ...] = Field(
        default=("left", "straight", "right"), min_length=1, description="Arms seen from the entry."
    )
    cross_lanes: int = number(1, 4, "Lanes per direction on the other arms.", 1)
    arm_length_m: float = number(b.SEGMENT_M.low, 1000, "Length of those arms.", 40.0)
    corner_radius_m: float = number(3, 40, "Size of the kerb's corners.", 8.0)
    crosswalks: bool = field("Crosswalks on every arm.", True)
    guide_lines: bool = field("Dashed lines through the junction.", True)


class NarrowGapSegment(Part):
    """A straight on which parked cars leave a narrow gap."""

    kind: Literal["narrow_gap"]
    length_m: float = within(b.SEGMENT_M, "Length; the cars stand in its middle half.", 40.0)
    gap_m: float = Field(
        default=3.0, gt=2.0, le=8, description="Free width between the parked cars."
    )
    shift_m: float = number(-3, 3, "The gap's middle, left of the ego lane's.", 0.0)
    cars_left: int = number(0, 8, "Parked on the left.", 2)
    cars_right: int = number(0, 8, "Parked on the right.", 2)


SEGMENT_KINDS: dict[str, type[Part]] = {
    "straight": StraightSegment,
    "arc": ArcSegment,
    "clothoid": ClothoidSegment,
    "intersection": IntersectionSegment,
    "merge": MergeSegment,
    "split": SplitSegment,
    "narrow_gap": NarrowGapSegment,
}

SegmentSpec = Annotated[
    StraightSegment
    | ArcSegment
    | ClothoidSegment
    | IntersectionSegment
    | MergeSegment
    | SplitSegment
    | NarrowGapSegment,
    Field(discriminator="kind"),
]


class RoadSpec(Part):
    """A road of segments along the ego's path. Driving is on the right."""

    lanes_forward: int = number(1, 6, "In the ego's direction at the start.", 1)
    lanes_backward: int = number(0, 6, "Oncoming lanes; 0: one-way.", 1)
    lane_width_m: float = number(2.2, 6, "Of every lane.", 3.5)
    median_m: float = number(0, 30, "Raised median; 0: markings only.", 0.0)
    shoulder_m: float = number(0, 6, "Paved strip outside the lanes.", 0.5)
    parking_m: float = number(0, 6, "Parking strip, instead of the shoulder.", 0.0)
    speed_limit_mps: float | None = within(b.LIMIT_MPS, "Of all lanes.", None)
    centre_paint: CentrePaint = field("Line between the directions.", "double_yellow")
    heading_deg: float = within(b.ANGLE_DEG, "Of the road's beginning, from east to the left.", 0.0)
    segments: tuple[SegmentSpec, ...] = Field(
        min_length=1, max_length=int(b.ELEMENTS.high), description="Segments in driving order."
    )


class LogSpec(Part):
    """A recorded drive, of one source; paths are relative to this file."""

    argoverse: str | None = Field(
        default=None, min_length=1, description="Folder of one Argoverse 2 log."
    )
    commonroad: str | None = Field(default=None, min_length=1, description="CommonRoad XML file.")
    drive: str | None = Field(
        default=None, min_length=1, description="Folder that simrun import has written."
    )
    osi: str | None = Field(default=None, min_length=1, description="OSI trace.")
    usdz: str | None = Field(default=None, min_length=1, description="AlpaSim scene file.")
    source: str | None = Field(
        default=None,
        min_length=1,
        description="A source of an installed package; it reads path.",
    )
    path: str | None = Field(
        default=None, min_length=1, description="File or folder that source reads."
    )
    ego: int | str | None = field("CommonRoad: the vehicle that becomes the ego.", None)
    actors: Literal["replay", "idm", "none"] = field(
        "Replay the recorded traffic, let it react, or drop it.", "replay"
    )

    @model_validator(mode="after")
    def _one(self) -> LogSpec:
        sources = [key for key in (*SHIPPED, "source") if getattr(self, key) is not None]
        if len(sources) != 1:
            raise ValueError(
                f"{len(sources)} sources ({', '.join(sources) or 'none'}) | give one of {', '.join(SHIPPED)}, or source and path"
            )
        if (self.source is None) != (self.path is None):
            raise ValueError(
                "only one of source and path | give both, or one of the shipped sources"
            )
        return self

    @property
    def recorded(self) -> tuple[str, str, str]:
        """Return the source, the path, and the key under which the path stands."""
        if self.source is not None:
            return self.source, str(self.path), "path"
        (kind,) = (kind for kind in SHIPPED if getattr(self, kind) is not None)
        return kind, str(getattr(self, kind)), kind


class PlanRangeSpec(Part):
    """How far beside the recorded path plans behind a renderer are near those behind clean."""

    renderer: str = Field(min_length=1, description="Renderer, as a run names it.")
    policy: str = Field(min_length=1, description="Policy, as a run names it.")
    near_to_m: float | None = Field(
        ge=0, le=10, description="To either side of the path; null: not even on the path."
    )
    scene: str = Field(
        pattern=r"^sha256-[0-9a-f]{16}$",
        description="Digest of the scene on which it was looked for.",
    )
    renderer_digest: str | None = Field(
        pattern=r"^sha256-[0-9a-f]{16}$",
        description="Digest of the renderer's code, settings and weights; null: of one elsewhere.",
    )
    policy_digest: str | None = Field(
        pattern=r"^sha256-[0-9a-f]{16}$",
        description="Digest of the policy's code, settings and weights; null: of one elsewhere.",
    )


Place = Annotated[str, Field(pattern=r"^.+:\d+(\.\d+)?$")]


class MapRoute(Part):
    """A way along the lanes of a map. An end that is not given is drawn by the scene seed."""

    from_: Place | None = Field(
        default=None,
        alias="from",
        description="Start of the rear axle, ROAD:S: metres along the road (of Lanelet2: the lanelet).",
    )
    via: tuple[Place, ...] = field("Places that the way passes in this order, ROAD:S.", ())
    to: Place | None = field("End, ROAD:S.", None)
    length_m: float | None = Field(
        default=None,
        ge=20,
        le=5000,
        description="Length of a route whose end is drawn, metres; by default 200 where the lanes are as long.",
    )

    @model_validator(mode="after")
    def _one_end(self) -> MapRoute:
        if self.to is not None and self.length_m is not None:
            raise ValueError("to and length_m | remove one: a length is of a route without an end")
        return self


class MapSpec(Part):
    """A map without a drive: an expert drives a route on it, and the street is built around."""

    opendrive: str | None = Field(
        default=None, min_length=1, description="OpenDRIVE file, relative to this file."
    )
    lanelet2: str | None = Field(
        default=None, min_length=1, description="Lanelet2 file; give it or opendrive."
    )
    route: Annotated[
        Annotated[Literal["random"], Tag("(drawn)")] | Annotated[MapRoute, Tag("(named)")],
        Discriminator(lambda value: "(drawn)" if isinstance(value, str) else "(named)"),
    ] = field("Where to drive; random: drawn by the scene seed.", "random")
    vehicles: int = number(0, 100, "Vehicles near the route, which react (IDM).", 6)
    pedestrians: int = number(0, 100, "Pedestrians on crosswalks of the route.", 2)
    cyclists: int = number(0, 100, "Cyclists near the route, who react as vehicles do.", 0)
    lane_changes: bool = field("Whether the vehicles change lanes (MOBIL).", False)

    @model_validator(mode="after")
    def _one(self) -> MapSpec:
        if (self.opendrive is None) == (self.lanelet2 is None):
            raise ValueError("neither or both of opendrive and lanelet2 | give one of them")
        return self

    @property
    def source(self) -> tuple[str, str]:
        """Return the key of the map's format, and the file."""
        if self.opendrive is not None:
            return "opendrive", self.opendrive
        return "lanelet2", str(self.lanelet2)


class _Actor(Part):
    id: ActorId
    label: Label = field("Class of road user.", "car")
    size_m: tuple[Side, Side, Side] | None = field("Length, width, height; none: as usual.", None)
    appearance: str | None = field(
        "Gaussian file in the frame of its box; none: built.",
        None,
    )


class _InLane(_Actor):
    lane: int | str = field(
        "Forward lane (0: at the centre line), oncoming lane (-1), or a lane id.", 0
    )
    s_m: float = within(
        b.STATION_M, "Centre, along the road from the ego's start (lane id: of that lane)."
    )
    offset_m: float = within(b.OFFSET_M, "Left of the lane's middle, in driving direction.", 0.0)


class _Adversary(_Actor):
    role: Literal["adversary"] | None = field(
        "adversary: up to the place where it acts it chooses its speed, half to one and a half times speed_mps, to be gap_m ahead of the ego.",
        None,
    )
    gap_m: float = within(b.GAP_M, "Of an adversary: from the ego's front to its rear.", 6.0)


class _Walker(_Actor):
    yields: bool = field("It waits where it would walk into the ego's way.", False)


class ParkedActor(_Actor):
    """A standing vehicle, or a row of them, beside the outer lane."""

    kind: Literal["parked"]
    s_m: float = within(b.STATION_M, "Centre, along the road from the ego's start.")
    side: Literal["left", "right"] = field("Side of the road.", "right")
    clearance_m: float = within(
        b.OFFSET_M, "From the outer lane's edge; negative: it stands in the lane.", 0.3
    )
    count: int = number(1, 40, "Vehicles in the row.", 1)
    spacing_m: float = within(b.SPACING_M, "Between their centres.", 7.0)
    yaw_deg: float = number(-180, 180, "Turned to the left against the lane.", 0.0)


class LoggedActor(_Walker):
    """A track given point by point."""

    kind: Literal["logged"]
    points: tuple[tuple[Moment, Coordinate, Coordinate, Angle], ...] = Field(
        min_length=1,
        max_length=int(b.POINTS.high),
        description="Rows of time in seconds, x, y (world), yaw in radians.",
    )

    @model_validator(mode="after")
    def _ordered(self) -> LoggedActor:
        times = [point[0] for point in self.points]
        if any(end - start < 1e-6 for start, end in itertools.pairwise(times)):
            raise ValueError(
                "the times of points do not increase | order the rows by time, each time once"
            )
        return self


class IdmActor(_InLane):
    """A driver who follows the lane and reacts, also to the ego."""

    kind: Literal["idm"]
    speed_mps: float = within(b.SPEED_MPS, "Speed at the start.")
    desired_speed_mps: float | None = within(
        b.CRUISE_MPS, "None: the speed at the start, at least 1.", None
    )
    headway_s: float = within(b.HEADWAY_S, "Time gap.", 1.5)
    min_gap_m: float = Field(default=2.0, gt=0, le=b.GAP_M.high, description="Gap at standstill.")
    accel_mps2: float = within(b.ACCEL_MPS2, "Acceleration.", 1.5)
    brake_mps2: float = within(b.ACCEL_MPS2, "Comfortable deceleration.", 2.0)


class DriveActor(_InLane):
    """A vehicle of given speeds that reacts to nobody."""

    kind: Literal["drive"]
    speeds: tuple[tuple[Annotated[float, Field(ge=0, le=b.MOMENT_S.high)], Speed], ...] = Field(
        min_length=1,
        max_length=int(b.POINTS.high),
        description="Rows of time in seconds and speed; linear in between.",
    )

    @model_validator(mode="after")
    def _ordered(self) -> DriveActor:
        times = [point[0] for point in self.speeds]
        if any(end <= start for start, end in itertools.pairwise(times)):
            raise ValueError(
                "the times of speeds do not increase | order the rows by time, each time once"
            )
        return self


class OncomingActor(_Actor):
    """A vehicle that comes the other way."""

    kind: Literal["oncoming"]
    lane: int = within(b.LANE_INDEX, "Oncoming lane; 0: at the centre line.", 0)
    s_m: float = within(b.STATION_M, "Centre at the start, along the ego's path.")
    speed_mps: float = within(b.SPEED_MPS, "Speed.")
    offset_m: float = within(b.OFFSET_M, "Left of the lane's middle, in driving direction.", 0.0)


class HardBrakeActor(_InLane, _Adversary):
    """A leader who brakes hard."""

    kind: Literal["hard_brake"]
    speed_mps: float = within(b.CRUISE_MPS, "Speed before braking.")
    brake_at_us: int = within(b.TIME_US, "Start of braking.")
    decel_mps2: float = number(b.ACCEL_MPS2.low, 10, "Deceleration.", 6.0)
    end_speed_mps: float = within(b.SPEED_MPS, "Speed after braking.", 0.0)

    @model_validator(mode="after")
    def _ordered(self) -> HardBrakeActor:
        if self.end_speed_mps >= self.speed_mps:
            raise ValueError(
                f"end_speed_mps = {self.end_speed_mps} is not below speed_mps = {self.speed_mps} | lower it"
            )
        return self


class CutInActor(_Adversary):
    """A vehicle that changes its lane."""

    kind: Literal["cut_in"]
    from_lane: int = within(b.LANE_INDEX, "Forward lane at the start; 0: at the centre line.")
    to_lane: int = within(b.LANE_INDEX, "Forward lane afterwards.")
    s_m: float = within(b.STATION_M, "Centre at the start.")
    speed_mps: float = within(b.CRUISE_MPS, "Speed.")
    at_us: int = within(b.TIME_US, "Start of the lateral motion.")
    change_us: int = number(b.PERIOD_US.low, b.TIME_US.high, "Its duration.", 2_500_000)
    end_speed_mps: float | None = within(b.SPEED_MPS, "Speed afterwards; none: the same.", None)
    decel_mps2: float = within(b.ACCEL_MPS2, "How fast the speed changes then.", 2.0)

    @model_validator(mode="after")
    def _two_lanes(self) -> CutInActor:
        if self.from_lane == self.to_lane:
            raise ValueError(
                f"from_lane and to_lane are both {self.to_lane} | give two different lanes"
            )
        return self


class CrossingActor(_Walker):
    """A pedestrian (or cyclist) who crosses, timed against the ego."""

    kind: Literal["crossing_pedestrian"]
    label: Label = field("Class of road user.", "pedestrian")
    s_m: float = within(b.STATION_M, "Place of crossing.")
    side: Literal["left", "right"] = field("Side that the crossing starts from.", "right")
    speed_mps: float = within(b.CRUISE_MPS, "Walking speed.", 1.4)
    before_ego_s: float = number(
        -b.TIME_US.high * 1e-6,
        b.TIME_US.high * 1e-6,
        "Reaches the middle of the ego's lane so long before the ego would, undisturbed.",
        1.0,
    )
    margin_m: float = within(
        b.GAP_M, "How far behind the road's edges the walk starts and ends.", 1.0
    )


ACTOR_KINDS: dict[str, type[Part]] = {
    "parked": ParkedActor,
    "logged": LoggedActor,
    "idm": IdmActor,
    "drive": DriveActor,
    "oncoming": OncomingActor,
    "hard_brake": HardBrakeActor,
    "cut_in": CutInActor,
    "crossing_pedestrian": CrossingActor,
}

ActorSpec = Annotated[
    ParkedActor
    | LoggedActor
    | IdmActor
    | DriveActor
    | OncomingActor
    | HardBrakeActor
    | CutInActor
    | CrossingActor,
    Field(discriminator="kind"),
]
