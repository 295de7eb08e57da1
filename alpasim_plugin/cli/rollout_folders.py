"""What a user names to see rollouts: a run folder, or the folder of one of its rollouts, which stands for its cell."""

from __future__ import annotations

from pathlib import Path

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.run_folder.manifests import read_manifest
from alpasim_plugin.run_folder.schema import CONTENTS, MANIFEST, RUN_INFO
from alpasim_plugin.viewer.cells import Wanted


def is_run(what: Path) -> bool:
    """Tell whether a folder is a run folder."""
    return (what / RUN_INFO).exists() or (what / CONTENTS).exists()


def find_cell(what: Path, doing: str) -> tuple[Path, Wanted | None]:
    """Return the run folder of a run or a rollout, and which rollouts to show if a rollout was named.

    Raises:
        InputError: Neither.
    """
    if is_run(what):
        return what, None
    if (what / MANIFEST).exists():
        manifest, _ = read_manifest(what)
        root = next((folder for folder in what.resolve().parents if (folder / RUN_INFO).exists()), None)
        if root is not None:
            return root, Wanted((str(manifest["scene"]),), (str(manifest["policy"]),), (int(manifest["seed"]),))
    found = "no run.json and no manifest.json" if what.is_dir() else "no such folder"
    raise InputError(doing, str(what), found, "give a folder that simrun run wrote, or RUN/rollouts/RENDERER/POLICY/SCENE/SEED")


def narrowed(what: Path, rollout: Wanted | None, asked: Wanted, doing: str) -> Wanted:
    """Return which rollouts to show: all that was asked for of a run, of a rollout's cell the renderers that were.

    Raises:
        InputError: More than renderers is asked for beside a rollout.
    """
    if rollout is None:
        return asked
    if asked.scenes or asked.policies or asked.seeds:
        raise InputError(doing, str(what), "--scene, --policy or --seed beside a rollout, which has one of each", "name its run folder")
    return Wanted(rollout.scenes, rollout.policies, rollout.seeds, asked.renderers)
