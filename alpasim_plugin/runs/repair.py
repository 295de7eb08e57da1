"""Make a damaged run folder whole: damaged rollouts are run or scored again, tables are made again
from the manifests.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.reading import parsing
from alpasim_plugin.log.run_folder.check import (
    Inspection,
    command_of,
    inspect_run,
    prepare_reading,
    restore_run,
)
from alpasim_plugin.log.run_folder.schema import REPORTS, RUN_INFO
from alpasim_plugin.log.run_folder.writer import writing

if (
    TYPE_CHECKING
):  # whoever only reads a run loads neither the loop nor its kernels, unless the run is damaged
    from alpasim_plugin.runs.certificate import Certify
    from alpasim_plugin.runs.plan import RunPlan
    from alpasim_plugin.runs.run import Progress


def use_run(root: Path, say: Callable[[str], None]) -> None:
    """Check a run folder before its tables are read; see
    `alpasim_plugin.log.run_folder.check.prepare_reading`.
    """
    prepare_reading(root, say, remake_tables)


def remake_tables(found: Inspection) -> None:
    """Write the tables, reports and contents of a run again from its manifests; the caller holds
    the lock.
    """
    manifests, more = restore_run(found)
    from alpasim_plugin.runs.run import finish_run

    with parsing(found.root, "make the run again", "manifests from which no table can be made"):
        finish_run(found.root, manifests, more, (found.root / REPORTS[0]).exists())


def repair_run(
    found: Inspection, workers: int | None, progress: Progress, wait: bool = False
) -> None:
    """Make a run folder whole; only what is damaged or unfinished is run or scored again.

    Args:
        found: What `inspect_run` found, with every file read.
        workers: Worker processes; None is one per core.
        progress: Shows what is run again.
        wait: Wait for a process that writes the folder; otherwise refuse.

    Raises:
        InputError: The scenario, a part or the version has changed since the run, or the folder is
            not that of a run.
        InfrastructureError: Another process writes the folder, or it is read-only.
    """
    from alpasim_plugin.runs.run import execute_run

    if found.is_remakable:
        with writing(found.root, wait, progress.noticed):
            remake_tables(inspect_run(found.root, full=True))
        return
    if found.info.get("kind") in ("score", "fork", "decide"):
        kinds = {
            "score": "they are scored logs",
            "fork": "it is a fork",
            "decide": "its scenes were drawn one after another",
        }
        what = kinds[found.info["kind"]]
        raise InputError(
            f"{found.root}: {found.damage[0]}; {what}",
            f"give the command again: {command_of(found)}",
        )
    plan = plan_of_run(found.info)
    if plan.content != found.info.get("content"):
        raise InputError(
            f"{found.root}: the scenario, a part or the version has changed since the run: new rollouts would not be comparable with the old ones",
            f"run everything again: {command_of(found)}",
        )
    before = found.info.get("determinism") or {}
    certificate: Certify = (
        "none" if before.get("status") == "skipped" and "error" not in before else "one"
    )
    report = (found.root / REPORTS[0]).exists()
    execute_run(
        plan,
        found.root,
        workers,
        found.info["command"],
        progress,
        True,
        certificate,
        report,
        wait=wait,
        full=True,
    )


def plan_of_run(info: Mapping[str, Any]) -> RunPlan:
    """Plan the run that ``run.json`` describes once more.

    Raises:
        InputError: A scenario or a part is not there any more.
    """
    from alpasim_plugin.runs.plan import make_plan, options_of, ref_of, refuse_commands

    refs = []
    for name, scene in info["scenes"].items():
        ref = scene.get("ref")
        if not isinstance(ref, dict) or not isinstance(ref.get("path"), str):
            raise InputError(
                f"{RUN_INFO}: it has no path of the scenario {name}",
                "give the command of the run again",
            )
        refs.append(ref_of(ref))
    refuse_commands(info["policies"], RUN_INFO)
    plan = make_plan(refs, info["renderers"], info["policies"], info["seeds"], options_of(info))
    return replace(plan, asked=tuple(info.get("asked") or ()))
