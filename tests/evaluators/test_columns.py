"""Aggregation from columns, streamed, gives what the rows in memory give: means, intervals, pairs,
verdicts, and what is missing.
"""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.run_folder.sides import RolloutTable
from evaluators import aggregate, paired
from evaluators.statistics.summary import numbers
from tests.evaluators.eval_build import base_pairs

METRICS = ("offroad", "progress", "lateral_distance_m", "min_distance_to_obstacle_m")
KEYS = ("renderer", "policy", "scene", "seed", "status", "failure_class")


def rows_like_a_run(renderers, policies, scenes, seeds, key):
    """Make rows with failures, invalid and infinite values, and cells that one side lacks."""
    rng = np.random.Generator(np.random.Philox(key))
    rows = []
    for scene in range(scenes):
        hard = rng.normal()
        for renderer in renderers:
            for policy in policies:
                for seed in seeds:
                    for _ in range(1 if rng.random() < 0.9 else int(rng.integers(0, 2))):
                        failed = rng.random() < 0.05
                        row = dict(
                            zip(
                                KEYS,
                                (renderer, policy, f"scene-{97 * scene % 31}", seed, "ok", None),
                                strict=True,
                            )
                        )
                        if failed:
                            row |= {
                                "status": "failed",
                                "failure_class": str(rng.choice(["policy", "renderer"])),
                            }
                        values = (
                            float(hard + rng.normal() > 1.2),
                            rng.random(),
                            abs(hard + rng.normal()),
                            rng.choice([np.inf, 3.0]),
                        )
                        for name, value in zip(METRICS, values, strict=True):
                            valid = not failed and rng.random() > 0.1
                            row[name], row[f"{name}_valid"] = (
                                (float(value) if valid else None),
                                (None if failed else valid),
                            )
                        rows.append(row)
    return rows


def table_of(rows):
    types = {**dict.fromkeys(KEYS, pa.string()), "seed": pa.int64()}
    names = [
        name
        for name in rows[0]
        if name in types or name in METRICS or name.removesuffix("_valid") in METRICS
    ]
    kinds = {
        name: types.get(name, pa.bool_() if name.endswith("_valid") else pa.float64())
        for name in names
    }
    return pa.table(
        {name: pa.array([row.get(name) for row in rows], kind) for name, kind in kinds.items()}
    )


def by_rows(rows, baseline, bases):
    """Aggregate as the documentation says, with rows in memory."""
    out = {"metrics": {}, "paired": {}, "paired_with_base": {}}
    policies = list(dict.fromkeys(row["policy"] for row in rows))
    for policy in policies:
        mine = [row for row in rows if row["policy"] == policy]
        there = list(dict.fromkeys(row["renderer"] for row in mine))
        chosen = baseline if baseline in there else there[0]
        parts = {
            "metrics": aggregate(mine),
            "paired": paired(mine, chosen) if len(there) > 1 else {},
        }
        parts["paired_with_base"] = base_pairs(mine, chosen if len(there) > 1 else None, bases)
        for block, part in parts.items():
            out[block] |= {
                name if len(policies) == 1 else f"{name}/{policy}": entry
                for name, entry in part.items()
            }
    return out


@pytest.mark.parametrize(
    ("renderers", "policies", "scenes", "seeds"),
    [
        (("clean", "3dgs", "onefixer"), ("lane-camera",), 5, (0, 1, 2)),
        (("clean", "3dgs"), ("lane-camera", "learned"), 8, (7, 2**62)),
        (
            ("zebra", "ant"),
            ("p",),
            1,
            (0, 1, 2, 3),
        ),  # one scene has no interval; names out of order
        (("alone",), ("p",), 4, (0,)),
    ],
)
def test_columns_give_what_rows_give(
    tmp_path,
    renderers,
    policies,
    scenes,
    seeds,
):
    rows = rows_like_a_run(renderers, policies, scenes, seeds, scenes)
    baseline = renderers[-1]
    bases = {"onefixer": "3dgs"}
    wanted = by_rows(rows, baseline, bases)

    def numbers_by_renderer(table):
        found = numbers(table, baseline, bases)
        paired = {block: undecided(getattr(found, block)) for block in PAIRED}
        return {"metrics": found.metrics} | paired

    wanted |= {block: undecided(wanted[block]) for block in PAIRED}
    assert numbers_by_renderer(RolloutTable.of_table(table_of(rows))) == wanted
    pq.write_table(table_of(rows), tmp_path / "rollouts.parquet", row_group_size=5)
    assert numbers_by_renderer(RolloutTable.of_files([tmp_path / "rollouts.parquet"])) == wanted


PAIRED = ("paired", "paired_with_base")


def undecided(table):
    """Return differences without what depends on how many others are tested beside them."""
    open_again = {"p_corrected": None, "verdict": "undecided", "difference": None}
    return {
        variant: {
            name: replace(
                entry, **open_again, more_scenes=None, more_scenes_to_differ=None, note=None
            )
            for name, entry in entries.items()
        }
        for variant, entries in table.items()
    }


def test_several_runs_are_one_table_whatever_metrics_each_has(tmp_path):
    first = rows_like_a_run(("clean", "3dgs"), ("p",), 6, (0, 1), 1)
    second = [
        {**row, "scene": f"other-{row['scene']}"}
        for row in rows_like_a_run(("clean", "3dgs"), ("p",), 5, (0, 1), 2)
    ]
    for row in second:
        del row["offroad"], row["offroad_valid"]
    for name, rows in (("a", first), ("b", second)):
        pq.write_table(table_of(rows), tmp_path / f"{name}.parquet")
    table = RolloutTable.of_files([tmp_path / "a.parquet", tmp_path / "b.parquet"])
    filled = [{"offroad": None, "offroad_valid": False, **row} for row in second]
    wanted = by_rows([*first, *filled], None, {})
    found = numbers(table)
    assert {variant: dict(sorted(entry.items())) for variant, entry in found.metrics.items()} == {
        variant: dict(sorted(entry.items())) for variant, entry in wanted["metrics"].items()
    }
    assert (
        undecided(found.paired)["3dgs"]["progress"]
        == undecided(wanted["paired"])["3dgs"]["progress"]
    )
    failed = [row["failure_class"] for row in (*first, *second) if row["status"] == "failed"]
    assert table.failures() == {name: failed.count(name) for name in failed}
    assert table.n_rollouts == len(first) + len(second)


def test_a_table_without_its_keys_is_refused_by_name(tmp_path):
    pq.write_table(pa.table({"renderer": ["clean"]}), tmp_path / "rollouts.parquet")
    with pytest.raises(InputError, match="no column 'policy'"):
        RolloutTable.of_files([tmp_path / "rollouts.parquet"])


@pytest.mark.parametrize("flag", [bool, np.bool_, float])
def test_rows_of_a_caller_may_be_flat_or_nested_and_hold_flags_of_any_kind(flag):
    cells = [("a", 0, True), ("a", 1, False), ("b", 0, False), ("b", 1, False)]
    keys = {"policy": "p", "scene": "s", "status": "ok"}
    flat = [
        {**keys, "renderer": renderer, "seed": seed, "offroad": flag(value), "offroad_valid": True}
        for renderer, seed, value in cells
    ]
    nested = [
        {
            **keys,
            "renderer": renderer,
            "seed": seed,
            "metrics": {"offroad": {"value": flag(value), "valid": True, "reason": ""}},
        }
        for renderer, seed, value in cells
    ]
    for rows in (flat, nested):
        assert aggregate(rows)["a"]["offroad"].mean == pytest.approx(0.5)
        assert paired(rows, "b")["a"]["offroad"].n_cells == 2
