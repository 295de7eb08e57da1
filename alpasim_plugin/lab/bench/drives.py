"""Finished runs of the closed loop as measurements of the paper's arms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from alpasim_plugin.core.checksums import sha256_of
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.bench.trained_arms import STEPS
from alpasim_plugin.lab.paper.closed_loop import BASELINE, METRICS, Driven
from alpasim_plugin.lab.training.fixer_run import BUNDLE_FILE
from alpasim_plugin.log.run_folder.rows import Rollout
from evaluators.opening import Run, read_run

DOING = "reading drives behind the arms"


def read_drives(folders: Iterable[Path], arms: Path) -> dict[str, Driven]:
    """Read run folders: PROTOCOL -> the rollouts of one policy behind the arms.

    A renderer over ``3dgs`` whose fixer has the weights of an arm is that arm, whatever it is
    called in the run.

    Args:
        folders: Finished runs; the rollouts of a policy are in one of them.
        arms: Folder with ``NAME/fixer.safetensors`` for every trained arm.

    Raises:
        InputError: No finished run, one without ``3dgs``, a policy that is in two of them, or a
            renderer that is called like an arm and has other weights.
    """
    bundles = {sha256_of(path): path.parent.name for path in sorted(arms.glob(f"*/{BUNDLE_FILE}"))}
    out: dict[str, Driven] = {}
    for folder in folders:
        run = read_run(folder)
        if BASELINE not in run.renderers:
            raise InputError(
                f"--drives {folder}: renderers {', '.join(run.renderers)}",
                f"drive {BASELINE} too: it is what the arms are compared with",
            )
        names = {renderer: _arm(renderer, run, bundles) for renderer in run.renderers}
        if twice := sorted(
            {name for name in names.values() if list(names.values()).count(name) > 1}
        ):
            same = ", ".join(renderer for renderer, name in names.items() if name in twice)
            raise InputError(
                f"--drives {folder}: {same} have the same weights",
                "drive each arm behind one renderer",
            )
        for policy in run.policies:
            driven = Driven(
                policy,
                [_row(one, names[one.renderer]) for one in run.rollouts if one.policy == policy],
            )
            if driven.protocol in out:
                raise InputError(
                    f"--drives {folder}: policy {policy} drove in a folder before it",
                    "name one folder for each policy",
                )
            out[driven.protocol] = driven
    return out


def _arm(renderer: str, run: Run, bundles: Mapping[str, str]) -> str:
    """Return the arm's name of a renderer: by its weights, else its own."""
    fixer = (run.info.get("fixers") or {}).get(renderer)
    if fixer is None or (run.info.get("bases") or {}).get(renderer) != BASELINE:
        return renderer
    arm = next((bundles[digest] for digest in fixer["files"].values() if digest in bundles), None)
    if arm is not None:
        return f"{arm}@{len(fixer['settings']['steps'])}" if arm in STEPS else arm
    name = renderer.partition("@")[0]
    if name in bundles.values():
        raise InputError(
            f"--drives {run.folder}: {renderer} drove with weights that are not those of {name} in --arms",
            f"drive with --set {renderer}:fixer.weights.bundle=ARMS/{name}/{BUNDLE_FILE}, or name the folder whose arms drove",
        )
    return renderer


def _row(rollout: Rollout, arm: str) -> dict[str, Any]:
    values = {name: rollout.metrics.get(name) for name in METRICS}
    metrics = {
        name: {"value": value, "valid": value is not None, "reason": ""}
        for name, value in values.items()
    }
    return {
        "renderer": arm,
        "policy": rollout.policy,
        "scene": rollout.scene,
        "seed": rollout.seed,
        "status": rollout.status,
        "failure_class": rollout.failure_class,
        "metrics": metrics,
    }
