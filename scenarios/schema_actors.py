"""The actors section of a scenario file."""

from __future__ import annotations

import itertools
from typing import Annotated, Literal

from pydantic import Field, model_validator

from alpasim_plugin.io import limits as b
from scenarios.schema_base import Coordinate, Moment, Part, Side, Speed, Turn, within

Label = Literal["car", "truck", "bus", "motorcycle", "cyclist", "pedestrian", "other"]
ActorId = Annotated[str, Field(max_length=100, pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]*$", description="Unique name.")]


class _Actor(Part):
    id: ActorId
    label: Label = Field(default="car", description="Class of road user.")
    size_m: tuple[Side, Side, Side] | None = Field(default=None, description="Length, width, height; none: as usual.")


class _InLane(_Actor):
    lane: int | str = Field(
        default=0, description="Forward lane (0 is next to the centre line), oncoming lane (-1 is next to it), or a lane id."
    )
    s_m: Annotated[float, within(b.STATION_M)] = Field(
        description="Centre, metres along the road from the ego's start (lane id: from that lane's beginning)."
    )
    offset_m: Annotated[float, within(b.OFFSET_M)] = Field(
        default=0.0, description="Metres left of the lane's middle, in its driving direction."
    )


class ParkedActor(_Actor):
    """A standing vehicle, or a row of them, beside the outer lane."""

    kind: Literal["parked"]
    s_m: Annotated[float, within(b.STATION_M)] = Field(description="Centre, metres along the road from the ego's start.")
    side: Literal["left", "right"] = Field(default="right", description="Side of the road.")
    clearance_m: Annotated[float, within(b.OFFSET_M)] = Field(
        default=0.3, description="From the outer lane's edge to the body; negative: it stands in the lane."
    )
    count: int = Field(default=1, ge=1, le=40, description="Vehicles in the row.")
    spacing_m: Annotated[float, within(b.SPACING_M)] = Field(default=7.0, description="Distance between their centres.")
    yaw_deg: float = Field(default=0.0, ge=-180, le=180, description="Turned to the left against the lane.")


class LoggedActor(_Actor):
    """A track given point by point."""

    kind: Literal["logged"]
    points: tuple[tuple[Moment, Coordinate, Coordinate, Turn], ...] = Field(
        min_length=1,
        max_length=int(b.POINTS.high),
        description="Rows of time in seconds after the log's start, x, y in metres (world), yaw in radians.",
    )

    @model_validator(mode="after")
    def _ordered(self) -> LoggedActor:
        times = [p[0] for p in self.points]
        if any(b - a < 1e-6 for a, b in itertools.pairwise(times)):
            raise ValueError("the times of points do not increase | order the rows by time, each time once")
        return self


class IdmActor(_InLane):
    """A driver who follows the lane, keeps the distance (also to the ego) and reacts in the closed loop."""

    kind: Literal["idm"]
    speed_mps: Annotated[float, within(b.SPEED_MPS)] = Field(description="Speed at the start.")
    desired_speed_mps: Annotated[float | None, within(b.CRUISE_MPS)] = Field(
        default=None, description="Desired speed; none: the speed at the start, at least 1."
    )
    headway_s: Annotated[float, within(b.HEADWAY_S)] = Field(default=1.5, description="Time gap.")
    min_gap_m: float = Field(default=2.0, gt=0, le=b.GAP_M.high, description="Gap at standstill.")
    accel_mps2: Annotated[float, within(b.ACCEL_MPS2)] = Field(default=1.5, description="Acceleration.")
    brake_mps2: Annotated[float, within(b.ACCEL_MPS2)] = Field(default=2.0, description="Comfortable deceleration.")


class DriveActor(_InLane):
    """A vehicle that drives a given speed over time and reacts to nobody."""

    kind: Literal["drive"]
    speeds: tuple[tuple[Annotated[float, Field(ge=0, le=b.MOMENT_S.high)], Speed], ...] = Field(
        min_length=1,
        max_length=int(b.POINTS.high),
        description="Rows of time in seconds after the log's start and speed in m/s; linear in between.",
    )

    @model_validator(mode="after")
    def _ordered(self) -> DriveActor:
        times = [p[0] for p in self.speeds]
        if any(b <= a for a, b in itertools.pairwise(times)):
            raise ValueError("the times of speeds do not increase | order the rows by time, each time once")
        return self


class OncomingActor(_Actor):
    """A vehicle that comes the other way at a constant speed."""

    kind: Literal["oncoming"]
    lane: Annotated[int, within(b.LANE_INDEX)] = Field(default=0, description="Oncoming lane; 0 is next to the centre line.")
    s_m: Annotated[float, within(b.STATION_M)] = Field(description="Centre at the start, metres along the ego's path from the ego's start.")
    speed_mps: Annotated[float, within(b.SPEED_MPS)] = Field(description="Speed.")
    offset_m: Annotated[float, within(b.OFFSET_M)] = Field(
        default=0.0, description="Metres left of the lane's middle, in its driving direction."
    )


class HardBrakeActor(_InLane):
    """A leader who brakes hard, and may drive on."""

    kind: Literal["hard_brake"]
    speed_mps: Annotated[float, within(b.CRUISE_MPS)] = Field(description="Speed before braking.")
    brake_at_us: Annotated[int, within(b.TIME_US)] = Field(description="Start of braking after the log's start.")
    decel_mps2: float = Field(default=6.0, ge=b.ACCEL_MPS2.low, le=10, description="Deceleration.")
    end_speed_mps: Annotated[float, within(b.SPEED_MPS)] = Field(default=0.0, description="Speed after braking.")
    resume_at_us: Annotated[int | None, within(b.TIME_US)] = Field(
        default=None, description="When it accelerates again to its first speed; none: never."
    )

    @model_validator(mode="after")
    def _ordered(self) -> HardBrakeActor:
        if self.end_speed_mps >= self.speed_mps:
            raise ValueError(f"end_speed_mps = {self.end_speed_mps} is not below speed_mps = {self.speed_mps} | lower it")
        if self.resume_at_us is not None and self.resume_at_us <= self.brake_at_us:
            raise ValueError("resume_at_us is not after brake_at_us | give a later time")
        return self


class CutInActor(_Actor):
    """A vehicle that changes into another lane with a quintic lateral motion."""

    kind: Literal["cut_in"]
    from_lane: Annotated[int, within(b.LANE_INDEX)] = Field(description="Forward lane at the start; 0 is next to the centre line.")
    to_lane: Annotated[int, within(b.LANE_INDEX)] = Field(description="Forward lane afterwards.")
    s_m: Annotated[float, within(b.STATION_M)] = Field(description="Centre at the start, metres along the road from the ego's start.")
    speed_mps: Annotated[float, within(b.CRUISE_MPS)] = Field(description="Speed.")
    at_us: Annotated[int, within(b.TIME_US)] = Field(description="Start of the lateral motion after the log's start.")
    change_us: int = Field(default=2_500_000, ge=b.PERIOD_US.low, le=b.TIME_US.high, description="Duration of the lateral motion.")
    end_speed_mps: Annotated[float | None, within(b.SPEED_MPS)] = Field(default=None, description="Speed afterwards; none: the same.")
    decel_mps2: Annotated[float, within(b.ACCEL_MPS2)] = Field(
        default=2.0, description="How fast the speed changes after the lateral motion has begun."
    )

    @model_validator(mode="after")
    def _two_lanes(self) -> CutInActor:
        if self.from_lane == self.to_lane:
            raise ValueError(f"from_lane and to_lane are both {self.to_lane} | give two different lanes")
        return self


class CrossingActor(_Actor):
    """A pedestrian (or cyclist) who crosses, timed against the ego."""

    kind: Literal["crossing_pedestrian"]
    label: Label = Field(default="pedestrian", description="Class of road user.")
    s_m: Annotated[float, within(b.STATION_M)] = Field(description="Place of crossing, metres along the road from the ego's start.")
    side: Literal["left", "right"] = Field(default="right", description="Side that the crossing starts from.")
    speed_mps: Annotated[float, within(b.CRUISE_MPS)] = Field(default=1.4, description="Walking speed.")
    before_ego_s: float = Field(
        default=1.0,
        ge=-b.TIME_US.high * 1e-6,
        le=b.TIME_US.high * 1e-6,
        description="How long before the ego would be there, undisturbed, the middle of the ego's lane is reached.",
    )
    margin_m: Annotated[float, within(b.GAP_M)] = Field(
        default=1.0, description="Distance behind the road edge at which the walk starts and ends."
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
    ParkedActor | LoggedActor | IdmActor | DriveActor | OncomingActor | HardBrakeActor | CutInActor | CrossingActor,
    Field(discriminator="kind"),
]
