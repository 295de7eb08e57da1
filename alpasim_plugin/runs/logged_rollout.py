"""Find a finished rollout of an earlier run by name, with everything needed to replay it."""

import difflib
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.parts import overrides_of, require_installed, resolve_renderer
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.log.run_folder.manifests import inspect_rollout, read_run_json
from alpasim_plugin.log.run_folder.reader import Run
from alpasim_plugin.log.run_folder.records import Manifest, RunConfig
from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.log.run_folder.schema import RUN_INFO, cell_name
from alpasim_plugin.runs.plan import Cell, RunOptions, make_plan, options_of, ref_of


@dataclass(frozen=True)
class LoggedRollout:
    """A finished rollout of an earlier run."""

    root: Path  # of the run
    cell: Cell
    options: RunOptions
    scenario: Scenario
    manifest: Manifest

    @property
    def folder(self) -> Path:
        """Give the folder with its log."""
        return self.root / self.manifest.path

    @property
    def name(self) -> str:
        """Give the name by which `find_rollout` finds it."""
        return cell_name(*self.cell.names.values())

    def check_repeatable(self) -> None:
        """Refuse a rollout that cannot be replayed.

        Raises:
            InputError: Its latency is measured.
        """
        if self.scenario.latency.kind == "measured":
            raise InputError(
                f"{self.name}: its latency is measured: the delay of its plans depended on the machine",
                "run it with --set latency.kind=fixed",
            )


def find_rollout(root: Path, name: str, named: Collection[str | None] = ()) -> LoggedRollout:
    """Find a finished rollout in a run folder and load its scenario and parts.

    Args:
        root: Run folder.
        name: ``RENDERER/POLICY/SCENE/SEED`` as in the tables, or the rollout's folder below the run
            folder.
        named: Parts that are not installed and that the user has named too: others are not made.

    Raises:
        InputError: No such rollout, it did not finish, its scenario or its parts have changed, or
            it was driven with a part that is neither installed nor named.
    """
    row = named_rollout(Run.read(root).rollouts, name)
    manifest = _finished_manifest(root, name, row)
    info = read_run_json(root)
    stated = info.scenes.get(row.scene)
    if stated is None or stated.ref is None or not isinstance(info.config, RunConfig):
        raise InputError(
            f"{root / RUN_INFO}: no path of the scenario {row.scene!r}",
            "Drive the rollout again with simrun run.",
        )
    ref = ref_of(stated.ref)
    options = replace(options_of(info.config), baseline=None, video="none")
    own_parts = (row.renderer, row.policy, ref.source, options.controller)
    require_installed([*own_parts, *options.evaluators], root / RUN_INFO, named)
    plan = make_plan(
        [ref], [row.renderer], [row.policy], [row.seed], _with_own_settings(options, row.renderer)
    )
    (cell,) = plan.cells
    scenario = plan.scenarios.get(row.scene)
    difference = ""
    if cell.rollout_key != manifest.rollout_key:
        difference = "content key differs"
    if scenario is None:
        difference = f"scenario {ref.path} now has the scene id {cell.scene!r}"
    if scenario is None or difference:
        raise InputError(
            f"{name}: {difference}: the scenario, a part or the version has changed since the log was written",
            "Run the rollout again.",
        )
    return LoggedRollout(root, cell, options, scenario, manifest)


def _finished_manifest(root: Path, name: str, row: Rollout) -> Manifest:
    """Return the manifest of a rollout that is whole, and no continuation of another one.

    Raises:
        InputError: It is not so.
    """
    if not row.ok:
        raise InputError(
            f"{name}: the rollout did not finish: {row.failure}", "Name a finished rollout."
        )
    state = inspect_rollout(root, row.path, full=True)
    if state.damage or state.manifest is None:
        problems = "; ".join(f"{damage.file}: {damage.problem}" for damage in state.damage)
        raise InputError(
            f"{name}: {problems or 'unfinished'}",
            "Give the command of the run again: it drives this rollout.",
        )
    if state.manifest.fork is not None:
        raise InputError(
            f"{name}: it is the continuation of another rollout",
            f"name that rollout: {state.manifest.fork.of}",
        )
    return state.manifest


def _with_own_settings(options: RunOptions, renderer: str) -> RunOptions:
    """Return the options with those settings of fixers that are for a renderer: others may belong
    to another renderer of the run, and a plan refuses settings without a fixer.
    """
    has_fixer = resolve_renderer(renderer, options.fixer).fixer is not None
    return replace(options, fixer=overrides_of(renderer, options.fixer) if has_fixer else ())


def named_rollout(rollouts: Sequence[Rollout], name: str) -> Rollout:
    """Return a rollout of a run by its name or its folder; of several logs of one cell by its
    folder, or by the cell's name and the log's.

    Raises:
        InputError: The run has no such rollout, or several logs of that name.
    """
    wanted = name.strip("/").removeprefix("rollouts/")
    matches = [row for row in rollouts if wanted in _names_of(row)]
    if len(matches) > 1:
        logs = [row.path.removeprefix("rollouts/") for row in matches]
        raise InputError(
            f"{name}: the run has {len(matches)} logs of it",
            f"Name one: {', '.join(logs[:MOST_LOGS])}{', ...' if len(logs) > MOST_LOGS else ''}",
        )
    if not matches:
        names = dict.fromkeys(cell_name(*row.cell) for row in rollouts)
        near = difflib.get_close_matches(wanted, names, 3, 0.0)
        do_this = f"Did you mean {' or '.join(near)}?" if near else "Name a run that has rollouts."
        raise InputError(f"{name}: the run has no such rollout among its {len(rollouts)}", do_this)
    return matches[0]


MOST_LOGS = 4  # that an error names


def _names_of(row: Rollout) -> set[str]:
    """Return what a rollout can be called: its cell, its folder, and its cell and log."""
    cell = cell_name(*row.cell)
    names = {cell, row.path.removeprefix("rollouts/")}
    return names | {f"{cell}/{row.log}"} if row.log else names
