"""Make run folders in numbers: sealed and with real tables, their values drawn from a seed, without
logs or pictures.
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from alpasim_plugin.core.files.atomic import write_json
from alpasim_plugin.log.run_folder.manifests import write_run_json
from alpasim_plugin.log.run_folder.records import RunCounts
from alpasim_plugin.log.run_folder.schema import ROLLOUTS_TABLE
from alpasim_plugin.log.run_folder.sides import RolloutTable
from alpasim_plugin.log.run_folder.writer import write_table
from evaluators.results import Failures, Summary, to_json
from evaluators.statistics.summary import numbers
from tests.run_records import run_info

COMMITS = ("3f2a9c1d" * 5, "8b07ee42" * 5, "c51d9a60" * 5)
METRICS = ("offroad", "lateral_distance_m", "progress")
SCENES = {
    f"smoke-{name}": f"{k:02d}" * 32
    for k, name in enumerate(("curve", "lead_car", "straight", "s_curve", "narrow", "merge"))
}


@dataclass
class Many:
    """One run to make; ``shift_m`` moves ``lateral_distance_m`` behind each renderer."""

    name: str
    started_at: str = "2026-03-01T10:00:00+00:00"
    commit: str | None = COMMITS[0]
    dirty: bool = False
    renderers: Sequence[str] = ("clean", "onefixer")
    policies: Sequence[str] = ("lane-camera",)
    seeds: Sequence[int] = (0, 1)
    scenes: Mapping[str, str] = field(default_factory=lambda: dict(SCENES))
    preset: str = "paper"
    weights: str = "99bf50" + "0" * 58
    code: str = "a" * 64
    asked: Sequence[str] = ("suites/smoke",)
    shift_m: Mapping[str, float] = field(default_factory=dict)
    noise_m: float = 0.0  # of each run's own, beside what its cells share with those of all runs
    more: Mapping[str, Any] = field(default_factory=dict)


def make_one(root, one):
    """Write a finished run folder below ``root`` and return it."""
    folder = root / one.name
    rows = rows_of(one)
    write_run_json(folder, replace(run_info(info_of(one)), outcome=RunCounts(len(rows), 0)))
    write_table(folder / "rollouts.parquet", rows, ROLLOUTS_TABLE.arrow(METRICS))
    means = numbers(RolloutTable.of_files([folder / "rollouts.parquet"]))
    failures = Failures(n_failed=0, n_rollouts=len(rows), by_class={})
    summary = Summary(preset=one.preset, failures=failures, **vars(means))
    write_json(folder / "summary.json", to_json(summary))
    return folder


def rows_of(one):
    """Draw the rollouts: a cell's own part is the same in all runs and behind all renderers, so
    that pairs are sharp.
    """
    rows = []
    for renderer in one.renderers:
        for policy in one.policies:
            for k, scene in enumerate(one.scenes):
                for seed in one.seeds:
                    shared = np.random.default_rng([k, seed]).uniform(0.2, 0.6)
                    own = (
                        np.random.default_rng([k, seed, *one.name.encode()]).normal(
                            0.0, one.noise_m
                        )
                        if one.noise_m
                        else 0.0
                    )
                    lateral = shared + one.shift_m.get(renderer, 0.0) + own
                    values = {
                        "offroad": float(lateral > 0.9),
                        "lateral_distance_m": lateral,
                        "progress": 1.0 - 0.1 * shared,
                    }
                    key = {
                        "renderer": renderer,
                        "policy": policy,
                        "scene": scene,
                        "seed": seed,
                        "status": "ok",
                    }
                    path = f"rollouts/{renderer}/{policy}/{scene}/{seed}"
                    rows.append(
                        key | {"path": path} | values | {f"{name}_valid": True for name in values}
                    )
    return rows


def ref(path):
    return {"path": path, "seed": None, "overrides": [], "source": None}


def info_of(one):
    """Return ``run.json`` as a run writes it, as far as lists and trends read it."""
    project = {
        "commit": one.commit,
        "dirty": one.dirty,
        "reason": "" if one.commit else "none",
    }
    bundle = "/somewhere/weights/onefixer.safetensors"
    fixer = {
        "name": "onefixer",
        "digest": one.weights[:40],
        "files": {bundle: one.weights},
        "settings": {"steps": [1000.0], "weights": {"bundle": bundle}},
    }
    policies = {
        f"policy {name}": {"name": name, "digest": one.code, "files": {}, "settings": None}
        for name in one.policies
    }
    renderers = {
        f"renderer {name}": {"name": name, "digest": "d" * 64, "files": {}, "settings": None}
        for name in ("clean", "3dgs")
    }
    info = {
        "schema_version": 1,
        "key": f"key-{one.name}",
        "content": f"content-{one.name}",
        "command": ["simrun", *one.asked],
        "version": "0.1.0",
        "started_at": one.started_at,
        "project": project,
        "asked": list(one.asked),
        "config": {"images": "jpeg", "workers": 2},
        "preset": one.preset,
        "renderers": list(one.renderers),
        "policies": list(one.policies),
        "seeds": list(one.seeds),
        "scenes": {
            name: {"content_hash": digest, "ref": ref(f"/x/{name}.yaml")}
            for name, digest in one.scenes.items()
        },
        "bases": {"onefixer": "3dgs"},
        "fixers": {"onefixer": fixer} if "onefixer" in one.renderers else {},
        "parts": policies
        | renderers
        | ({"fixer onefixer": fixer} if "onefixer" in one.renderers else {}),
        "code": {"loop": "1" * 12, "scoring": "2" * 12},
        "metrics": {},
        "weights": {bundle: one.weights} if "onefixer" in one.renderers else {},
        "hardware": {"cpu": "x", "cores": 2},
        "versions": {"torch": "2.13.0"},
    }
    return info | dict(one.more)


def unfinish(folder):
    """Turn a finished run folder into one that was stopped."""
    for name in ("summary.json", "rollouts.parquet"):
        (folder / name).unlink()
    return folder


def copies(folder, count):
    """Copy a run folder beside itself, ``count`` times."""
    for k in range(count):
        shutil.copytree(folder, folder.with_name(f"{folder.name}-{k:04d}"))
