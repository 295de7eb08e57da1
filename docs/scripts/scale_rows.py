"""Write a run folder of any size whose rollouts were not driven but drawn, to try aggregation and
report on a million rows.

    python docs/scripts/scale_rows.py runs/drawn --rollouts 1000000

The rows have the columns, the metrics and the gaps of a real run: two renderers meet the same
scenes and seeds; what is hard about a scene is shared by its seeds and by both renderers (a probit
scene effect with an intra-class correlation of 0.3), so that pairs are sharp and scenes are
clusters; rates are rare; half a percent of the rollouts failed; metrics of contact exist only where
there was contact, the gap to obstacles only in scenes with road users. ``run.json`` says that the
rows were drawn. There are no rollout folders and no steps.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import scipy

from alpasim_plugin.core.atomic import write_json
from alpasim_plugin.log.run_folder.columns import RolloutTable
from alpasim_plugin.log.run_folder.manifests import write_contents, write_run_json
from alpasim_plugin.log.run_folder.schema import (
    ROLLOUTS,
    ROLLOUTS_TABLE,
    STEPS,
    STEPS_TABLE,
    SUMMARY,
    rollout_folder,
)
from alpasim_plugin.log.run_folder.writer import write_parquet
from evaluators.metrics import METRICS as KNOWN
from evaluators.statistics.summary import numbers

RENDERERS, POLICY = ("clean", "3dgs"), "lane-camera"
CORRELATION, FAILED, CROWDED = (
    0.3,
    0.005,
    0.7,
)  # of hardness within a scene; shares of rollouts, and of scenes with road users
CHUNK_SCENES = 500
RATES = {
    "collision_front": (0.010, 0.014),
    "collision_lateral": (0.006, 0.009),
    "collision_rear": (0.004, 0.004),
    "offroad": (0.015, 0.022),
}
# metric -> median and spread of the logarithm, and how many times larger behind the second renderer
SPREADS = {
    "lateral_distance_m": (0.18, 0.6, 1.25),
    "route_distance_m": (0.22, 0.6, 1.2),
    "dist_to_gt_trajectory": (0.5, 0.7, 1.2),
    "dist_to_gt_location": (2.4, 0.5, 1.1),
    "plan_deviation": (0.07, 0.4, 1.5),
    "dist_traveled_m": (62.0, 0.3, 1.0),
    "min_distance_to_lane_boundary_m": (0.5, 0.4, 0.95),
    "min_ade@0.5s(gt)": (0.06, 0.5, 1.2),
    "min_ade@1.0s(gt)": (0.15, 0.5, 1.2),
    "min_ade@2.5s(gt)": (0.7, 0.5, 1.2),
}
METRICS = (
    "collision_at_fault",
    "collision_any",
    *RATES,
    *SPREADS,
    "progress",
    "min_distance_to_obstacle_m",
    "contact_time_s",
    "contact_x_m",
    "contact_y_m",
    "offroad_or_collision",
    "lateral_bias_m",
    "wrong_lane",
    "img_is_black",
    "duration_frac_20s",
)


def chunks(rollouts: int, seeds: int, key: int) -> Iterator[pa.RecordBatch]:
    """Yield the rows of a run, scene by scene, in the order in which a run has them."""
    schema = ROLLOUTS_TABLE.arrow(METRICS)
    scenes = -(-rollouts // (len(RENDERERS) * seeds))
    for first in range(0, scenes, CHUNK_SCENES):
        rng = np.random.Generator(np.random.Philox(key=[key, first]))
        rows = _rows(rng, first, min(CHUNK_SCENES, scenes - first), seeds)
        taken = min(len(rows["seed"]), rollouts - first * len(RENDERERS) * seeds)
        yield pa.RecordBatch.from_pydict(
            {name: rows[name][:taken] for name in schema.names}, schema
        )


def _rows(rng: np.random.Generator, first: int, scenes: int, seeds: int) -> dict[str, Any]:
    shape = (scenes, len(RENDERERS), seeds)
    scene, renderer, seed = (axis.ravel() for axis in np.indices(shape))
    failed = rng.random(len(scene)) < FAILED

    def hardness() -> Any:
        """Standard normal; shared by a scene, and mostly by the two renderers of a cell."""
        of_scene, of_cell = rng.normal(size=(scenes, 1, 1)), rng.normal(size=(scenes, 1, seeds))
        own = rng.normal(size=shape)
        mixed = (
            np.sqrt(CORRELATION) * of_scene
            + np.sqrt(0.9 - CORRELATION) * of_cell
            + np.sqrt(0.1) * own
        )
        return mixed.ravel()

    values: dict[str, Any] = {}
    for name, rates in RATES.items():
        values[name] = (hardness() > scipy.special.ndtri(1.0 - np.array(rates)[renderer])).astype(
            np.float64
        )
    contact = np.maximum.reduce([values[name] for name in RATES if name.startswith("collision")])
    values["collision_any"] = contact
    values["collision_at_fault"] = np.maximum(
        values["collision_front"], values["collision_lateral"]
    )
    values["offroad_or_collision"] = np.maximum(contact, values["offroad"])
    for name, (median, spread, times) in SPREADS.items():
        values[name] = median * np.where(renderer == 1, times, 1.0) * np.exp(spread * hardness())
    values["progress"] = np.clip(
        1.0
        - 0.02 * np.exp(0.8 * hardness())
        - 0.3 * values["offroad_or_collision"] * rng.random(len(scene)),
        0.0,
        1.0,
    )
    crowded = (
        (rng.random((scenes, 1, 1)) < CROWDED).repeat(len(RENDERERS), 1).repeat(seeds, 2).ravel()
    )
    values["min_distance_to_obstacle_m"] = np.where(
        contact > 0, 0.0, 3.0 * np.exp(0.7 * hardness())
    )
    values["contact_time_s"] = rng.uniform(1.0, 20.0, len(scene))
    values["contact_x_m"], values["contact_y_m"] = (
        rng.uniform(-1.0, 3.8, len(scene)),
        rng.normal(0.0, 0.5, len(scene)),
    )
    values["lateral_bias_m"] = 0.1 * hardness()
    values["wrong_lane"] = (hardness() > 3.0).astype(np.float64)
    values["img_is_black"] = np.zeros(len(scene))
    values["duration_frac_20s"] = 1.0 - 0.6 * values["offroad_or_collision"] * rng.random(
        len(scene)
    )
    there = {name: ~failed & (contact > 0) for name in METRICS if name.startswith("contact_")}
    there["min_distance_to_obstacle_m"] = ~failed & crowded
    ids = [f"drawn-{first + number:06d}" for number in range(scenes)]
    folders = [
        [rollout_folder(name, POLICY, one, 0).parent.as_posix() for name in RENDERERS]
        for one in ids
    ]
    rows: dict[str, Any] = {
        "renderer": np.array(RENDERERS)[renderer],
        "policy": np.full(len(scene), POLICY),
        "scene": np.array(ids)[scene],
        "seed": seed,
        "status": np.where(failed, "failed", "ok"),
        "failure_class": np.where(failed, "policy", None),
        "failure": np.where(failed, "act returned a plan with a NaN in xy", None),
        "path": [
            f"{folders[s][r]}/{k}"
            for s, r, k in zip(scene.tolist(), renderer.tolist(), seed.tolist(), strict=True)
        ],
        "wall_s": np.round(np.exp(rng.normal(1.8, 0.3, len(scene))), 4),
        "frames": np.full(len(scene), 67),
        "steps": np.full(len(scene), 200),
    }
    for name in METRICS:
        valid = there.get(name, ~failed)
        rows[name] = pa.array(values[name], mask=~valid)
        rows[f"{name}_valid"] = pa.array(valid, mask=failed)
    return rows


def write_drawn_run(root: Path, rollouts: int, seeds: int = 10, key: int = 1) -> None:
    """Write a run folder: ``run.json``, ``rollouts.parquet``, an empty ``steps.parquet``,
    ``summary.json``, ``contents.json``.
    """
    root.mkdir(parents=True, exist_ok=True)
    with pq.ParquetWriter(
        root / ROLLOUTS, ROLLOUTS_TABLE.arrow(METRICS), compression="zstd"
    ) as writer:
        for batch in chunks(rollouts, seeds, key):
            writer.write_batch(batch)
    write_parquet(root / STEPS, STEPS_TABLE.arrow().empty_table())
    scenes = -(-rollouts // (len(RENDERERS) * seeds))
    info_of_run = {
        "schema_version": 1,
        "key": "drawn",
        "command": ["python", "docs/scripts/scale_rows.py", str(root), "--rollouts", str(rollouts)],
        "config": {"baseline": RENDERERS[0]},
        "preset": "paper",
        "renderers": list(RENDERERS),
        "policies": [POLICY],
        "seeds": list(range(seeds)),
        "scenes": {
            f"drawn-{n:06d}": {"source": "drawn", "content_hash": f"{n:064x}", "notes": []}
            for n in range(scenes)
        },
        "left_out": [
            "everything: these rows were drawn by docs/scripts/scale_rows.py and not driven"
        ],
        "metrics": {},
    }
    write_run_json(root, info_of_run)
    table = RolloutTable.of_files([root / ROLLOUTS])
    by_class = table.failures()
    failures = {
        "n_failed": sum(by_class.values()),
        "n_rollouts": rollouts,
        "by_class": by_class,
        "cells": [],
    }
    write_json(
        root / SUMMARY, {"preset": "paper", **numbers(table, RENDERERS[0]), "failures": failures}
    )
    write_contents(root, {})


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rollouts", type=int, default=1_000_000)
    parser.add_argument("--seeds", type=int, default=10, help="rollout seeds of each scene")
    parser.add_argument("--key", type=int, default=1, help="of the random numbers")
    chosen = parser.parse_args()
    for name in METRICS:
        KNOWN.info(name)  # every metric is one that a run can have
    write_drawn_run(chosen.folder, chosen.rollouts, chosen.seeds, chosen.key)


if __name__ == "__main__":
    main()
