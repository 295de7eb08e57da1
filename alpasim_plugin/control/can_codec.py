"""Between quantities and CAN frames: encoding with counters, decoding with every check that the
database allows.

Which message and signal of a database carries which quantity stands in a map, one YAML file beside
a DBC. Nothing of a frame is trusted before all checks have passed.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import can
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import check_regular
from alpasim_plugin.core.files.config import load_yaml, validate
from alpasim_plugin.core.files.fields import Fields, met_in
from alpasim_plugin.core.lazy import require_library

# Attributes are those of the messages that a map names, and of their signals. Periods and causes of
# sending are the map's; a start value is sent, an inactive or a default one never.
DBC = Fields(
    "CAN database",
    read={
        "message": "BO_ @VFrameFormat",
        "signal": "SG_ VAL_ SIG_VALTYPE_ @GenSigStartValue",
    },
    harmless={
        "message": """CM_ @GenMsgCycleTime @GenMsgCycleTimeActive @GenMsgCycleTimeFast @GenMsgDelayTime
            @GenMsgFastOnStart @GenMsgILSupport @GenMsgNrOfRepetition @GenMsgNrOfRepetitions
            @GenMsgRepetitions @GenMsgSendType @GenMsgStartDelayTime @GenMsgStartDelay
            @GenMsgStartValue @DiagRequest @DiagResponse @DiagState @DiagUudtResponse
            @NmAsrMessage @NmMessage @TpTxIndex @TpApplType @SystemMessageLongSymbol""",
        "signal": """CM_ @GenSigSendType @GenSigCycleTime @GenSigCycleTimeActive @GenSigILSupport
            @GenSigMissingSourceValue @GenSigEVName @GenSigInactiveValue @GenSigTimeoutTime
            @GenSigTimeoutValue @GenSigTimeoutMsg @GenSigSNA @GenSigFuncType @SPN @SigType
            @SystemSignalLongSymbol @NWM-WakeupAllowed""",
    },
    moving={"message": "multiplexing"},
)
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
Fault = Literal["malformed", "not_enabled", "out_of_range"]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Sent(_Part):
    """A message from the simulation."""

    message: str
    period_us: Annotated[int, Field(gt=0)]
    signals: dict[str, Quantity]
    counter: str | None = None


class Received(_Part):
    """A command to the simulation: steering wheel angle in degrees, left positive after ``scale``,
    or acceleration in m/s^2.

    ``echo`` is a signal in which the control unit repeats the counter of the map's last sent
    message, as it was when the unit computed the command.
    """

    message: str
    signal: str
    scale: float = 1.0
    enabled: dict[str, int] = {}  # the command counts only while these signals have these values
    counter: str | None = None
    echo: str | None = None


class CanMap(_Part):
    """The messages that are sent, and the two commands that are received."""

    dbc: str
    steering_ratio: Annotated[float, Field(gt=0)]  # steering wheel angle over road-wheel angle
    send: tuple[Sent, ...]
    steer: Received
    accel: Received

    @property
    def parts(self) -> tuple[Sent | Received, ...]:
        """Give all messages of the map."""
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
        map_names = ", ".join(sorted(path.stem for path in FOLDER.glob("*.yaml")))
        raise InputError(
            f"map={name}: no such map or file", f"known: {map_names}; or name a YAML file"
        )
    can_map: CanMap = validate(CanMap, load_yaml(path))
    database = Path(dbc) if dbc is not None else path.parent / can_map.dbc
    if not os.path.isfile(database):
        raise InputError(
            f"database {database}: no such file",
            f"name it with dbc=FILE; the map {name!r} is for {can_map.dbc}",
        )
    return can_map, database


class BadFrame(Exception):
    """A frame that fails a check.

    Args:
        fault: Which kind of check.
    """

    def __init__(self, fault: Fault) -> None:
        super().__init__(fault)
        self.fault = fault


class Reading(NamedTuple):
    """A decoded command: its value, its counter, and the counter of what it answers."""

    value: float
    counter: int | None
    echo: int | None


@dataclass
class Codec:
    """Encodes and decodes the messages of a map."""

    map: CanMap
    database: Any
    notes: tuple[str, ...] = ()  # on attributes of the database that are not read
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

    def encode(self, sent: Sent, quantities: Mapping[str, float]) -> can.Message:
        """Return the frame of a message, with the next counter."""
        signals = {name: quantities[quantity] for name, quantity in sent.signals.items()}
        return self.pack(sent.message, signals, sent.counter)

    def encode_command(self, received: Received, value: float, echo: int = 0) -> can.Message:
        """Return the frame of a command, as a control unit sends it.

        Args:
            received: The command.
            value: In the unit of the map.
            echo: Counter of what it answers.
        """
        signals = {received.signal: value * received.scale, **received.enabled}
        if received.echo is not None:
            signals[received.echo] = echo
        return self.pack(received.message, signals, received.counter)

    def pack(self, name: str, values: Mapping[str, float], counter: str | None) -> can.Message:
        """Return the frame of given signal values, each the nearest that its signal can hold;
        signals that are not named have the start value of the database, else raw value 0.
        """
        message = self.message(name)
        full = {signal.name: _start_value(signal) for signal in message.signals}
        for signal_name, value in values.items():
            full[signal_name] = _carried(message.get_signal_by_name(signal_name), value)
        if counter is not None:
            size = self.counter_size(name, counter)
            full[counter] = self._counters[name] = (self._counters.get(name, -1) + 1) % size
        return can.Message(
            arbitration_id=message.frame_id,
            is_extended_id=message.is_extended_frame,
            is_fd=is_fd(message),
            data=message.encode(full, strict=False),
        )

    def counter_size(self, name: str, counter: str) -> int:
        """Return how many values a message's counter has."""
        return 1 << int(self.message(name).get_signal_by_name(counter).length)

    def questions_since(self, echo: int) -> int:
        """Return how often the map's last message was sent since the counter had a value, 0 for the
        newest; modulo the counter's size.
        """
        last = self.map.send[-1]
        assert last.counter is not None  # as `open_codec` has checked
        size = self.counter_size(last.message, last.counter)
        return (self._counters.get(last.message, -1) - echo) % size

    def decode(self, received: Received, data: bytes) -> Reading:
        """Return what a frame of a command says.

        Raises:
            BadFrame: Wrong length, a value that the database does not allow, or a command that is
                not enabled.
        """
        message = self.message(received.message)
        if len(data) != message.length:
            raise BadFrame("malformed")
        try:
            values: dict[str, float] = message.decode(data, decode_choices=False)
        except Exception as error:  # the decoder raises errors of many kinds
            raise BadFrame("malformed") from error
        if any(values[name] != wanted for name, wanted in received.enabled.items()):
            raise BadFrame("not_enabled")
        signal = message.get_signal_by_name(received.signal)
        value = float(values[received.signal])
        low, high = _range(signal)
        half = abs(float(signal.scale)) / 2
        if not low - half <= value <= high + half:  # NaN is outside
            raise BadFrame("out_of_range")
        counter = None if received.counter is None else int(values[received.counter])
        echo = None if received.echo is None else int(values[received.echo])
        return Reading(value / received.scale, counter, echo)


