"""The oracle of the crash harness: what a run folder must be, whatever happened to the processes
that wrote it.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from alpasim_plugin.log.run_folder.check import inspect_run
from alpasim_plugin.log.run_folder.manifests import inspect_rollout

# Members of summary.json that say how long something took, or how it was run.
OF_THE_MACHINE = ("speed", "pool")


@dataclass(frozen=True)
class Scene:
    """The run that is killed: 2 renderers x 1 policy x 1 scene x ``seeds`` seeds, a fraction of a
    second each.
    """

    seeds: int = 2
    workers: int = 2

    def arguments(self, root: Path) -> list[str]:
        """Return the command line of the run into a folder."""
        what = [
            "run",
            "--renderer",
            "clean,broken-black",
            "--policy",
            "constant-velocity",
            "--seeds",
            str(self.seeds),
        ]
        short = [
            "--set",
            "timing.duration_us=600000",
            "--images",
            "none",
            "--workers",
            str(self.workers),
        ]
        return [*what, *short, "--out", str(root), "smoke/straight"]


def comparable(root: Path) -> dict[str, Any]:
    """Return everything of a run that must not depend on how often it was interrupted."""
    rows = pq.read_table(root / "rollouts.parquet").drop_columns(["wall_s"]).to_pylist()
    summary = {
        k: v
        for k, v in json.loads((root / "summary.json").read_text()).items()
        if k not in OF_THE_MACHINE
    }
    logs = {
        str(p.relative_to(root)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(root.rglob("rollout.asl"))
    }
    return {
        "rows": repr(rows),
        "steps": repr(pq.read_table(root / "steps.parquet").to_pylist()),
        "logs": logs,
        "summary": summary,
    }


def finished(root: Path) -> dict[str, int]:
    """Return the rollouts that are whole, with the time at which each manifest was written."""
    found = {}
    for path in root.rglob("manifest.json"):
        cell = path.parent.relative_to(root)
        if cell.parts[0] != "rollouts":
            continue
        state = inspect_rollout(root, cell.as_posix(), full=True)
        if state.manifest is not None and not state.damage and state.manifest["status"] == "ok":
            found[cell.as_posix()] = path.stat().st_mtime_ns
    return found


def problems_after_finish(root: Path, expected: dict[str, Any], kept: dict[str, int]) -> list[str]:
    """Say what is wrong with a finished run folder; nothing if it equals the undisturbed run.

    Args:
        root: The run folder.
        expected: `comparable` of the undisturbed run.
        kept: Rollouts that were whole before the last command: they must not have been driven
            again.
    """
    found = inspect_run(root, full=True)
    problems = [str(one) for one in found.damage] + [
        f"{cell}: unfinished" for cell in found.unfinished
    ]
    if problems:
        return problems
    now = comparable(root)
    problems += [
        f"{name} differ from the undisturbed run"
        for name, value in expected.items()
        if now[name] != value
    ]
    times = finished(root)
    problems += [
        f"{cell} was driven twice" for cell, at_ns in kept.items() if times.get(cell) != at_ns
    ]
    problems += [f"{path.relative_to(root)} was left behind" for path in left_overs(root)]
    return problems


def left_overs(root: Path) -> list[Path]:
    """Return temporary files and folders."""
    return [
        Path(at) / name
        for at, folders, files in os.walk(root)
        for name in [*folders, *files]
        if name.endswith((".tmp", ".part"))
    ]
