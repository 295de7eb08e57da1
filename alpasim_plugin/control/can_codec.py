"""Between quantities and CAN frames: encoding with counters and checksums, decoding with every
check that the database allows.

Which message and signal of a database carries which quantity stands in a map, one YAML file beside
a DBC.

A checksum is CRC-8 SAE J1850 over identifier and data. Nothing of a frame is trusted before all
checks have passed.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import can
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from alpasim_plugin.core.config import load_yaml, validate
from alpasim_plugin.core.errors import InputError

POLYNOMIAL = 0x1D  # CRC-8 SAE J1850
START = 0xFF
FD_BYTES = (*range(9), 12, 16, 20, 24, 32, 48, 64)  # that a frame of CAN FD carries
FrameId = tuple[int, bool]  # identifier, and whether it is an extended one of 29 bits
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

    @property
    def parts(self) -> tuple[Sent | Received, ...]:
        """Return every message that the map sends or reads."""
        return (*self.send, self.steer, self.accel)


def load_map(name: str, dbc: str | None = None) -> tuple[CanMap, Path]:
    """Read a map and return it with the path of its database.

    Args:
        name: The shipped map ``example`` or a YAML file.
        dbc: The database; by default the one that the map names, beside it.

    Raises:
        InputError: No such map or database, or a map with an unknown key.
    """
    shipped = FOLDER / f"{name}.yaml"
    path = shipped if os.path.isfile(shipped) else Path(name)
    if not os.path.isfile(path):
        known = ", ".join(sorted(p.stem for p in FOLDER.glob("*.yaml")))
        raise InputError(f"map={name}: no such map or file", f"known: {known}; or name a YAML file")
    found: CanMap = validate(CanMap, load_yaml(path))
    database = Path(dbc) if dbc is not None else path.parent / found.dbc
    if not os.path.isfile(database):
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

    @property
    def uses_fd(self) -> bool:
        """Return whether any message of the map needs a CAN FD frame."""
        return any(is_fd(self.message(part.message)) for part in self.map.parts)

    def address(self, name: str) -> FrameId:
        """Return what identifies the frames of a message."""
        message = self.message(name)
        return int(message.frame_id), bool(message.is_extended_frame)

    def frame(self, name: str, data: bytes) -> can.Message:
        """Return data as a frame of the kind that the database states."""
        message = self.message(name)
        return can.Message(
            arbitration_id=message.frame_id,
            is_extended_id=message.is_extended_frame,
            is_fd=is_fd(message),
            data=data,
        )

    def encode(self, sent: Sent, quantities: Mapping[str, float]) -> can.Message:
        """Return the frame of a message, with the next counter and its checksum."""
        values = {
            name: self._carried(sent.message, name, quantities[quantity])
            for name, quantity in sent.signals.items()
        }
        return self.pack(sent.message, values, sent.counter, sent.checksum)

    def encode_command(self, received: Received, value: float) -> can.Message:
        """Return the frame of a command, as a control unit sends it."""
        values = {
            received.signal: self._carried(
                received.message, received.signal, value * received.scale
            ),
            **received.enabled,
        }
        return self.pack(received.message, values, received.counter, received.checksum)

    def pack(
        self, name: str, values: Mapping[str, float], counter: str | None, checksum: str | None
    ) -> can.Message:
        """Return the frame of given signal values; signals that are not named are at their lowest
        raw value, 0 in most.
        """
        message = self.message(name)
        full = {signal.name: signal.offset for signal in message.signals}
        named = [one for one in (*values, counter, checksum) if one is not None]
        full |= {**multiplexed(message, named, {}), **values}
        if counter is not None:
            length = message.get_signal_by_name(counter).length
            full[counter] = self._counters[name] = (self._counters.get(name, -1) + 1) % (
                1 << length
            )
        data = bytearray(message.encode(full, strict=False))
        if checksum is not None:
            position = _byte_of(message, checksum)
            data[position] = checksum_of(message.frame_id, bytes(data), position)
        return self.frame(name, bytes(data))

    def decode(self, received: Received, data: bytes) -> tuple[float, int | None] | None:
        """Return a command's value and counter; None where the frame carries other signals of a
        multiplexed message.

        Raises:
            BadFrame: Wrong length, wrong checksum, a value that the database does not allow, or a
                command that is not enabled.
        """
        message = self.message(received.message)
        values = checked_values(message, data, received.checksum)
        if not {received.signal, *received.enabled} <= set(values):
            return None
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
        if signal.is_float:
            return float(held)
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
    for part in can_map.parts:
        _check(codec, database, part)
    return codec


def _check(codec: Codec, database: Path, part: Sent | Received) -> None:
    """Refuse a message that a map names and that cannot be sent or read as it says."""
    signals = list(part.signals) if isinstance(part, Sent) else [part.signal, *part.enabled]
    whole = [name for name in (part.counter, part.checksum) if name is not None]
    where = f"{database}, message {part.message}"
    try:
        message = codec.message(part.message)
        found = {name: message.get_signal_by_name(name) for name in (*signals, *whole)}
    except KeyError as error:
        raise InputError(
            f"{where}: no {error}", "name a database of the vehicle that the map is for"
        ) from error
    if is_fd(message) and message.length not in FD_BYTES:
        raise InputError(
            f"{where}: {message.length} bytes, which no CAN frame carries",
            f"use a message of up to 8 bytes, or of {', '.join(map(str, FD_BYTES[1:]))} in CAN FD",
        )
    odd = next((name for name, one in found.items() if not one.scale), None)
    if isinstance(part, Received) and not part.scale:
        odd = part.signal
    if part.counter is not None and odd is None:
        one = found[part.counter]
        if one.is_float or one.is_signed or (one.scale, one.offset) != (1, 0):
            odd = part.counter
    if part.checksum is not None and odd is None:
        one = found[part.checksum]
        first = one.start % 8 == (7 if one.byte_order == "big_endian" else 0)
        odd = None if one.length == 8 and first else part.checksum
    if odd is not None:
        raise InputError(
            f"{where}, signal {odd}: it cannot carry what the map wants of it",
            "use a signal with a scale; unsigned counters of scale 1 and offset 0, checksums of one whole byte",
        )
    fixed = part.enabled if isinstance(part, Received) else {}
    multiplexed(message, [*signals, *whole], fixed, where)
    try:  # what else a database can have wrong shows as the message is made and read once
        trial = Codec(codec.map, codec.database).pack(
            part.message,
            {name: found[name].offset for name in signals} | dict(fixed),
            part.counter,
            part.checksum,
        )
        checked_values(message, bytes(trial.data), part.checksum)
    except Exception as error:  # the encoder raises errors of many kinds
        raise InputError(
            f"{where}: {type(error).__name__}: {error}", "correct the message in the database"
        ) from error


def multiplexed(
    message: Any, names: Sequence[str], fixed: Mapping[str, int], where: str = ""
) -> dict[str, int]:
    """Return the values of multiplexers under which a message carries signals.

    Args:
        message: Of a database.
        names: The signals.
        fixed: Values that multiplexers must have.
        where: The message's place, for the error.

    Raises:
        InputError: No frame carries all of them.
    """
    allowed: dict[str, set[int]] = {name: {value} for name, value in fixed.items()}
    for name in names:
        signal = message.get_signal_by_name(name)
        while signal.multiplexer_signal is not None:
            ids = set(signal.multiplexer_ids)
            over = allowed[signal.multiplexer_signal] = (
                allowed.get(signal.multiplexer_signal, ids) & ids
            )
            if not over:
                raise InputError(
                    f"{where}: no frame carries {', '.join(names)} together: they are of different values of {signal.multiplexer_signal}",
                    "name signals of one multiplexer value; send the message once for each",
                )
            signal = message.get_signal_by_name(signal.multiplexer_signal)
    return {name: min(ids) for name, ids in allowed.items() if name not in fixed}


def is_fd(message: Any) -> bool:
    """Return whether a message of a database needs a CAN FD frame."""
    return bool(message.is_fd) or int(message.length) > 8


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
    if signal.is_float:
        most = float(np.finfo(f"f{int(signal.length) // 8}").max)
        stated = signal.minimum, signal.maximum
        if None in stated or stated[0] == stated[1]:  # DBC writes [0|0] where it states none
            return -most, most
        return float(stated[0]), float(stated[1])
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
