"""The scenes of a run, loaded again and written as AlpaSim's ``.usdz``."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.io.atomic import atomic_file
from alpasim_plugin.io.config import load_yaml
from scenarios.library import find
from scenarios.load import load_scenario
from scenarios.suite import ScenarioRef
from scenarios.usdz_write import rig_box, write_usdz

DOING = "exporting scenes"


def scenes_of(info: Mapping[str, Any]) -> dict[str, tuple[ScenarioRef, Scenario]]:
    """Load the scenarios of a run by scene id.

    Args:
        info: Its ``run.json``.

    Raises:
        InputError: A scenario is gone, or is no longer the one that was driven.
    """
    out = {}
    for scene_id, stated in info["scenes"].items():
        given = stated.get("ref") or {}
        if "path" not in given:
            raise InputError(DOING, f"scene {scene_id!r}", "run.json has no path of its scenario", "export a folder that simrun run wrote")
        ref = ScenarioRef(given["path"], given.get("seed"), tuple(given.get("overrides", ())), given.get("source"))
        scenario = load_scenario(ref.path, ref.seed, ref.overrides, ref.source)
        if scenario.content_hash != stated["content_hash"]:
            found = f"{ref.path} is not what was driven: its content has changed"
            raise InputError(DOING, f"scene {scene_id!r}", found, "run again, or restore the scenario")
        out[scene_id] = (ref, scenario)
    return out


def write_scene(path: Path, ref: ScenarioRef, scenario: Scenario) -> None:
    """Write a scenario as an AlpaSim scene; one that was read from an AlpaSim scene is a copy of it, with its own id and vehicle."""
    if scenario.source == "usdz":
        _copy(path, _archive_of(ref), scenario)
    else:
        write_usdz(path, scenario)


def _archive_of(ref: ScenarioRef) -> Path:
    path = find(ref.path)
    if path.suffix not in (".yaml", ".yml"):
        return path
    document = load_yaml(path, DOING)
    key = next(key for key in ("usdz", "path") if key in document.data["log"])
    return Path(document.folder_of(("log", key)) / document.data["log"][key])


def _copy(path: Path, source: Path, scenario: Scenario) -> None:
    with atomic_file(path, DOING) as partial, zipfile.ZipFile(source) as old, zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as new:
        for info in old.infolist():
            data = old.read(info)
            if info.filename == "metadata.yaml":
                metadata = yaml.safe_load(data)
                if metadata["scene_id"] != scenario.scene_id:
                    data = yaml.safe_dump(metadata | {"scene_id": scenario.scene_id}, sort_keys=False).encode()
            elif info.filename == "rig_trajectories.json":
                data = _with_vehicle(data, scenario)
            new.writestr(info, data)


def _with_vehicle(data: bytes, scenario: Scenario) -> bytes:
    rigs = json.loads(data)
    wanted, (rig,) = rig_box(scenario.vehicle), rigs["rig_trajectories"]
    held = rig.get("rig_bbox") or {}
    same = all(abs(a - b) < 1e-6 for key in ("dim",) for a, b in zip(held.get(key, [0.0] * 3), wanted[key], strict=True))
    if held and same and abs(held["centroid"][0] - wanted["centroid"][0]) < 1e-6:
        return data
    rig["rig_bbox"] = wanted
    return json.dumps(rigs).encode()
