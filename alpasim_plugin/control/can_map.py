"""Which message and signal of a CAN database carries which quantity: one YAML file beside a DBC."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.config import load_yaml, validate

DOING = "reading a CAN map"
FOLDER = Path(__file__).resolve().parents[2] / "configs" / "can"

Quantity = Literal[
    "speed_kph", "speed_mps", "accel_mps2", "lateral_accel_mps2", "yaw_rate_degps", "steering_wheel_deg", "steering_wheel_rate_degps",
    "wheel_fl_kph", "wheel_fr_kph", "wheel_rl_kph", "wheel_rr_kph",
    "path_offset_m", "path_heading_rad", "path_curvature_1pm", "path_curvature_rate_1pm2", "path_length_m",
]  # fmt: skip
ChecksumKind = Literal["crc8_j1850", "sum_toyota", "sum_tesla"]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Checksum(_Part):
    """The signal that holds a message's checksum, and how it is computed; it fills one byte."""

    signal: str
    kind: ChecksumKind


class Content(_Part):
    """What a signal carries: a quantity, or what is left of it after another signal of the message took its rounded part."""

    quantity: Quantity
    scale: float = 1.0
    rest_of: str | None = None


class Sent(_Part):
    """A message from the simulation."""

    message: str
    period_us: Annotated[int, Field(gt=0)]
    signals: dict[str, Quantity | Content]
    counter: str | None = None
    checksum: Checksum | None = None

    def contents(self) -> dict[str, Content]:
        """Give every signal's content."""
        return {name: one if isinstance(one, Content) else Content(quantity=one) for name, one in self.signals.items()}


class Received(_Part):
    """A command to the simulation: steering wheel angle in degrees, left positive after ``scale``, or acceleration in m/s^2."""

    message: str
    signal: str
    scale: float = 1.0
    enabled: dict[str, int] = {}  # the command counts only while these signals have these values
    counter: str | None = None
    checksum: Checksum | None = None


class CanMap(_Part):
    """A whole map. Without ``steer`` and ``accel`` it can send and read recorded drives, but not drive."""

    dbc: str
    steering_ratio: Annotated[float, Field(gt=0)]  # steering wheel angle over road-wheel angle
    send: tuple[Sent, ...]
    steer: Received | None = None
    accel: Received | None = None


def load_map(name: str, dbc: str | None = None) -> tuple[CanMap, Path]:
    """Read a map and return it with the path of its database.

    Args:
        name: A shipped map (``example``, ``tesla``, ``toyota``) or a YAML file.
        dbc: The database; by default the one that the map names, beside it.

    Raises:
        InputError: No such map or database, or a map with an unknown key.
    """
    shipped = FOLDER / f"{name}.yaml"
    path = shipped if shipped.is_file() else Path(name)
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in FOLDER.glob("*.yaml")))
        raise InputError(DOING, f"map={name}", "no such map or file", f"known: {known}; or name a YAML file")
    found: CanMap = validate(CanMap, load_yaml(path, DOING), DOING)
    database = Path(dbc) if dbc is not None else path.parent / found.dbc
    if not database.is_file():
        raise InputError(DOING, f"database {database}", "no such file", f"name it with dbc=FILE; the map {name!r} is for {found.dbc}")
    return found, database
