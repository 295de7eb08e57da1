"""What scorers see of a scene of AlpaSim."""

from alpasim_plugin.core.types import Scene
from scenarios.usdz import read_usdz


def read_usdz_scene(path, rails=True):
    record = read_usdz(path, rails, needs_map=False)
    return Scene(
        record.scene_id, record.lane_map, record.ego_log, record.vehicle, record.alpasim_map
    )
