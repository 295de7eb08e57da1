"""An example control unit: keeps to the path that the bus carries, at the speed of its first
message. A process, or a thread beside a test.

python -m alpasim_plugin.control.can_ecu udp_multicast:239.74.163.2
"""

from __future__ import annotations

import argparse
import math
import threading
from collections.abc import Mapping, Sequence

import can

from alpasim_plugin.control.can_bus import Address, open_bus
from alpasim_plugin.control.can_codec import BadFrame, Codec, checked_values, load_map, open_codec
from alpasim_plugin.core.printing import say

LOOKAHEAD_S, LEAST_LOOKAHEAD_M = 0.7, 5.0
WHEELBASE_M = 2.85
SPEED_GAIN = 0.5  # 1/s


class LaneKeeper:
    """Pure pursuit on the path cubic, and a proportional speed hold; answers the map's last message
    with one pair of commands.
    """

    def __init__(self, codec: Codec) -> None:
        self._codec, self._ratio = codec, codec.map.steering_ratio
        self._seen: dict[str, float] = {}
        self._sent = {codec.address(one.message): one for one in codec.map.send}
        self._trigger = codec.address(codec.map.send[-1].message)
        self._cruise_mps: float | None = None

    def answer(self, frame: can.Message) -> list[can.Message]:
        """Take in a frame and return the commands that answer it.

        A frame that fails its checks is not answered.
        """
        address = frame.arbitration_id, frame.is_extended_id
        one = self._sent.get(address)
        if one is None:
            return []
        try:
            values = checked_values(
                self._codec.message(one.message), bytes(frame.data), one.checksum
            )
        except BadFrame:
            return []
        for name, quantity in one.signals.items():
            self._seen[quantity] = values[name]
        if address != self._trigger or "speed_kph" not in self._seen:
            return []
        steer, accel = self._codec.map.steer, self._codec.map.accel
        wheel_deg, accel_mps2 = self.command(self._seen)
        return [
            self._codec.encode_command(steer, wheel_deg),
            self._codec.encode_command(accel, accel_mps2),
        ]

    def command(self, seen: Mapping[str, float]) -> tuple[float, float]:
        """Return steering wheel angle (deg, left positive) and acceleration (m/s^2)."""
        speed = seen["speed_kph"] / 3.6
        self._cruise_mps = speed if self._cruise_mps is None else self._cruise_mps
        x = min(
            max(LOOKAHEAD_S * speed, LEAST_LOOKAHEAD_M),
            max(seen.get("path_length_m", 0.0), LEAST_LOOKAHEAD_M),
        )
        y = seen.get("path_offset_m", 0.0) + seen.get("path_heading_rad", 0.0) * x
        y += (
            seen.get("path_curvature_1pm", 0.0) * x**2 / 2
            + seen.get("path_curvature_rate_1pm2", 0.0) * x**3 / 6
        )
        steer = math.atan(2 * WHEELBASE_M * y / (x * x + y * y))
        return math.degrees(steer) * self._ratio, SPEED_GAIN * (self._cruise_mps - speed)


def serve(bus: can.BusABC, unit: LaneKeeper, stop: threading.Event) -> None:
    """Answer the bus until `stop` is set."""
    while not stop.is_set():
        frame = bus.recv(0.05)
        for command in unit.answer(frame) if frame is not None else ():
            bus.send(command)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the unit until Ctrl-C."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument(
        "address",
        help="as after can://, such as udp_multicast:239.74.163.2 or socketcan:vcan0?map=MAP.yaml&dbc=FILE",
    )
    address = Address.parse(parser.parse_args(arguments).address)
    codec = open_codec(*load_map(address.map, address.dbc))
    unit = LaneKeeper(codec)
    with open_bus(address, codec) as bus:
        say(f"control unit on {address.interface}:{address.channel}, map {address.map}")
        try:
            serve(bus, unit, threading.Event())
        except KeyboardInterrupt:
            say("stopped")


if __name__ == "__main__":
    main()
