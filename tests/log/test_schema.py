"""The tables and files of a run folder are what the schema says: in the writer, in the reader, and
on the pages.
"""

import json
import re
import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.run_folder.schema import (
    ROLLOUTS_TABLE,
    STEPS_TABLE,
    cell_name,
    rollout_folder,
)
from alpasim_plugin.log.run_folder.sides import RolloutTable
from evaluators.statistics.opening import Run, read_run
from tests.core.checksum_files import vouch_for

DOCS = Path(__file__).resolve().parents[2] / "docs"
ROW = {
    "renderer": "clean",
    "policy": "p",
    "scene": "s",
    "seed": 0,
    "status": "ok",
    "path": "rollouts/x",
    "wall_s": 1.0,
    "frames": 3,
}
ROWS = [ROW | {"offroad": 0.0, "offroad_valid": True, "seed": seed} for seed in range(3)]


def changed(column, values):
    """Return the rows with other values of a column."""
    table = pa.Table.from_pylist(ROWS)
    return table.set_column(table.column_names.index(column), column, pa.array(values))


@pytest.mark.parametrize(
    "table",
    [
        changed("offroad", ["a", "b", "c"]),
        changed("offroad_valid", [1, 1, 1]),
        changed("frames", ["3", "3", "3"]),
        changed("path", [1, 2, 3]),
        pa.Table.from_pylist(ROWS).drop(["scene"]),
        pa.Table.from_pylist(ROWS).drop(["offroad"]),
    ],
)
def test_a_table_that_is_not_as_the_schema_says_is_refused_by_file_and_column(
    tmp_path, usual_run, table
):
    for name in ("run.json", "summary.json"):
        shutil.copy(usual_run / name, tmp_path)
    path = tmp_path / "rollouts.parquet"
    pq.write_table(table, path, row_group_size=2)
    for read in (read_run, lambda folder: RolloutTable.of_files([folder / "rollouts.parquet"])):
        with pytest.raises(InputError) as caught:
            read(tmp_path)
        assert caught.value.message.startswith(str(path))


def test_manifests_that_lack_a_member_are_damaged_rollouts_of_an_unfinished_run(
    tmp_path, usual_run
):
    run = vouch_for(shutil.copytree(usual_run, tmp_path / "run"))
    (run / "summary.json").unlink()
    for path in run.rglob("manifest.json"):
        held = json.loads(path.read_text())
        others = {key: value for key, value in held.items() if key not in ("wall_s", "sha256")}
        path.write_text(json.dumps(others))
    unfinished = Run.read_so_far(run)
    assert len(unfinished.rollouts) == 0
    assert len(unfinished.damage) == unfinished.planned > 0
    assert all(line.endswith("manifest.json: wall_s: missing") for line in unfinished.damage)


def test_what_the_schema_writes_it_also_reads(tmp_path):
    made = pa.Table.from_pylist(ROWS, schema=ROLLOUTS_TABLE.arrow(["offroad"], of_logs=True))
    pq.write_table(made, tmp_path / "rollouts.parquet")
    assert ROLLOUTS_TABLE.read(tmp_path / "rollouts.parquet").equals(made)


@pytest.mark.parametrize("table", [ROLLOUTS_TABLE, STEPS_TABLE])
def test_the_page_of_tables_names_every_column_in_its_order_with_its_type(
    table,
):
    page = (DOCS / "runs.md").read_text()
    (line,) = [line for line in page.splitlines() if line.startswith(f"| `{table.name}` |")]
    assert "`rollout`" in page
    # Names of one kind stand together, followed by the kind in brackets.
    words = re.findall(r"`(\w+)`|\((text|integer|number|boolean)\)", line)
    kinds = {}
    waiting = []
    for name, kind in words:
        if name:
            waiting.append(name)
        else:
            kinds |= dict.fromkeys(waiting, {"boolean": "flag"}.get(kind, kind))
            waiting = []
    wanted = {column.name: column.kind for column in table.columns if not column.of_logs}
    documented = {name: kind for name, kind in kinds.items() if name in wanted}
    assert documented == wanted
    assert list(documented) == list(wanted)


def test_a_rollout_has_one_folder_and_one_name():
    assert rollout_folder("nre://host:50051", "p", "a/b", 3).parts[0] == "rollouts"
    assert len(rollout_folder("nre://host:50051", "p", "a/b", 3).parts) == 5
    assert rollout_folder("r", "p", "s", "log 1") != rollout_folder("r", "p", "s", "log-1")
    assert cell_name("r", "p", "s", 3) == "r/p/s/3"
