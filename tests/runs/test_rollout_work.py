"""What a node does for a run, here: it drives a cell from what it is sent, and shares what it
measures with the run's other workers.
"""

from __future__ import annotations

import pickle
from pathlib import Path

from alpasim_plugin.core import cache
from alpasim_plugin.runs.commits import RolloutResult
from alpasim_plugin.runs.executors.assignment import measured_folder
from alpasim_plugin.runs.executors.base import Node
from alpasim_plugin.runs.executors.job import rollout_work
from tests.runs.test_decide import plan_of


def test_workers_of_a_run_on_a_node_share_their_measurements(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("SIMRUN_SCRATCH", str(tmp_path))
    monkeypatch.setenv("SIMRUN_CACHE", str(tmp_path / "cache"))
    plan = plan_of(scenes=1)
    try:
        for run in ("first", "second"):
            work, contents = rollout_work(plan, run, plan.cells[:1], 1, None, "")
            result = pickle.loads(pickle.dumps(work))(plan.cells[0], Node("n1", contents.read))
            assert isinstance(result, RolloutResult)
            assert (result.manifest["status"], result.manifest["node"]) == ("ok", "n1")
            folder = measured_folder(run)
            assert folder is not None
            assert cache._folder == folder
            cache.measured("speed", lambda: {"ms": 1.0})
            assert (folder / "speed.json").exists()
    finally:
        cache.share_measurements(None)
