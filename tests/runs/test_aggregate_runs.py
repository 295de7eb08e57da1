"""Several runs aggregated as one: parts of a night give what the whole night gives."""

from dataclasses import replace

import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.runs.summary import aggregate_runs
from evaluators.results import read_summary
from tests.runs.make_many import SCENES, Many, make_one


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """Make a run, and the same rollouts in two runs of three scenes."""
    root = tmp_path_factory.mktemp("night")
    whole = Many("whole", shift_m={"onefixer": 0.4})
    make_one(root, whole)
    table = pq.read_table(root / "whole" / "rollouts.parquet")
    names = list(SCENES)
    for name, mine in (("part-1", names[:3]), ("part-2", names[3:])):
        part = make_one(
            root, replace(whole, name=name, scenes={scene: SCENES[scene] for scene in mine})
        )
        pq.write_table(table.filter(pc.field("scene").isin(mine)), part / "rollouts.parquet")
    return root


def test_the_parts_of_a_night_give_the_numbers_of_the_whole(night):
    whole = aggregate_runs([night / "whole"])
    # All six scenes differ by exactly 0.4 m: there is no spread to go by.
    assert whole.paired["onefixer"]["lateral_distance_m"].verdict == "undecided"
    parts = aggregate_runs([night / "part-1", night / "part-2"])
    for block in ("preset", "paired", "failures"):
        assert getattr(parts, block) == getattr(whole, block)
    # As a run of all rollouts wrote it.
    stored = read_summary(night / "whole" / "summary.json", "").metrics
    assert parts.metrics == whole.metrics == stored


def test_runs_that_do_not_belong_together_are_refused(night, tmp_path):
    changed = make_one(tmp_path, Many("changed", scenes={**SCENES, "smoke-curve": "ff" * 32}))
    with pytest.raises(InputError):
        aggregate_runs([night / "whole", changed])
    strict = make_one(tmp_path, Many("strict", preset="strict"))
    with pytest.raises(InputError):
        aggregate_runs([night / "whole", strict])
    with pytest.raises(InputError):
        aggregate_runs([night / "whole", night / "." / "whole"])
    with pytest.raises(InputError):
        aggregate_runs([night / "whole"], "3dgs")
    (strict / "summary.json").unlink()
    with pytest.raises(InputError):
        aggregate_runs([strict])
