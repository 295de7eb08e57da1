"""An example control unit: keeps to the path that the bus carries, at the speed of its first
message. A process, or a thread beside a test.

python -m tests.control.can_ecu udp_multicast:239.74.163.2
"""

import math
import sys
import threading

from alpasim_plugin.control.can_bus import Address, open_bus
from alpasim_plugin.control.can_codec import load_map, open_codec

LOOKAHEAD_S = 0.7
LEAST_LOOKAHEAD_M = 5.0
WHEELBASE_M = 2.85
SPEED_GAIN = 0.5  # 1/s


class LaneKeeper:
    """Pure pursuit on the path cubic, and a proportional speed hold; answers the map's last message
    with one pair of commands.
    """

    def __init__(self, codec):
        self._codec = codec
        self._seen = {}
        self._sent = {codec.address(one.message): one for one in codec.map.send}
        self._cruise_mps = None

    def answer(self, frame):
        """Take in a frame and return the commands that answer it."""
        one = self._sent.get((frame.arbitration_id, frame.is_extended_id))
        if one is None:
            return []
        values = self._codec.message(one.message).decode(bytes(frame.data))
        self._seen |= {quantity: values[name] for name, quantity in one.signals.items()}
        can_map = self._codec.map
        if one is not can_map.send[-1] or "speed_kph" not in self._seen:
            return []
        wheel_deg, accel_mps2 = self.command()
        echo = int(values[one.counter]) if one.counter else 0
        return [
            self._codec.encode_command(can_map.steer, wheel_deg, echo),
            self._codec.encode_command(can_map.accel, accel_mps2, echo),
        ]

    def command(self):
        """Return steering wheel angle (deg, left positive) and acceleration (m/s^2)."""
        seen = dict.fromkeys(("path_length_m", "path_offset_m", "path_heading_rad"), 0.0)
        seen |= dict.fromkeys(("path_curvature_1pm", "path_curvature_rate_1pm2"), 0.0) | self._seen
        speed = seen["speed_kph"] / 3.6
        self._cruise_mps = speed if self._cruise_mps is None else self._cruise_mps
        reach_m = max(seen["path_length_m"], LEAST_LOOKAHEAD_M)
        x = min(max(LOOKAHEAD_S * speed, LEAST_LOOKAHEAD_M), reach_m)
        y = seen["path_offset_m"] + seen["path_heading_rad"] * x
        y += seen["path_curvature_1pm"] * x**2 / 2 + seen["path_curvature_rate_1pm2"] * x**3 / 6
        steer = math.atan(2 * WHEELBASE_M * y / (x * x + y * y))
        wheel_deg = math.degrees(steer) * self._codec.map.steering_ratio
        return wheel_deg, SPEED_GAIN * (self._cruise_mps - speed)


def serve(bus, unit, stop):
    """Answer the bus until `stop` is set."""
    while not stop.is_set():
        frame = bus.recv(0.05)
        for command in unit.answer(frame) if frame is not None else ():
            bus.send(command)


if __name__ == "__main__":
    place = Address.parse(sys.argv[1])
    codec = open_codec(*load_map(place.map, place.dbc))
    with open_bus(place, codec) as bus:
        print(f"control unit on {place.interface}:{place.channel}", flush=True)
        serve(bus, LaneKeeper(codec), threading.Event())
