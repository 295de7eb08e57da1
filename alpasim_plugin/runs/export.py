"""A finished run as AlpaSim run folders, one for each renderer and policy, with its scenes: what
AlpaSim's own evaluation takes as it is.

    OUT/RENDERER/POLICY/rollouts/SCENE/SESSION/{rollout.asl, _complete}
    OUT/RENDERER/POLICY/{run_metadata.yaml, eval-config.yaml, wizard-config.yaml}
    OUT/scenes/SCENE.usdz

The logs are copied entry by entry. What differs: the main camera is called as AlpaSim's image check
expects it.
"""

import json
import os
import shutil
import uuid
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.atomic import atomic_file, atomic_folder, write_json, write_text
from alpasim_plugin.core.files.config import load_yaml, parse
from alpasim_plugin.core.files.limits import ARCHIVE_BYTES, JSON_BYTES, YAML_BYTES
from alpasim_plugin.core.files.reading import parse_json
from alpasim_plugin.core.files.zips import open_zip, read_member
from alpasim_plugin.core.parts import require_installed
from alpasim_plugin.core.types import (
    Scenario,
)
from alpasim_plugin.log import read_asl
from alpasim_plugin.log.asl import copy_log
from alpasim_plugin.log.run_folder.check import cells_of_run
from alpasim_plugin.log.run_folder.manifests import read_manifest, read_run_json
from alpasim_plugin.log.run_folder.records import Manifest, RunInfo
from alpasim_plugin.log.run_folder.schema import LOG_NAME, slug
from alpasim_plugin.runs.plan import ref_of
from alpasim_plugin.runs.score_logs import check_vouched
from evaluators.alpasim import EvalSettings
from scenarios.ftheta import FRONT_WIDE
from scenarios.load import find, load_scenario
from scenarios.suite import ScenarioRef, expand
from scenarios.usdz_write import alpasim_cameras, rig_box, write_usdz

RUN_METADATA = "run_metadata.yaml"
EVAL_CONFIG = "eval-config.yaml"
WIZARD_CONFIG = "wizard-config.yaml"
SCENES = "scenes"
COMPLETE = "_complete"
FAILED = "failed_rollouts.json"


def eval_config() -> dict[str, Any]:
    """Return AlpaSim's evaluation settings: its defaults, no video, and no unpickling of what a
    driver sent.
    """
    defaults = EvalSettings().model_dump(
        mode="json", exclude={"run_in_runtime", "vec_map", "video"}
    )
    return defaults | {
        "vec_map": {
            "incl_road_edges": True,
            "incl_traffic_signs": True,
            "incl_wait_lines": True,
            "max_num_lanes": 20,
            "num_pts_per_lane": 20,
        },
        "video": {
            "render_video": False,
            "video_layouts": ["DEFAULT"],
            "camera_id_to_render": FRONT_WIDE,
            "render_every_nth_frame": 1,
            "generate_combined_video": False,
            "combined_video_speed_factor": 0.33,
            "map_video": {
                "map_radius_m": 20,
                "ego_loc": "BOTTOM_CENTER",
                "rotate_map_to_ego": True,
            },
        },
    }


def scenes_of(info: RunInfo) -> dict[str, tuple[ScenarioRef, Scenario]]:
    """Load the scenarios of a run by scene id.

    Args:
        info: Its ``run.json``.

    Raises:
        InputError: A scenario is gone, or is no longer the one that was driven.
    """
    out = {}
    for scene_id, stated in info.scenes.items():
        if stated.ref is None:
            raise InputError(
                f"scene {scene_id!r}: run.json has no path of its scenario",
                "export a folder that simrun run wrote",
            )
        ref = ref_of(stated.ref)
        require_installed([ref.source], f"scene {scene_id!r}")
        scenario = load_scenario(ref.path, ref.seed, ref.overrides, ref.source)
        if scenario.content_hash != stated.content_hash:
            raise InputError(
                f"scene {scene_id!r}: {ref.path} is not what was driven: its content has changed",
                "run again, or restore the scenario",
            )
        out[scene_id] = (ref, scenario)
    return out


