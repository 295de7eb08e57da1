"""Tables of rollouts with the numbers that a gate judges."""

import itertools

import numpy as np
import pyarrow as pa

from alpasim_plugin.log.run_folder.sides import RolloutTable

SCENES = 14


def rows(renderer="3dgs", scenes=SCENES, seeds=1, policy="p"):
    """Rows of one renderer, the same for each."""
    rng = np.random.Generator(np.random.Philox(9))
    made = []
    for scene, seed in itertools.product(range(scenes), range(seeds)):
        values = {
            "lateral_distance_m": 0.3 + 0.2 * rng.random(),
            "progress": 0.9,
            "collision_any": 0.0,
            "collision_at_fault": 0.0,
            "offroad": 0.0,
            "wrong_lane": 0.0,
            "img_is_black": 0.0,
        }
        names = {"renderer": renderer, "policy": policy, "scene": f"s{scene:03d}", "seed": seed}
        valid = {f"{name}_valid": True for name in values}
        made.append(names | {"status": "ok", "failure_class": None} | values | valid)
    return made


def table_of(made):
    return RolloutTable.of_table(pa.Table.from_pylist(made))


def add(change, metric="lateral_distance_m", where=slice(None)):
    """Return a change of one metric in some of the rows."""

    def changed(candidate):
        for row in candidate[where]:
            row[metric] += change
        return candidate

    return changed