def open_codec(can_map: CanMap, database: Path) -> Codec:
    """Load a database and check that the map fits it.

    Raises:
        InputError: cantools is missing, the file is not a database that it accepts, or the map
            names what the database lacks or what cannot be sent.
    """
    check_regular(database)
    cantools = require_library("cantools", str(database), "Install the extra [can], or cantools.")
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
        location = f"{database}, message {part.message}"
        trial = Codec(codec.map, codec.database)
        try:
            if isinstance(part, Sent):
                frame = trial.encode(part, dict.fromkeys(part.signals.values(), 0.0))
                zeros = list(part.signals)
            else:
                frame = trial.encode_command(part, 0.0)
                trial.decode(part, bytes(frame.data))
                zeros = [part.signal]
            codec.message(part.message).decode(bytes(frame.data))
            _check_zeros(codec.message(part.message), zeros, bytes(frame.data))
        except Exception as refusal:  # the library raises errors of many kinds
            raise InputError(
                f"{location}: it cannot be sent as the map says: {type(refusal).__name__}: {refusal}",
                "correct the map, or name a database of the vehicle that the map is for",
            ) from refusal
        if codec.message(part.message).is_multiplexed():
            raise InputError(f"{location}: it is multiplexed", "name messages of one layout")
    _check_echoes(codec, database)
    codec.notes = DBC.notes(_met(codec))
    return codec


