"""One exchange with a control unit over a CAN bus: messages out, its commands in, and what happens
when they do not come.

A command that is missing at its deadline is replaced: the last one is held for `HOLD_US`, then the
vehicle is braked by a ramp while the steering is held. Every such instant, and every frame that was
refused, is counted by cause.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import can
import numpy as np

from alpasim_plugin.control.can_codec import BadFrame, Codec, FrameId, Received
from alpasim_plugin.core.errors import InputError, PolicyError
from alpasim_plugin.core.queries import options_of

HOLD_US = 200_000  # how long the last command stands in for a missing one
# Then the brake grows at this rate up to this deceleration
RAMP_MPS3 = 2.0
STOP_MPS2 = -3.0
INTERFACES = ("virtual", "socketcan", "udp_multicast")

Mark = Literal["fresh", "held", "ramped"]


@dataclass(frozen=True)
class Address:
    """What stands after ``can://``: ``[INTERFACE:]CHANNEL[?map=NAME&dbc=FILE&timeout_ms=N]``."""

    interface: str
    channel: str
    map: str
    dbc: str | None
    timeout_s: float

    @classmethod
    def parse(cls, text: str) -> Address:
        """Read an address.

        Example:
            >>> Address.parse("udp_multicast:239.74.163.2?map=car.yaml&timeout_ms=20").timeout_s
            0.02

        Raises:
            InputError: No channel, an unknown option, or a bad number.
        """
        place, _, query = text.partition("?")
        options = options_of(query, ("map", "dbc", "timeout_ms"), f"can://{text}")
        interface, colon, channel = place.partition(":")
        if not colon or interface not in INTERFACES:
            interface = "virtual"
            channel = place
        timeout = options.get("timeout_ms", "100")
        if not channel or not timeout.isdigit() or not 0 < int(timeout) <= 10_000:
            raise InputError(
                f"can://{text}: no channel, or a timeout_ms that is no number from 1 to 10000",
                f"write can://[{'|'.join(INTERFACES)}:]CHANNEL[?map=NAME&dbc=FILE&timeout_ms=N]",
            )
        name = options.get("map", "example")
        return cls(interface, channel, name, options.get("dbc"), int(timeout) / 1000)


def open_bus(address: Address, codec: Codec | None = None) -> can.BusABC:
    """Open a bus; nothing that it sends comes back to it.

    Args:
        address: Of the bus.
        codec: Whose messages it carries; None is classic CAN.

    Raises:
        InputError: The interface or the channel does not work on this machine.
    """
    try:
        return can.Bus(
            interface=address.interface,
            channel=address.channel,
            receive_own_messages=False,
            fd=codec is not None and codec.uses_fd,
        )
    except Exception as error:  # every interface raises errors of its own
        raise InputError(
            f"{address.interface}:{address.channel}: {type(error).__name__}: {error}",
            f"use one that this machine has: {', '.join(INTERFACES)}",
        ) from error


@dataclass(frozen=True)
class Commands:
    """The commands that hold from an instant on."""

    wheel_deg: float  # steering wheel, left positive
    accel_mps2: float
    mark: Mark


@dataclass
class _Command:
    """The state of one of the two commands."""

    part: Received
    value: float | None = None
    t_us: int = 0  # simulated time of its last fresh value
    counter: int | None = None


