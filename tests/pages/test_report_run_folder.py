import json
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.run_folder.rows import series_by_rollout
from evaluators.statistics.opening import read_run


def test_reads_every_rollout_with_its_key(usual_run):
    run = read_run(usual_run)
    assert len(run.rollouts) == len({r.cell for r in run.rollouts}) == 3 * 2 * 4 * 3
    assert run.renderers == ["clean", "3dgs", "onefixer"]
    assert sum(not r.ok for r in run.rollouts) == 4  # both policies of two cells


def test_invalid_metric_is_none_even_where_a_number_stands(usual_run, tmp_path):
    shutil.copytree(usual_run, tmp_path / "run", ignore=shutil.ignore_patterns("rollouts"))
    table = pq.read_table(usual_run / "rollouts.parquet")
    zeros = pa.array(np.zeros(table.num_rows))
    no = pa.array(np.zeros(table.num_rows, dtype=bool))
    table = table.set_column(table.column_names.index("offroad"), "offroad", zeros)
    table = table.set_column(table.column_names.index("offroad_valid"), "offroad_valid", no)
    pq.write_table(table, tmp_path / "run" / "rollouts.parquet")
    assert all(r.metrics["offroad"] is None for r in read_run(tmp_path / "run").rollouts)


def test_summary_key_with_policy_stands_for_that_policy_only(usual_run):
    run = read_run(usual_run)
    assert len(run.rollouts_of("3dgs")) == 24
    assert {r.policy for r in run.rollouts_of("3dgs/lane-camera")} == {"lane-camera"}
    assert (
        len(run.rollouts_of("3dgs | lane-camera")) == 0
    )  # an unknown way of joining matches nothing rather than something


@pytest.mark.parametrize("path", ["../outside", "/etc", "rollouts/../../outside", ""])
def test_paths_that_leave_the_run_folder_are_not_followed(tmp_path, usual_run, path):
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "strip.jpg").write_bytes(b"secret")
    shutil.copytree(usual_run, tmp_path / "run", ignore=shutil.ignore_patterns("rollouts"))
    (tmp_path / "run" / "rollouts").mkdir()
    table = pq.read_table(usual_run / "rollouts.parquet")
    table = table.set_column(
        table.column_names.index("path"), "path", pa.array([path] * table.num_rows)
    )
    pq.write_table(table, tmp_path / "run" / "rollouts.parquet")
    run = read_run(tmp_path / "run")
    assert run.file_of(run.rollouts[0], "strip.jpg") is None
    assert run.href(run.rollouts[0]) is None


@pytest.mark.parametrize(
    ("break_it", "found"),
    [
        (lambda run: (run / "run.json").unlink(), "no such file"),
        (lambda run: (run / "summary.json").write_text('{"metrics": '), "broken JSON"),
        (lambda run: (run / "summary.json").write_text("[1]"), "the document: a list of 1"),
        (lambda run: (run / "rollouts.parquet").unlink(), "no such file"),
        (lambda run: (run / "rollouts.parquet").write_bytes(b"PAR1"), "no readable parquet"),
        (
            lambda run: pq.write_table(pa.table({"renderer": ["a"]}), run / "rollouts.parquet"),
            "no column 'policy'",
        ),
    ],
)
def test_broken_folder_is_a_four_part_error(tmp_path, usual_run, break_it, found):  # type: ignore[no-untyped-def]
    shutil.copytree(usual_run, tmp_path / "run", ignore=shutil.ignore_patterns("rollouts"))
    break_it(tmp_path / "run")
    with pytest.raises(InputError) as caught:
        read_run(tmp_path / "run")
    assert found in caught.value.message
    assert str(tmp_path) in caught.value.message
    assert caught.value.hint


def test_reasons_come_from_the_steps_where_the_summary_has_no_ledger(tmp_path, usual_run):
    shutil.copytree(usual_run, tmp_path / "run", ignore=shutil.ignore_patterns("rollouts"))
    summary = json.loads((usual_run / "summary.json").read_text())
    (tmp_path / "run" / "summary.json").write_text(json.dumps(summary | {"censoring": {}}))
    expected = "no other road user within 50 m"
    for folder in (usual_run, tmp_path / "run"):
        assert read_run(folder).invalid_reasons["clean", "min_distance_to_obstacle_m"] == expected


rows = st.lists(
    st.fixed_dictionaries(
        {
            "renderer": st.sampled_from("ab"),
            "policy": st.sampled_from(["p", "p/q"]),
            "scene": st.sampled_from(["s", "t", "s/t"]),
            "seed": st.sampled_from([0, 1, -3, 2**60]),
            "rollout": st.sampled_from(["", "log 1", "log 2"]),
            "metric": st.sampled_from("mn"),
            "t_us": st.integers(-(10**15), 10**15),
            "value": st.floats(-1e9, 1e9),
            "valid": st.booleans(),
        }
    ),
    max_size=40,
    unique_by=lambda row: (
        row["renderer"],
        row["policy"],
        row["scene"],
        row["seed"],
        row["rollout"],
        row["metric"],
        row["t_us"],
    ),
)


@given(rows, st.booleans())
@settings(deadline=None)
def test_series_agree_with_a_plain_loop(made, coded):  # type: ignore[type-arg]
    slow = {}  # type: ignore[type-arg]
    for row in sorted(made, key=lambda r: r["t_us"]):
        if row["valid"]:
            cell = tuple(row[name] for name in ("renderer", "policy", "scene", "seed", "rollout"))
            slow.setdefault(cell, {}).setdefault(row["metric"], []).append(
                (row["t_us"], row["value"])
            )
    names = ["renderer", "policy", "scene", "rollout", "metric", "seed", "t_us", "value", "valid"]
    types = [pa.string()] * 5 + [pa.int64(), pa.int64(), pa.float64(), pa.bool_()]
    table = pa.Table.from_pylist(made, schema=pa.schema(list(zip(names, types, strict=True))))
    if coded:
        for name in ("renderer", "policy", "scene", "rollout", "metric"):
            table = table.set_column(
                table.column_names.index(name), name, table[name].dictionary_encode()
            )
    fast = {
        cell: {
            metric: list(zip(t.tolist(), v.tolist(), strict=True))
            for metric, (t, v) in series.items()
        }
        for cell, series in series_by_rollout(table).items()
    }
    assert fast == slow
