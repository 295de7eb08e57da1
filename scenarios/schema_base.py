"""What every section of a scenario file shares."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from alpasim_plugin.io import limits as b


def within(bound: b.Bound) -> Any:
    """Return the pydantic constraint of a bound, for the type of a field."""
    return Field(ge=bound.low, le=bound.high)


BuildingHeight = Annotated[float, within(b.BUILDING_M)]
Side = Annotated[float, within(b.BODY_M)]  # of a body
Speed = Annotated[float, within(b.SPEED_MPS)]
Moment = Annotated[float, within(b.MOMENT_S)]
Coordinate = Annotated[float, within(b.COORDINATE_M)]
Turn = Annotated[float, Field(ge=-1e4, le=1e4)]  # radians, not wrapped


class Part(BaseModel):
    """A section: frozen, and no key that the schema does not know."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