@dataclass
class Exchange:
    """Sends what is due and waits for the commands of one instant.

    Attributes:
        counts: Frames and instants by what happened to them: ``sent``, ``fresh``, ``held``,
            ``ramped``, ``late``, ``lost``, ``repeated``, ``malformed``, ``out_of_range``,
            ``not_enabled``, ``other``.
        latencies_s: From the last frame sent to the command that completed each fresh instant, wall
            time.
    """

    bus: can.BusABC
    codec: Codec
    timeout_s: float
    clock: Callable[[], float] = time.perf_counter
    counts: Counter[str] = field(default_factory=Counter)
    latencies_s: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._steer = _Command(self.codec.map.steer)
        self._accel = _Command(self.codec.map.accel)
        self._began_us: int | None = None
        self._own_ids = {self.codec.address(sent.message) for sent in self.codec.map.send}
        self._by_id: dict[FrameId, list[_Command]] = {}
        for command in (self._steer, self._accel):  # one message may carry both
            self._by_id.setdefault(self.codec.address(command.part.message), []).append(command)

    def step(self, t_us: int, quantities: Mapping[str, float]) -> Commands:
        """Send the messages that are due at an instant and return the commands that answer them.

        Args:
            t_us: Simulated time; a message is due at whole multiples of its period.
            quantities: By the names of `can_map.Quantity`.

        Raises:
            PolicyError: The bus refuses to send.
        """
        while (frame := self.bus.recv(0)) is not None:
            self.counts["late"] += bool(self._take(frame, t_us))
        self._send_due(t_us, quantities)
        waiting = self._wait(t_us)
        self._began_us = t_us if self._began_us is None else self._began_us
        wheel = self._steer.value
        accel = self._accel.value
        since_us = min(self._steer.t_us, self._accel.t_us)
        mark: Mark = "held" if waiting else "fresh"
        if wheel is None or accel is None:  # nothing to hold: the ramp begins at once
            since_us = self._began_us - HOLD_US
            mark = "ramped"
        over_us = t_us - since_us - HOLD_US
        if waiting and over_us > 0:
            mark = "ramped"
        self.counts[mark] += 1
        if mark == "ramped":
            ramp = min(accel or 0.0, 0.0) - RAMP_MPS3 * max(over_us, 0) * 1e-6
            accel = max(ramp, STOP_MPS2)
        return Commands(wheel or 0.0, accel or 0.0, mark)

    def _wait(self, t_us: int) -> bool:
        """Take answers until both commands are new; return whether one still is not, after the time
        limit.
        """
        began = self.clock()
        waiting = {id(self._steer), id(self._accel)}
        while waiting and (left := began + self.timeout_s - self.clock()) > 0:
            frame = self.bus.recv(left)
            if frame is not None:
                waiting -= {id(command) for command in self._take(frame, t_us)}
        if not waiting:
            self.latencies_s.append(self.clock() - began)
        return bool(waiting)

    def _send_due(self, t_us: int, quantities: Mapping[str, float]) -> None:
        for sent in self.codec.map.send:
            if t_us % sent.period_us == 0:
                try:
                    self.bus.send(self.codec.encode(sent, quantities))
                except can.CanError as error:
                    raise PolicyError(
                        f"{self.bus.channel_info}: {error}",
                        "check that the bus is up",
                    ) from error
                self.counts["sent"] += 1

    def facts(self) -> dict[str, Any]:
        """Return counts and latency, for the rollout's manifest."""
        ms = np.array(self.latencies_s) * 1000
        quantiles = (
            {f"p{q}": round(float(np.percentile(ms, q)), 3) for q in (50, 95, 99)}
            if len(ms)
            else {}
        )
        return {"frames": dict(self.counts), "latency_ms": quantiles}

    def _take(self, frame: can.Message, t_us: int) -> list[_Command]:
        """Take in a frame; return the commands that it renews, none where it is refused or
        another's.
        """
        address = frame.arbitration_id, frame.is_extended_id
        if address in self._own_ids:
            return []  # multicast gives back what was sent
        commands = self._by_id.get(address, [])
        if not commands or frame.is_error_frame or frame.is_remote_frame:
            self.counts["other"] += 1
            return []
        return [one for one in commands if self._renew(one, frame, t_us)]

    def _renew(self, command: _Command, frame: can.Message, t_us: int) -> bool:
        """Take in a command; return whether the frame renews it."""
        try:
            value, counter = self.codec.decode(command.part, bytes(frame.data))
        except BadFrame as error:
            self.counts[error.fault] += 1
            return False
        if command.part.counter is not None and counter is not None and command.counter is not None:
            size = self.codec.counter_size(command.part.message, command.part.counter)
            ahead = (counter - command.counter) % size
            if ahead == 0:
                self.counts["repeated"] += 1
                return False
            self.counts["lost"] += ahead - 1
        command.counter, command.value, command.t_us = counter, value, t_us
        return True
