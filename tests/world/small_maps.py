"""Small maps made by hand, for tests of maps, routes and readers."""

import numpy as np

from alpasim_plugin.core.geometry import centre_line
from alpasim_plugin.core.types import Lane, LaneMap

FAR = np.array([512_345.0, 5_412_678.0, 640.0])  # UTM-sized


def straight(lane_id, x0, x1, y=0.0, width=3.5, z=0.0, **more):
    left = np.array([[x0, y + width / 2, z], [x1, y + width / 2, z]])
    right = np.array([[x0, y - width / 2, z], [x1, y - width / 2, z]])
    return Lane(lane_id, centre_line(left, right), left, right, **more)


def arc(lane_id, radius, degrees, start=(0.0, 0.0), turn=1.0, **more):
    a = np.radians(np.linspace(0.0, degrees, 20))

    def line(offset):
        r = radius - turn * offset
        return np.column_stack(
            [start[0] + r * np.sin(a), start[1] + turn * (radius - r * np.cos(a)), np.zeros_like(a)]
        )

    return Lane(lane_id, centre_line(line(1.75), line(-1.75)), line(1.75), line(-1.75), **more)


def make(*lanes, shift=0.0):
    moved = [
        Lane(
            **{
                **vars(k),
                "centre": k.centre + shift,
                "left": k.left + shift,
                "right": k.right + shift,
            }
        )
        for k in lanes
    ]
    return LaneMap({k.lane_id: k for k in moved})