def _check_zeros(message: Any, names: Sequence[str], data: bytes) -> None:
    """Refuse signals that cannot hold 0: what is at rest would be sent as something else.

    Raises:
        ValueError: Names the first of them, and what it holds.
    """
    values = message.decode(data, decode_choices=False)
    for name in names:
        signal = message.get_signal_by_name(name)
        if abs(float(values[name])) > abs(float(signal.scale)) / 2:
            low, high = _range(signal)
            raise ValueError(f"signal {name} holds {low:g} to {high:g}, and not 0")


def _check_echoes(codec: Codec, database: Path) -> None:
    """Refuse a map whose commands repeat a counter that is not sent, or does not fit.

    Raises:
        InputError: Naming the message.
    """
    sent = codec.map.send[-1:]
    for received in (codec.map.steer, codec.map.accel):
        if received.echo is None:
            continue
        counter = sent[0].counter if sent else None
        if counter is None or codec.counter_size(received.message, received.echo) != (
            codec.counter_size(sent[0].message, counter)
        ):
            raise InputError(
                f"{database}, message {received.message}: echo {received.echo} has no counter of as many bits to repeat in the last message that the map sends",
                "give the last message under send a counter, and echo as many bits",
            )


def _met(codec: Codec) -> Iterator[str]:
    """Yield the names of the attributes that a map's messages and their signals have."""
    for name in dict.fromkeys(part.message for part in codec.map.parts):
        message = codec.message(name)
        specifics = [("message", message.dbc)]
        specifics += [("signal", signal.dbc) for signal in message.signals]
        for holder, specific in specifics:
            if specific is not None:  # a database in another form than DBC
                yield from met_in(holder, (f"@{key}" for key in specific.attributes))


def is_fd(message: Any) -> bool:
    """Return whether a message of a database needs a CAN FD frame."""
    return bool(message.is_fd) or int(message.length) > 8


def _start_value(signal: Any) -> float:
    """Return the value of a signal that nobody sets (``GenSigStartValue``, a raw value).

    It may lie outside of the signal's range, where databases put what says that nothing is known.
    """
    raw = 0 if signal.raw_initial is None else signal.raw_initial
    if signal.is_float:
        return float(raw * signal.scale + signal.offset)
    first, last = _raw_range(signal)
    return float(min(max(raw, first), last) * signal.scale + signal.offset)


def _carried(signal: Any, wanted: float) -> float:
    """Return the value that a signal can hold nearest to the wanted one."""
    low, high = _range(signal)
    held = min(max(wanted, low), high)
    if signal.is_float:
        return float(held)
    first, last = _raw_range(signal)
    raw = min(max(round((held - signal.offset) / signal.scale), first), last)
    return float(raw * signal.scale + signal.offset)


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
        high = float(np.finfo(f"f{int(signal.length) // 8}").max)
        low = -high
    else:
        scaled = [raw * float(signal.scale) + float(signal.offset) for raw in _raw_range(signal)]
        low = min(scaled)
        high = max(scaled)
    least = signal.minimum
    most = signal.maximum
    half = abs(float(signal.scale)) / 2
    if least is None or most is None or not low - half <= least < most <= high + half:
        return low, high
    return max(low, float(least)), min(high, float(most))
