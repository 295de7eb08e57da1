"""Read a run that goes on, or was stopped: the rollouts that have finished so far. A manifest is written last, so what has one is whole."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa

from alpasim_plugin.runtime.check import planned_cells
from alpasim_plugin.runtime.contents import CONTENTS, read_run_json
from alpasim_plugin.runtime.manifests import inspect_rollout
from alpasim_plugin.runtime.store import rollouts_schema
from alpasim_plugin.runtime.tables import rollout_rows
from alpasim_plugin.viewer.so_far import RunSoFar
from evaluators.metrics import declare_from
from evaluators.report.run_folder import Run, read_run, rollouts_of_table


def read_so_far(root: Path) -> RunSoFar:
    """Read a run folder that may still be written.

    Raises:
        InputError: It holds no run, or its description or its tables are damaged.
    """
    if (root / CONTENTS).exists():
        run = read_run(root)
        return RunSoFar(run, len(run.rollouts), (), True)
    info = read_run_json(root)
    declare_from(info)
    cells = planned_cells(info)
    states = [inspect_rollout(root, cell) for cell in cells]
    manifests = [state.manifest for state in states if state.manifest is not None and not state.damage]
    names = list(dict.fromkeys(name for manifest in manifests for name in manifest.get("metrics", {})))
    rollouts, metrics = rollouts_of_table(pa.Table.from_pylist(rollout_rows(manifests), schema=rollouts_schema(names)))
    damage = tuple(str(one) for state in states for one in state.damage)
    return RunSoFar(Run(root, info, {}, rollouts, metrics), len(cells), damage, False)
