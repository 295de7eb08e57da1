"""One exchange with a control unit over a CAN bus: messages out, its commands in, and what happens
when they do not come.

A command that is missing at its deadline is replaced: the last one is held for `HOLD_US`, then the
vehicle is braked by a ramp while the steering is held. Every such instant, and every frame that was
refused, is counted by cause.

Commands of two rollouts on one channel cannot be told apart. So a rollout takes its channel for
itself (`OwnChannel`), forgets what stood on the bus before, and waits at its end for what it is
still owed. A map may name a signal in which the unit repeats the counter of what it answers; then a
command counts for no other instant.
"""

from __future__ import annotations

import hashlib
import os
import re
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import can
import numpy as np
from filelock import FileLock, Timeout

from alpasim_plugin.control.can_codec import BadFrame, Codec, FrameId, Received
from alpasim_plugin.core.errors import InfrastructureError, InputError, PolicyError
from alpasim_plugin.core.files import places
from alpasim_plugin.core.files.atomic import disk_error
from alpasim_plugin.core.queries import options_of

HOLD_US = 200_000  # how long the last command stands in for a missing one
# Then the brake grows at this rate up to this deceleration
RAMP_MPS3 = 2.0
STOP_MPS2 = -3.0
SILENT_US = 1_000_000  # of a rollout in which no command at all comes: there is no control unit
IDLE_STEP_US = 100_000  # between instants of a map that sends nothing
INTERFACES = ("virtual", "socketcan", "udp_multicast")

Mark = Literal["fresh", "held", "ramped"]


