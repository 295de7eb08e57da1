"""Between quantities and CAN frames: encoding with counters and checksums, decoding with every
check that the database allows.

Which message and signal of a database carries which quantity stands in a map, one YAML file beside
a DBC.

A checksum is CRC-8 SAE J1850 over identifier and data. Nothing of a frame is trusted before all
checks have passed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from alpasim_plugin.core.config import load_yaml, validate
from alpasim_plugin.core.errors import InputError

POLYNOMIAL = 0x1D  # CRC-8 SAE J1850
START = 0xFF
FOLDER = Path(__file__).resolve().parents[2] / "configs" / "can"

Quantity = Literal[
    "speed_kph",
    "speed_mps",
    "accel_mps2",
    "lateral_accel_mps2",
    "yaw_rate_degps",
    "steering_wheel_deg",
    "steering_wheel_rate_degps",
    "wheel_fl_kph",
    "wheel_fr_kph",
    "wheel_rl_kph",
    "wheel_rr_kph",
    "path_offset_m",
    "path_heading_rad",
    "path_curvature_1pm",
    "path_curvature_rate_1pm2",
    "path_length_m",
]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Sent(_Part):
    """A message from the simulation."""

    message: str
    period_us: Annotated[int, Field(gt=0)]
    signals: dict[str, Quantity]
    counter: str | None = None
    checksum: str | None = None  # the signal of one byte that holds it


class Received(_Part):
    """A command to the simulation: steering wheel angle in degrees, left positive after ``scale``,
    or acceleration in m/s^2.
    """

    message: str
    signal: str
    scale: float = 1.0
    enabled: dict[str, int] = {}  # the command counts only while these signals have these values
    counter: str | None = None
    checksum: str | None = None  # the signal of one byte that holds it


class CanMap(_Part):
    """The messages that are sent, and the two commands that are received."""

    dbc: str
    steering_ratio: Annotated[float, Field(gt=0)]  # steering wheel angle over road-wheel angle
    send: tuple[Sent, ...]
    steer: Received
    accel: Received


def load_map(name: str, dbc: str | None = None) -> tuple[CanMap, Path]:
    """Read a map and return it with the path of its database.

    Args:
        name: The shipped map ``example`` or a YAML file.
        dbc: The database; by default the one that the map names, beside it.

    Raises:
        InputError: No such map or database, or a map with an unknown key.
    """
    shipped = FOLDER / f"{name}.yaml"
    path = shipped if shipped.is_file() else Path(name)
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in FOLDER.glob("*.yaml")))
        raise InputError(f"map={name}: no such map or file", f"known: {known}; or name a YAML file")
    found: CanMap = validate(CanMap, load_yaml(path))
    database = Path(dbc) if dbc is not None else path.parent / found.dbc
    if not database.is_file():
        raise InputError(
            f"database {database}: no such file",
            f"name it with dbc=FILE; the map {name!r} is for {found.dbc}",
        )
    return found, database


class BadFrame(Exception):
    """A frame that fails a check; the text says which."""


@dataclass
class Codec:
    """Encodes and decodes the messages of a map."""

    map: CanMap
    database: Any
    _counters: dict[str, int] = field(default_factory=dict)

    def message(self, name: str) -> Any:
        """Return a message of the database."""
        return self.database.get_message_by_name(name)

    def encode(self, sent: Sent, quantities: Mapping[str, float]) -> tuple[int, bytes]:
        """Return identifier and data of a message, with the next counter and its checksum."""
        values = {
            name: self._carried(sent.message, name, quantities[quantity])
            for name, quantity in sent.signals.items()
        }
        return self.pack(sent.message, values, sent.counter, sent.checksum)

    def encode_command(self, received: Received, value: float) -> tuple[int, bytes]:
        """Return identifier and data of a command, as a control unit sends it."""
        values = {
            received.signal: self._carried(
                received.message, received.signal, value * received.scale
            ),
            **received.enabled,
        }
        return self.pack(received.message, values, received.counter, received.checksum)

    def pack(
        self, name: str, values: Mapping[str, float], counter: str | None, checksum: str | None
    ) -> tuple[int, bytes]:
        """Return identifier and data of given signal values; signals that are not named are at
        their lowest raw value, 0 in most.
        """
        message = self.message(name)
        full = {signal.name: signal.offset for signal in message.signals} | dict(values)
        if counter is not None:
            length = message.get_signal_by_name(counter).length
            full[counter] = self._counters[name] = (self._counters.get(name, -1) + 1) % (
                1 << length
            )
        if checksum is not None:
            full[checksum] = 0
        data = bytearray(message.encode(full, strict=False))
        if checksum is not None:
            position = _byte_of(message, checksum)
            data[position] = checksum_of(message.frame_id, bytes(data), position)
        return message.frame_id, bytes(data)

    def decode(self, received: Received, data: bytes) -> tuple[float, int | None]:
        """Return a command's value and counter.

        Raises:
            BadFrame: Wrong length, wrong checksum, a value that the database does not allow, or a
                command that is not enabled.
        """
        message = self.message(received.message)
        values = checked_values(message, data, received.checksum)
        off = [
            f"{name} = {values[name]}"
            for name, wanted in received.enabled.items()
            if values[name] != wanted
        ]
        if off:
            raise BadFrame(f"not enabled: {', '.join(off)}")
        signal, value = message.get_signal_by_name(received.signal), float(values[received.signal])
        if not _inside(signal, value):
            low, high = _range(signal)
            raise BadFrame(f"{received.signal} = {value} outside [{low:g}, {high:g}]")
        return value / received.scale, None if received.counter is None else int(
            values[received.counter]
        )

    def _carried(self, message: str, name: str, wanted: float) -> float:
        """Return the value that a signal can hold nearest to the wanted one."""
        signal = self.message(message).get_signal_by_name(name)
        low, high = _range(signal)
        held = min(max(wanted, low), high)
        raw = round((held - signal.offset) / signal.scale)
        first, last = _raw_range(signal)
        return float(min(max(raw, first), last) * signal.scale + signal.offset)


def open_codec(can_map: CanMap, database: Path) -> Codec:
    """Load a database and check that the map fits it.

    Raises:
        InputError: cantools is missing, the file is not a database that it accepts, or the map
            names what the database lacks.
    """
    try:
        import cantools
    except ImportError as error:
        raise InputError(
            f"{database}: cantools is not installed",
            "install the extra [can], or pip install cantools",
        ) from error
    try:
        # Real databases have overlapping signals in messages that nobody uses here; the map's own
        # messages are checked below.
        loaded = cantools.database.load_file(database, strict=False)
    except Exception as error:  # the parser raises errors of many kinds
        raise InputError(
            f"{database}: {type(error).__name__}: {error}",
            "repair the database, or remove the message that it names",
        ) from error
    codec = Codec(can_map, loaded)
    for part in (*can_map.send, can_map.steer, can_map.accel):
        signals = list(part.signals) if isinstance(part, Sent) else [part.signal, *part.enabled]
        signals += [name for name in (part.counter, part.checksum) if name is not None]
        try:
            message = codec.message(part.message)
            for name in signals:
                message.get_signal_by_name(name)
        except KeyError as error:
            raise InputError(
                f"{database}: no {error} of message {part.message}",
                "name a database of the vehicle that the map is for",
            ) from error
    return codec


def checked_values(message: Any, data: bytes, checksum: str | None) -> dict[str, float]:
    """Return the signals of a frame.

    Raises:
        BadFrame: Wrong length or checksum, or bytes that do not decode.
    """
    if len(data) != message.length:
        raise BadFrame(f"{len(data)} bytes, not {message.length}")
    if checksum is not None:
        position = _byte_of(message, checksum)
        wanted = checksum_of(message.frame_id, data, position)
        if data[position] != wanted:
            raise BadFrame(f"checksum {data[position]:#04x}, not {wanted:#04x}")
    try:
        values: dict[str, float] = message.decode(data, decode_choices=False)
    except Exception as error:  # the decoder raises errors of many kinds
        raise BadFrame(f"{type(error).__name__}: {error}") from error
    return values


def checksum_of(frame_id: int, data: bytes, position: int) -> int:
    """Return the checksum of a frame whose byte ``position`` holds it."""
    crc = START
    for byte in frame_id.to_bytes(4, "little")[:2] + data[:position] + data[position + 1 :]:
        crc ^= byte
        for _ in range(8):
            crc = ((crc << 1) ^ POLYNOMIAL if crc & 0x80 else crc << 1) & 0xFF
    return crc ^ 0xFF


def _byte_of(message: Any, signal: str) -> int:
    return int(message.get_signal_by_name(signal).start) // 8


def _raw_range(signal: Any) -> tuple[int, int]:
    n = int(signal.length)
    return (-(1 << (n - 1)), (1 << (n - 1)) - 1) if signal.is_signed else (0, (1 << n) - 1)


def _range(signal: Any) -> tuple[float, float]:
    """Return the least and the greatest value of a signal.

    The range that a database states counts where the bits can carry it. Databases written by hand
    often hold one that they cannot, such as 0 to 65535 for a yaw rate of 10 bits from -125 deg/s;
    then the bits decide.
    """
    low, high = sorted(
        raw * float(signal.scale) + float(signal.offset) for raw in _raw_range(signal)
    )
    least = signal.minimum
    most = signal.maximum
    half = abs(float(signal.scale)) / 2
    if least is None or most is None or not (low - half <= least < most <= high + half):
        return low, high
    return max(low, float(least)), min(high, float(most))


def _inside(signal: Any, value: float) -> bool:
    (low, high), half = _range(signal), abs(float(signal.scale)) / 2
    return low - half <= value <= high + half  # false for NaN
