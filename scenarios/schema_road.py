"""The road section of a scenario file, and the log section that takes its place."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from alpasim_plugin.io import limits as b
from scenarios.schema_base import Part, within

Turn = Literal["left", "straight", "right"]
CentrePaint = Literal["double_yellow", "solid_yellow", "dashed_yellow", "dashed_white", "solid_white", "none"]


class StraightSegment(Part):
    """A straight."""

    kind: Literal["straight"]
    length_m: Annotated[float, within(b.SEGMENT_M)] = Field(description="Length.")


class ArcSegment(Part):
    """A circular bend."""

    kind: Literal["arc"]
    length_m: Annotated[float, within(b.SEGMENT_M)] = Field(description="Length along the road's middle.")
    curvature_per_m: Annotated[float, within(b.CURVATURE_PER_M)] = Field(description="1 / radius; left is positive.")


class ClothoidSegment(Part):
    """A transition whose curvature is linear in length."""

    kind: Literal["clothoid"]
    length_m: Annotated[float, within(b.SEGMENT_M)] = Field(description="Length along the road's middle.")
    start_curvature_per_m: Annotated[float, within(b.CURVATURE_PER_M)] = Field(
        default=0.0, description="Curvature at the start; left is positive."
    )
    end_curvature_per_m: Annotated[float, within(b.CURVATURE_PER_M)] = Field(default=0.0, description="Curvature at the end.")


class MergeSegment(Part):
    """A straight on which the rightmost forward lane ends."""

    kind: Literal["merge"]
    length_m: Annotated[float, within(b.SEGMENT_M)] = Field(default=60.0, description="Length of the taper.")


class SplitSegment(Part):
    """A straight on which a new rightmost forward lane opens."""

    kind: Literal["split"]
    length_m: Annotated[float, within(b.SEGMENT_M)] = Field(default=40.0, description="Length of the taper.")


class IntersectionSegment(Part):
    """A junction; the road goes on by ``turn``."""

    kind: Literal["intersection"]
    turn: Turn = Field(default="straight", description="Where the road goes on.")
    arms: tuple[Turn, ...] = Field(default=("left", "straight", "right"), min_length=1, description="Arms seen from the entry.")
    cross_lanes: int = Field(default=1, ge=1, le=4, description="Lanes per direction on the arms beside the road.")
    arm_length_m: float = Field(default=40.0, ge=b.SEGMENT_M.low, le=1000, description="Length of those arms.")
    corner_radius_m: float = Field(default=8.0, ge=3, le=40, description="Size of the kerb's corners.")
    crosswalks: bool = Field(default=True, description="Crosswalks on every arm.")
    guide_lines: bool = Field(default=True, description="Dashed lines through the junction along the road.")


class NarrowGapSegment(Part):
    """A straight on which parked cars on both sides leave a narrow gap for the ego."""

    kind: Literal["narrow_gap"]
    length_m: Annotated[float, within(b.SEGMENT_M)] = Field(
        default=40.0, description="Length of the straight; the cars stand in its middle half."
    )
    gap_m: float = Field(default=3.0, gt=2.0, le=8, description="Free width between the rows of parked cars.")
    shift_m: float = Field(default=0.0, ge=-3, le=3, description="The gap's middle, metres left of the ego lane's middle.")
    cars_left: int = Field(default=2, ge=0, le=8, description="Parked cars on the left.")
    cars_right: int = Field(default=2, ge=0, le=8, description="Parked cars on the right.")


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
    StraightSegment | ArcSegment | ClothoidSegment | IntersectionSegment | MergeSegment | SplitSegment | NarrowGapSegment,
    Field(discriminator="kind"),
]


class RoadSpec(Part):
    """A road built from segments that follow one another along the ego's path. Driving is on the right."""

    lanes_forward: int = Field(default=1, ge=1, le=6, description="Lanes in the ego's direction at the start.")
    lanes_backward: int = Field(default=1, ge=0, le=6, description="Oncoming lanes; 0: one-way.")
    lane_width_m: float = Field(default=3.5, ge=2.2, le=6, description="Width of every lane.")
    median_m: float = Field(default=0.0, ge=0, le=30, description="Raised median between the directions; 0: markings only.")
    shoulder_m: float = Field(default=0.5, ge=0, le=6, description="Paved strip outside the outer lanes.")
    parking_m: float = Field(default=0.0, ge=0, le=6, description="Parking strip outside the outer lanes, instead of the shoulder.")
    speed_limit_mps: Annotated[float | None, within(b.LIMIT_MPS)] = Field(default=None, description="Speed limit of all lanes.")
    centre_paint: CentrePaint = Field(default="double_yellow", description="Line between the directions.")
    heading_deg: Annotated[float, within(b.ANGLE_DEG)] = Field(
        default=0.0, description="Direction of the road's beginning, from east to the left."
    )
    segments: tuple[SegmentSpec, ...] = Field(min_length=1, max_length=int(b.ELEMENTS.high), description="Segments in driving order.")


SHIPPED = ("argoverse", "commonroad", "cosmos", "usdz")


class LogSpec(Part):
    """A recorded drive. Exactly one of the sources is given; relative paths start at this file's folder."""

    argoverse: str | None = Field(default=None, min_length=1, description="Folder of one Argoverse 2 log.")
    commonroad: str | None = Field(default=None, min_length=1, description="CommonRoad XML file.")
    cosmos: str | None = Field(default=None, min_length=1, description="Folder of one Cosmos-Drive-Dreams clip.")
    usdz: str | None = Field(default=None, min_length=1, description="AlpaSim scene file.")
    source: str | None = Field(
        default=None, min_length=1, description="A source of an installed package, or package.module:Class; it reads path."
    )
    path: str | None = Field(default=None, min_length=1, description="File or folder that source reads.")
    ego: int | str | None = Field(default=None, description="CommonRoad: the recorded vehicle that becomes the ego; none: chosen.")
    actors: Literal["replay", "idm", "none"] = Field(default="replay", description="Replay the recorded traffic, let it react, or drop it.")

    @model_validator(mode="after")
    def _one(self) -> LogSpec:
        given = [key for key in (*SHIPPED, "source") if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError(f"{len(given)} sources ({', '.join(given) or 'none'}) | give one of {', '.join(SHIPPED)}, or source and path")
        if (self.source is None) != (self.path is None):
            raise ValueError("only one of source and path | give both, or one of the shipped sources")
        return self

    @property
    def recorded(self) -> tuple[str, str, str]:
        """Return the source, the path, and the key under which the path stands."""
        if self.source is not None:
            return self.source, str(self.path), "path"
        (kind,) = (kind for kind in SHIPPED if getattr(self, kind) is not None)
        return kind, str(getattr(self, kind)), kind
