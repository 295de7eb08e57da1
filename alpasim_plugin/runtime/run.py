"""A whole run: execute, tabulate, report. The same command continues an interrupted run."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from alpasim_plugin.atomic import write_json
from alpasim_plugin.errors import InputError
from alpasim_plugin.renderers.reconstruction_key import model_key
from alpasim_plugin.runtime.certificate import Certify, certify
from alpasim_plugin.runtime.execute import Threads, execute, thread_budget
from alpasim_plugin.runtime.plan import RunPlan, slug
from alpasim_plugin.runtime.provenance import hardware, versions
from alpasim_plugin.runtime.reports import write_reports
from alpasim_plugin.runtime.scene_dump import scene_as_json
from alpasim_plugin.runtime.store import read_json
from alpasim_plugin.runtime.tables import write_tables
from evaluators.aggregate.outcome import Outcome, outcome_of_failures
from evaluators.metrics import declared

SCHEMA_VERSION = 1


class Progress(Protocol):
    """Shows a run to a person or a log file."""

    def started(self, plan: RunPlan, root: Path, threads: Threads) -> None:
        """Announce the run."""
        ...

    def rollout_done(self, manifest: dict[str, Any], reused: bool) -> None:
        """Announce one rollout."""
        ...


@dataclass(frozen=True)
class RunResult:
    """Result of a run."""

    root: Path
    summary: dict[str, Any]
    n_rollouts: int
    n_failed: int

    @property
    def outcome(self) -> Outcome:
        """Give the outcome: failures of rollouts and of their scoring. Gates add criteria to it."""
        return outcome_of_failures(self.summary["failures"])

    @property
    def exit_code(self) -> int:
        """Give the process exit code that docs/cli.md lists."""
        return self.outcome.exit_code


def default_folder(plan: RunPlan) -> Path:
    """Return the default run folder; it depends on the command alone."""
    first = next(iter(plan.scenarios))
    more = f"-and-{len(plan.scenarios) - 1}-more" if len(plan.scenarios) > 1 else ""
    return Path("runs", f"{slug(first)}{more}-{plan.command_key}")


def execute_run(
    plan: RunPlan,
    root: Path,
    workers: int | None,
    command: Sequence[str],
    progress: Progress,
    resume: bool = False,
    certificate: Certify = "one",
    report: bool = True,
) -> RunResult:
    """Run a plan into a folder, and repeat one of its rollouts as the certificate says.

    Without ``report`` there is no ``report.html``; `write_reports` makes it later.

    Raises:
        InputError: The folder holds the run of another command and ``resume`` is not set.
    """
    threads = thread_budget(workers, len(plan.cells))
    _claim(root, plan, command, threads, resume)
    progress.started(plan, root, threads)
    manifests: list[dict[str, Any]] = []
    began = time.perf_counter()

    def on_done(manifest: dict[str, Any], reused: bool) -> None:
        manifest["reused"] = reused
        progress.rollout_done(manifest, reused)

    manifests = execute(plan, root, threads, on_done, resume)
    wall_s = time.perf_counter() - began
    tables = root / "summary.json"
    held = read_json(tables).get("determinism") if tables.exists() else None
    summary = write_tables(root, manifests, plan.options.preset, plan.options.baseline, threads, wall_s)
    determinism = certify(plan, root, manifests, threads.workers * threads.per_worker, certificate, held)
    summary["determinism"] = determinism
    write_json(tables, summary)
    write_json(root / "run.json", read_json(root / "run.json") | {"determinism": determinism})
    write_reports(root, page=report)
    return RunResult(root, summary, len(manifests), summary["failures"]["n_failed"])


def _claim(root: Path, plan: RunPlan, command: Sequence[str], threads: Threads, resume: bool) -> None:
    """Write run.json, or check that the folder holds this run; changed parts are written again."""
    path = root / "run.json"
    if path.exists():
        held = read_json(path)
        if held.get("key") != plan.command_key and not resume:
            raise InputError(
                "starting a run",
                f"folder {root}",
                f"it holds another run (key {held.get('key')}; this command has {plan.command_key})",
                "choose another --out, or pass --resume to reuse its matching rollouts and replace its tables",
            )
        if held.get("content") == plan.content:
            return
    write_run_info(root, plan, command, threads)


def write_run_info(root: Path, plan: RunPlan, command: Sequence[str], threads: Threads) -> None:
    """Write ``run.json`` and the scene files of the report."""
    for scene_id, scenario in plan.scenarios.items():
        write_json(root / "scenes" / f"{slug(scene_id)}.json", scene_as_json(scenario))
    refs = {cell.scene: cell.ref for cell in plan.cells}
    parts = plan.parts
    write_json(
        root / "run.json",
        {
            "schema_version": SCHEMA_VERSION,
            "key": plan.command_key,
            "content": plan.content,
            "command": list(command),
            "version": versions()["alpasim-onefixer"],
            "started_at": datetime.now(UTC).isoformat(timespec="seconds"),
            "config": asdict(plan.options) | {"workers": threads.workers, "threads_per_worker": threads.per_worker},
            "preset": plan.options.preset,
            "renderers": [spec.name for spec in plan.renderers],
            "policies": [spec.name for spec in plan.policies],
            "seeds": list(plan.seeds),
            "scenes": {
                name: {
                    "source": s.source,
                    "ref": {
                        "path": str(Path(refs[name].path).absolute()),
                        "seed": refs[name].seed,
                        "overrides": refs[name].overrides,
                        "source": refs[name].source,
                    },
                    "content_hash": s.content_hash,
                    "seed": s.seed,
                    "duration_s": (s.end_us - s.start_us) * 1e-6,
                    "rates": asdict(s.rates),
                    "latency": asdict(s.latency),
                    "degradation": asdict(s.degradation),
                    "reconstruction": model_key(s),
                    "notes": list(s.notes),
                }
                for name, s in plan.scenarios.items()
            },
            "fixers": {spec.name: spec.fixer.as_dict() for spec in plan.renderers if spec.fixer is not None},
            "parts": {f"{part.kind} {part.name}": part.as_dict() for part in parts},
            "metrics": declared(),
            "weights": {file: sha for part in parts for file, sha in part.files.items()},
            "hardware": hardware(),
            "versions": versions(),
            "left_out": sorted({note for s in plan.scenarios.values() for note in s.notes}),
        },
    )