@dataclass(frozen=True)
class Address:
    """What stands after ``can://``: ``INTERFACE:CHANNEL[?map=NAME&dbc=FILE&timeout_ms=N]``."""

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
            InputError: No interface, one that is not of `INTERFACES`, no channel, an unknown option,
                or a bad number.
        """
        place, _, query = text.partition("?")
        options = options_of(query, ("map", "dbc", "timeout_ms"), f"can://{text}")
        interface, _, channel = place.partition(":")
        timeout = options.get("timeout_ms", "100")
        problem = ""
        if interface not in INTERFACES:
            problem = f"{interface!r} is no interface"
        elif not channel:
            problem = "no channel"
        elif not re.fullmatch("[1-9][0-9]{0,4}", timeout) or int(timeout) > 10_000:
            problem = "timeout_ms is no number from 1 to 10000"
        if problem:
            raise InputError(
                f"can://{text}: {problem}",
                f"write can://INTERFACE:CHANNEL[?map=NAME&dbc=FILE&timeout_ms=N], INTERFACE of {', '.join(INTERFACES)}",
            )
        name = options.get("map", "example")
        return cls(interface, channel, name, options.get("dbc"), int(timeout) / 1000)

    @property
    def bus(self) -> str:
        """Give interface and channel."""
        return f"{self.interface}:{self.channel}"


class OwnChannel:
    """The right to use a channel: of all commands of this user on this machine, a single rollout
    has it at a time. A virtual bus is one of its process.

    Args:
        bus: Interface and channel.
    """

    def __init__(self, bus: str) -> None:
        self._bus = bus
        place = f"{bus} {os.getpid()}" if bus.startswith("virtual:") else bus
        name = hashlib.sha256(place.encode()).hexdigest()[:16]
        self._path = places.cache() / "can" / f"{name}.lock"
        self._lock = FileLock(self._path)

    def take(self) -> None:
        """Take the channel.

        Raises:
            InfrastructureError: Another rollout has it, or the cache cannot be written.
        """
        if self._lock.is_locked:
            return
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._lock.acquire(timeout=0)
        except Timeout:
            raise InfrastructureError(
                f"can://{self._bus}: another rollout drives on this channel",
                "wait until it ends, or give each its own channel and control unit",
            ) from None
        except OSError as error:
            raise disk_error(self._path, error) from error

    def release(self) -> None:
        """Let other rollouts use the channel; harmless without the right."""
        self._lock.release()


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
    t_us: int = 0  # simulated time of its last value
    counter: int | None = None
    questions_ago: int = 0  # how many instants before the last one its value was made for


@dataclass
class Exchange:
    """Sends what is due and waits for the commands of one instant.

    Attributes:
        counts: Frames and instants by what happened to them: ``sent``, ``fresh``, ``held``,
            ``ramped``, ``late``, ``stale``, ``lost``, ``repeated``, ``malformed``,
            ``out_of_range``, ``not_enabled``, ``other``.
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
        self._has_answered = False
        self._is_owed = False  # the commands of the last instant have not come
        self._questions = 0  # how often the map's last message was sent
        self._shortest_us = min(
            (sent.period_us for sent in self.codec.map.send), default=IDLE_STEP_US
        )
        self._own_ids = {self.codec.address(sent.message) for sent in self.codec.map.send}
        self._by_id: dict[FrameId, list[_Command]] = {}
        for command in (self._steer, self._accel):  # one message may carry both
            self._by_id.setdefault(self.codec.address(command.part.message), []).append(command)

    def forget(self) -> None:
        """Discard what stands on the bus: it was sent before this rollout."""
        while self.bus.recv(0) is not None:
            pass

    def instants(self, from_us: int, to_us: int) -> list[int]:
        """Return the instants in ``[from_us, to_us)`` at which a message is due: the first one of
        all, and whole multiples of each message's period after it.
        """
        self._began_us = from_us if self._began_us is None else self._began_us
        began_us = self._began_us
        periods = {self._shortest_us, *(sent.period_us for sent in self.codec.map.send)}
        return sorted(
            {
                began_us + n * period_us
                for period_us in periods
                for n in range(
                    -((began_us - from_us) // period_us), -((began_us - to_us) // period_us)
                )
            }
        )

    def step(self, t_us: int, quantities: Mapping[str, float]) -> Commands:
        """Send the messages that are due at an instant and return the commands that hold from it
        on. Answers are awaited at multiples of the shortest period.

        Args:
            t_us: Simulated time, one of `instants`.
            quantities: By the names of `can_map.Quantity`.

        Raises:
            PolicyError: The bus refuses to send.
            InfrastructureError: No command at all has come for `SILENT_US`.
        """
        self._began_us = t_us if self._began_us is None else self._began_us
        while (frame := self.bus.recv(0)) is not None:
            self._take(frame, t_us, is_early=True)
        self._send_due(t_us, quantities)
        if (t_us - self._began_us) % self._shortest_us:
            return self._commands(t_us, is_missing=False)
        self._is_owed = self._wait(t_us)
        if not self._has_answered and t_us - self._began_us >= SILENT_US:
            raise self._silence()
        commands = self._commands(t_us, self._is_owed)
        self.counts[commands.mark] += 1
        return commands

    def _commands(self, t_us: int, is_missing: bool) -> Commands:
        """Return the commands that hold at an instant at which some are missing, or none."""
        wheel = self._steer.value
        accel = self._accel.value
        since_us = min(self._steer.t_us, self._accel.t_us)
        mark: Mark = "held" if is_missing else "fresh"
        if wheel is None or accel is None:  # nothing to hold: the ramp begins at once
            assert self._began_us is not None
            since_us = self._began_us - HOLD_US
            mark = "ramped"
        over_us = t_us - since_us - HOLD_US
        if is_missing and over_us > 0:
            mark = "ramped"
        if mark == "ramped":
            last = min(accel or 0.0, 0.0)
            # a vehicle that brakes harder already is not let go
            accel = max(last - RAMP_MPS3 * max(over_us, 0) * 1e-6, min(STOP_MPS2, last))
        return Commands(wheel or 0.0, accel or 0.0, mark)

    def finish(self) -> None:
        """Wait once more for what the unit still owes: it is no command of the next rollout.

        Raises:
            InfrastructureError: No command at all has come.
        """
        if self._is_owed:
            assert self._began_us is not None
            self._wait(self._began_us)
        if self._began_us is not None and not self._has_answered:
            raise self._silence()

    def _silence(self) -> InfrastructureError:
        sent = self.counts["sent"]
        wanted = ", ".join(
            f"{name} (0x{self.codec.address(name)[0]:x})"
            for name in dict.fromkeys((self._steer.part.message, self._accel.part.message))
        )
        return InfrastructureError(
            f"{self.bus.channel_info}: the control unit sent no command: {sent} frames went out, and no {wanted} came",
            "start the control unit on this channel, and check the identifiers in the map",
        )

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
        assert self._began_us is not None
        for sent in self.codec.map.send:
            if (t_us - self._began_us) % sent.period_us == 0:
                try:
                    self.bus.send(self.codec.encode(sent, quantities))
                except can.CanError as error:
                    raise PolicyError(
                        f"{self.bus.channel_info}: {error}",
                        "check that the bus is up",
                    ) from error
                self.counts["sent"] += 1
                self._questions += sent is self.codec.map.send[-1]

    def facts(self) -> dict[str, Any]:
        """Return counts and latency, for the rollout's manifest."""
        ms = np.array(self.latencies_s) * 1000
        quantiles = (
            {f"p{q}": round(float(np.percentile(ms, q)), 3) for q in (50, 95, 99)}
            if len(ms)
            else {}
        )
        return {"frames": dict(self.counts), "latency_ms": quantiles}

    def _take(self, frame: can.Message, t_us: int, is_early: bool = False) -> list[_Command]:
        """Take in a frame; return the commands that it renews for this instant: none where it is
        refused, another's, or an answer to an earlier instant.

        Args:
            frame: From the bus.
            t_us: The instant.
            is_early: Nothing has been sent yet at this instant, so that the frame answers an
                earlier one.
        """
        address = frame.arbitration_id, frame.is_extended_id
        if address in self._own_ids:
            return []  # multicast gives back what was sent
        commands = self._by_id.get(address, [])
        if not commands or frame.is_error_frame or frame.is_remote_frame:
            self.counts["other"] += 1
            return []
        self._has_answered = True
        renewed = [command for command in commands if self._renew(command, frame, t_us)]
        answering = []
        if not is_early:
            answering = [command for command in renewed if command.questions_ago == 0]
        if len(answering) < len(renewed):
            self.counts["late"] += 1
        return answering

    def _renew(self, command: _Command, frame: can.Message, t_us: int) -> bool:
        """Take in a command; return whether the frame renews it."""
        try:
            reading = self.codec.decode(command.part, bytes(frame.data))
        except BadFrame as error:
            self.counts[error.fault] += 1
            return False
        counter = reading.counter
        if command.part.counter is not None and counter is not None and command.counter is not None:
            size = self.codec.counter_size(command.part.message, command.part.counter)
            ahead = (counter - command.counter) % size
            if ahead == 0:
                self.counts["repeated"] += 1
                return False
            self.counts["lost"] += ahead - 1
        questions_ago = 0
        if reading.echo is not None:
            questions_ago = self.codec.questions_since(reading.echo)
            if questions_ago >= self._questions:
                self.counts["stale"] += 1
                return False
        command.counter, command.value, command.t_us = counter, reading.value, t_us
        command.questions_ago = questions_ago
        return True