def write_scene(path: Path, ref: ScenarioRef, scenario: Scenario) -> None:
    """Write a scenario as an AlpaSim scene; one that was read from an AlpaSim scene is a copy of
    it, with its own id and vehicle.
    """
    if scenario.source == "usdz":
        source = _archive_of(ref)
        with (
            atomic_file(path) as partial,
            open_zip(source, ARCHIVE_BYTES) as old,
            zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as new,
        ):
            for info in old.infolist():
                if info.filename == "metadata.yaml":
                    data = read_member(old, info, YAML_BYTES, source)
                    metadata = dict(parse(data.decode(), str(source)).data) | {
                        "scene_id": scenario.scene_id
                    }
                    new.writestr(info, yaml.safe_dump(metadata, sort_keys=False))
                elif info.filename == "rig_trajectories.json":
                    data = read_member(old, info, JSON_BYTES, source)
                    new.writestr(info, _with_vehicle(data, scenario))
                else:
                    with old.open(info) as member, new.open(info, "w") as copy:
                        shutil.copyfileobj(member, copy)
    else:
        write_usdz(path, scenario)


def _archive_of(ref: ScenarioRef) -> Path:
    path = find(ref.path)
    if path.suffix not in (".yaml", ".yml"):
        return path
    document = load_yaml(path)
    key = next(key for key in ("usdz", "path") if key in document.data["log"])
    return Path(document.folder_of(("log", key)) / document.data["log"][key])


def _with_vehicle(data: bytes, scenario: Scenario) -> bytes:
    rigs = parse_json(data, "rig_trajectories.json")
    (rig,) = rigs["rig_trajectories"]
    wanted = rig_box(scenario.vehicle)
    held = rig.get("rig_bbox")
    if held:
        before, after = ([*box["dim"], box["centroid"][0]] for box in (held, wanted))
        if np.allclose(before, after, rtol=0.0, atol=1e-6):
            return data  # the scene's file stays as it is, byte for byte
    rig["rig_bbox"] = wanted
    return json.dumps(rigs).encode()


@dataclass
class ExportedRun:
    """One AlpaSim run folder that was written.

    Attributes:
        renderer: Its renderer.
        policy: Its policy.
        folder: Below the export.
        rollouts: How many logs it holds.
        failed: How many rollouts failed in the run and are only named in ``failed_rollouts.json``.
    """

    renderer: str
    policy: str
    folder: str
    rollouts: int = 0
    failed: int = 0


@dataclass(frozen=True)
class Export:
    """What was written: the folder, its runs and its scenes."""

    root: Path
    runs: tuple[ExportedRun, ...]
    scenes: tuple[str, ...]


def export_scenes(places: Sequence[str], out: Path) -> Export:
    """Write scenarios as AlpaSim scenes into ``OUT/scenes``.

    Raises:
        InputError: A scenario is invalid, two share an id, or ``out`` is not empty.
    """
    _check_free(out)
    refs = [ref for place in places for ref in expand(place, (), None)]
    loaded: dict[str, tuple[ScenarioRef, Scenario]] = {}
    for ref in refs:
        scenario = load_scenario(ref.path, ref.seed, ref.overrides, ref.source)
        if scenario.scene_id in loaded:
            raise InputError(
                f"{ref.path}: a second scene with the id {scenario.scene_id!r}",
                "name every scene once",
            )
        loaded[scenario.scene_id] = (ref, scenario)
    with atomic_folder(out) as partial:
        return Export(out, (), _write_scenes(partial, loaded))


