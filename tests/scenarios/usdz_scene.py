"""What scorers see of a scene of AlpaSim."""

from dataclasses import replace

from alpasim_plugin.core.types import Scene
from scenarios.usdz import read_usdz


def read_usdz_scene(path, rails=True):
    """Read a scene; without rails its lanes have only their centres."""
    record = read_usdz(path, needs_map=False)
    maps = record.lane_map, record.alpasim_map
    if not rails:
        maps = [one and without_rails(one) for one in maps]
    return Scene(record.scene_id, maps[0], record.ego_log, record.vehicle, maps[1])


def without_rails(lane_map):
    lanes = lane_map.lanes.items()
    return replace(
        lane_map, lanes={key: replace(lane, left=None, right=None) for key, lane in lanes}
    )
