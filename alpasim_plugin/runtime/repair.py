"""Make a damaged run folder whole: damaged rollouts are run or scored again, tables are made again from the manifests."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.reading import parsing
from alpasim_plugin.io.reading.files import as_shape
from alpasim_plugin.runtime.certificate import Certify
from alpasim_plugin.runtime.check import Inspection, inspect_run
from alpasim_plugin.runtime.contents import CONTENTS, DOING, REPORTS, RUN_INFO, TABLES, write_run_json
from alpasim_plugin.runtime.manifests import read_manifest
from alpasim_plugin.runtime.plan import RunOptions, RunPlan, make_plan, refuse_commands
from alpasim_plugin.runtime.run import Progress, execute_run, finish_run
from alpasim_plugin.runtime.writing import writing
from scenarios.suite import ScenarioRef

REMADE = (*TABLES, CONTENTS, RUN_INFO)
KEPT = ("pool", "determinism", "exit_code", "alpasim")  # members of run.json that the rollouts do not tell
SHOWN = 5


def use_run(root: Path, say: Callable[[str], None]) -> None:
    """Check a run folder before its tables are read; call it before `evaluators.report.run_folder.read_run`.

    Tables that are missing or damaged are made again if every rollout is whole. Damaged rollouts are named; nothing is driven here.

    Args:
        root: The run folder.
        say: Called with one line for each thing that is damaged.

    Raises:
        InputError: The tables cannot be trusted and cannot be made again from what is there.
        InfrastructureError: Another process is writing the folder.
    """
    found = inspect_run(root)
    if found.tables_only:
        say(f"note: {root} has no rollouts, only tables")
    if not found.of_run:
        for one in found.of_rollouts[:SHOWN]:
            say(f"warning: damaged: {root}/{one}; the tables are whole; simrun check {shlex.quote(str(root))} --repair")
        if len(found.of_rollouts) > SHOWN:
            say(f"warning: {len(found.of_rollouts) - SHOWN} more damaged files: simrun check {shlex.quote(str(root))}")
        return
    if not os.access(root, os.W_OK):
        do_this = "copy the folder to where it can be written, and repair the copy: simrun check COPY --repair"
        raise InputError(DOING, str(root), f"{found.of_run[0]}, and the folder is read-only", do_this)
    with writing(root):  # whoever writes it now is named here
        found = inspect_run(root)
        if found.of_run:
            _check_remakable(found)
            for one in found.of_run:
                say(f"warning: damaged: {root}/{one}; made again from the rollouts")
            remake_tables(found)


def _check_remakable(found: Inspection) -> None:
    if found.unfinished:
        there = f"{len(found.cells) - len(found.unfinished)} of {len(found.cells)} rollouts are finished"
        raise InputError(DOING, str(found.root), f"the run is not finished: {there}", f"give its command again: {command_of(found)}")
    if not _remakable(found):
        problem = [*found.of_rollouts, *(one for one in found.of_run if one.file not in REMADE), *found.of_run][0]
        raise InputError(DOING, str(found.root), str(problem), f"simrun check {shlex.quote(str(found.root))} --repair")


def _remakable(found: Inspection) -> bool:
    """Tell whether everything that is damaged can be made again from the rollouts' manifests."""
    of_rollouts = found.of_rollouts or found.unfinished or found.tables_only
    return bool(found.cells) and not of_rollouts and all(one.file in REMADE or one.cell for one in found.of_run)


def remake_tables(found: Inspection) -> None:
    """Write the tables, reports and contents of a run again from its manifests; the caller holds the lock."""
    if any(one.file == RUN_INFO for one in found.damage):
        write_run_json(found.root, found.info)
    manifests = [read_manifest(found.root / cell)[0] for cell in found.cells]
    config = as_shape(dict[str, Any], found.info["config"], f"{found.root / RUN_INFO}, config", DOING, "make the run again")
    lost = {
        "pool": {
            "workers": config.get("workers"),
            "threads_per_worker": config.get("threads_per_worker"),
            "wall_s": None,
            "frames": sum(int(m.get("frames") or 0) for m in manifests),
            "frames_per_s_total": None,
        },
        "determinism": {"status": "skipped", "reason": "the run was stopped before it repeated a rollout"},
    }
    kept = {key: found.info[key] for key in KEPT if key in found.info}
    with parsing(DOING, found.root, "make the run again", "manifests from which no table can be made"):
        finish_run(found.root, manifests, lost | kept, (found.root / REPORTS[0]).exists())


def repair_run(found: Inspection, workers: int | None, progress: Progress, wait: bool = False) -> None:
    """Make a run folder whole; only what is damaged or unfinished is run or scored again.

    Args:
        found: What `inspect_run` found, with every file read.
        workers: Worker processes; None is one per core.
        progress: Shows what is run again.
        wait: Wait for a process that writes the folder; otherwise refuse.

    Raises:
        InputError: The scenario, a part or the version has changed since the run, or the folder is not that of a run.
        InfrastructureError: Another process writes the folder, or it is read-only.
    """
    if _remakable(found):
        with writing(found.root, wait, progress.noticed):
            remake_tables(inspect_run(found.root, full=True))
        return
    if found.info.get("kind") in ("score", "fork", "decide"):
        kinds = {"score": "they are scored logs", "fork": "it is a fork", "decide": "its scenes were drawn one after another"}
        what = kinds[found.info["kind"]]
        raise InputError("repairing a run", str(found.root), f"{found.damage[0]}; {what}", f"give the command again: {command_of(found)}")
    plan = plan_of_run(found.info)
    if plan.content != found.info.get("content"):
        now = "the scenario, a part or the version has changed since the run: new rollouts would not be comparable with the old ones"
        raise InputError("repairing a run", str(found.root), now, f"run everything again: {command_of(found)}")
    skipped = (found.info.get("determinism") or {}).get("status") == "skipped"
    certificate: Certify = "none" if skipped else "one"
    report = (found.root / REPORTS[0]).exists()
    execute_run(plan, found.root, workers, found.info["command"], progress, True, certificate, report, wait=wait, full=True)


def plan_of_run(info: Mapping[str, Any]) -> RunPlan:
    """Plan the run that ``run.json`` describes once more.

    Raises:
        InputError: A scenario or a part is not there any more.
    """
    stated = {f.name: info["config"][f.name] for f in fields(RunOptions) if f.name in info["config"]}
    options = RunOptions(**stated | {key: tuple(stated.get(key) or ()) for key in ("fixer", "evaluators")})
    refs = []
    for name, scene in info["scenes"].items():
        ref = scene.get("ref")
        if not isinstance(ref, dict) or not isinstance(ref.get("path"), str):
            raise InputError("repairing a run", RUN_INFO, f"it has no path of the scenario {name}", "give the command of the run again")
        refs.append(ScenarioRef(ref["path"], ref.get("seed"), tuple(ref.get("overrides") or ()), ref.get("source")))
    refuse_commands(info["policies"], "repairing a run", RUN_INFO)
    plan = make_plan(refs, info["renderers"], info["policies"], info["seeds"], options)
    return replace(plan, asked=tuple(info.get("asked") or ()))


def command_of(found: Inspection) -> str:
    """Return the command that made a run, to be typed."""
    return shlex.join(found.info["command"])