def export_run(root: Path, out: Path, say: Callable[[str], None]) -> Export:
    """Write a finished run as AlpaSim run folders.

    Args:
        root: The run folder.
        out: A new or empty folder; it is complete or not there.
        say: Called with a line for each rollout.

    Raises:
        InputError: It is no finished run, it has only scores, a log is damaged, a scenario has
            changed, or ``out`` is not empty.
    """
    _check_free(out)
    info = read_run_json(root)
    if info.is_of_logs:
        raise InputError(
            f"{root}: scores of logs, without the logs",
            "export the run folder that holds them",
        )
    manifests = [read_manifest(root / cell) for cell in cells_of_run(info)]
    loaded = scenes_of(info)
    runs: dict[tuple[str, str], ExportedRun] = {}
    with atomic_folder(out) as partial:
        for manifest in manifests:
            key = (manifest.renderer, manifest.policy)
            run = runs.setdefault(key, ExportedRun(*key, f"{slug(key[0])}/{slug(key[1])}"))
            if not manifest.ok:
                run.failed += 1
                continue
            source = root / manifest.path / LOG_NAME
            check_vouched(source)
            rollout = read_asl(source)
            cameras = alpasim_cameras(loaded[manifest.scene][1].cameras)
            names = {camera.name: name for name, camera in cameras.items() if name != camera.name}
            if not rollout.images:
                raise InputError(
                    f"{manifest.path}: the log holds no camera image, and AlpaSim's evaluation needs them",
                    f"run again without {manifest.policy}: it uses no camera",
                )
            target = partial / run.folder / "rollouts" / manifest.scene / rollout.session_uuid
            target.mkdir(parents=True)
            copy_log(source, target / LOG_NAME, cameras=names)
            (target / COMPLETE).touch()
            run.rollouts += 1
            say(f"{run.folder}/{manifest.scene}/{manifest.seed}")
        for run in runs.values():
            _finish(partial / run.folder, out, run, info, manifests)
        scenes = _write_scenes(partial, loaded)
    return Export(out, tuple(runs.values()), scenes)


def _finish(
    folder: Path,
    out: Path,
    run: ExportedRun,
    info: RunInfo,
    manifests: Sequence[Manifest],
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    name = f"{run.renderer} {run.policy}"
    metadata = {
        "run_uuid": str(
            uuid.uuid5(uuid.NAMESPACE_URL, f"{info.content}/{run.renderer}/{run.policy}")
        ),
        "run_name": name,
    }
    wizard = {
        "services": {
            "runtime": {"image": "none"}
        },  # alpasim-reeval needs the key; only its Slurm mode uses the image
        "scenes": {"scene_cache": str(out.absolute()), "sceneset_path": SCENES},
        "wizard": {"sqshcaches": []},
    }
    for file, content in (
        (RUN_METADATA, metadata),
        (EVAL_CONFIG, eval_config()),
        (WIZARD_CONFIG, wizard),
    ):
        write_text(folder / file, yaml.safe_dump(content, sort_keys=False))
    failed = [
        manifest
        for manifest in manifests
        if not manifest.ok and (manifest.renderer, manifest.policy) == (run.renderer, run.policy)
    ]
    if failed:
        rows = [
            {
                "run_name": name,
                "clipgt_id": manifest.scene,
                "rollout_id": f"seed-{manifest.seed}",
                "error": "" if manifest.error is None else manifest.error.message,
            }
            for manifest in failed
        ]
        write_json(folder / FAILED, rows)


def _write_scenes(
    partial: Path, loaded: Mapping[str, tuple[ScenarioRef, Scenario]]
) -> tuple[str, ...]:
    (partial / SCENES).mkdir(parents=True, exist_ok=True)
    for scene_id, (ref, scenario) in loaded.items():
        write_scene(partial / SCENES / f"{slug(scene_id)}.usdz", ref, scenario)
    return tuple(f"{SCENES}/{slug(scene_id)}.usdz" for scene_id in loaded)


def _check_free(out: Path) -> None:
    if os.path.exists(out) and (not os.path.isdir(out) or any(os.scandir(out))):
        raise InputError(
            f"--alpasim {out}: it is there and not empty",
            "name a new folder, or remove it first",
        )
