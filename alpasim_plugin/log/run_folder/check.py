"""Compare a run folder with the digests in its manifests; nothing is written here."""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import inside
from alpasim_plugin.log.run_folder.checksums import problem_of, stated_files
from alpasim_plugin.log.run_folder.manifests import Damage, inspect_rollout, read_run_json
from alpasim_plugin.log.run_folder.records import Manifest, RunInfo
from alpasim_plugin.log.run_folder.schema import (
    FILES,
    ROLLOUTS_FOLDER,
    RUN_INFO,
    TABLES,
    rollout_folder,
)


@dataclass(frozen=True)
class Inspection:
    """The state of a run folder.

    Attributes:
        cells: Folders of all rollouts of the run, in the order of the tables.
        manifests: Those of the finished rollouts, in the same order.
        damage: Damaged or missing files.
        unfinished: Folders of rollouts without a manifest.
        tables_only: The folder was copied without its rollouts.
    """

    cells: tuple[str, ...]
    manifests: tuple[Manifest, ...]
    damage: tuple[Damage, ...]
    unfinished: tuple[str, ...]
    tables_only: bool = False


def inspect_run(root: Path, full: bool = False) -> Inspection:
    """Compare the rollouts of a run folder with their manifests.

    Args:
        root: The run folder.
        full: Read every file, even where size and time are as stated.

    Raises:
        InputError: The folder holds no run, or its ``run.json`` is damaged.
    """
    cells = cells_of_run(read_run_json(root))
    if not os.path.exists(root / ROLLOUTS_FOLDER):
        return Inspection(cells, (), (), (), tables_only=True)
    manifests = []
    damage: list[Damage] = []
    unfinished = []
    for cell in cells:
        state = inspect_rollout(root, cell, full)
        damage += state.damage
        if state.manifest is not None:
            manifests.append(state.manifest)
        elif not state.damage:
            unfinished.append(cell)
    return Inspection(cells, tuple(manifests), tuple(damage), tuple(unfinished))


def inspect_files(root: Path) -> list[Damage]:
    """Compare the files of a run folder outside of its rollouts' folders with ``files.json``, which
    is written last. Each is read in full: every number that a verb prints comes from them.
    """
    try:
        stated = stated_files(root)
    except InputError as error:
        return [Damage("", FILES, error.message), *_without_digest(TABLES)]
    damage = _without_digest(name for name in (RUN_INFO, *TABLES) if name not in stated)
    for name, facts in stated.items():
        path = inside(root, name)
        problem = "not in the run folder" if path is None else problem_of(path, facts, full=True)
        if problem is not None:
            damage.append(Damage("", name, problem))
    return damage


def _without_digest(names: Iterable[str]) -> list[Damage]:
    return [Damage("", name, f"{FILES} holds no digest of it") for name in names]


def cells_of_run(info: RunInfo) -> tuple[str, ...]:
    """Return the folders of a run's rollouts, in the order of the tables.

    ``run.json`` lists them where they do not follow from its scenes, renderers, policies and seeds:
    scored logs, and a run that stopped when it was decided.
    """
    if info.rollouts is not None:
        return info.rollouts
    if info.is_of_logs:
        return ()
    return tuple(
        rollout_folder(renderer, policy, scene, seed).as_posix()
        for scene, renderer, policy, seed in product(
            info.scenes, info.renderers, info.policies, info.seeds
        )
    )
