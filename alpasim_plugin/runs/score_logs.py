"""Score rollout logs without rendering, and write the files of a run folder."""

from __future__ import annotations

import glob
import os
import re
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from alpasim_plugin.core.errors import EvaluatorError, InfrastructureError, InputError, SimrunError
from alpasim_plugin.core.files import real, some_of
from alpasim_plugin.core.files.config import load_yaml
from alpasim_plugin.core.files.inputs import Inputs
from alpasim_plugin.core.geometry import inverse, offset_trajectory
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.parts import PartSpec, require_installed
from alpasim_plugin.core.path_end import PathEnd, ends_with_path
from alpasim_plugin.core.types import MetricSeries, RolloutLog, Scenario, Scene
from alpasim_plugin.log import read_asl
from alpasim_plugin.log.run_folder.checksums import problem_of
from alpasim_plugin.log.run_folder.manifests import read_manifest, read_run_json
from alpasim_plugin.log.run_folder.records import Manifest, SceneFacts
from alpasim_plugin.log.run_folder.schema import (
    KEYS,
    LOG_NAME,
    MANIFEST,
    RUN_INFO,
    UNKNOWN,
    rollout_folder,
)
from alpasim_plugin.log.run_folder.writer import LoggedScene, write_steps
from alpasim_plugin.runs.cell import error_of
from alpasim_plugin.runs.local_executor import apart
from alpasim_plugin.runs.plan import ref_of
from alpasim_plugin.runs.scoring import Scores, tabulate
from evaluators import score
from evaluators.alpasim import ScoredRollout
from evaluators.metrics.presets import Preset
from evaluators.results import Failures
from evaluators.statistics.verdicts import outcome_of_failures
from scenarios.load import load_scenario, scene_id_of
from scenarios.suite import ScenarioRef, load_suite
from scenarios.usdz import read_usdz, usdz_scene_id

SKIPPED = "<skip>"
# A seed other than the file's is part of the id.
SEEDED = re.compile(r"(?P<own>.+)-seed(?P<seed>\d+)")


@dataclass
class LogScore:
    """Result of one log."""

    manifest: Manifest
    scored: ScoredRollout | None  # None if the log could not be scored


def find_logs(items: Sequence[str]) -> list[Path]:
    """Return the logs of files, folders (searched to any depth for ``*.asl``) and glob patterns,
    each once, sorted per item.

    Raises:
        InputError: An item names no log.
    """
    logs_by_path: dict[Path, Path] = {}
    for item in items:
        path = Path(item)
        paths = (
            [path]
            if os.path.isfile(path)
            else sorted(path.rglob("*.asl"))
            if os.path.isdir(path)
            else []
        )
        if not paths and glob.has_magic(item):
            hits = [Path(hit) for hit in sorted(glob.glob(item, recursive=True))]
            paths = [
                log
                for hit in hits
                for log in ([hit] if os.path.isfile(hit) else sorted(hit.rglob("*.asl")))
            ]
        if not paths:
            problem = (
                "a folder without .asl logs"
                if os.path.isdir(path)
                else "no such file, folder or match"
            )
            raise InputError(
                f"{item}: {problem}",
                "give rollout.asl files, folders that hold them, or a pattern in quotes",
            )
        for log in paths:
            logs_by_path.setdefault(real(log), log)
    return list(logs_by_path.values())


def score_logs(
    logs: Sequence[Path],
    scenes: KnownScenes,
    preset: Preset,
    evaluators: Sequence[PartSpec],
    root: Path,
    on_done: Callable[[Manifest], None],
) -> list[LogScore]:
    """Score every log against its scene and write its steps.

    A log that cannot be read, is incomplete or cannot be scored becomes a failed row; the others
    are still scored.

    Raises:
        InputError: A log of a scene that is not among the given ones, or a scene that cannot be
            read.
    """
    scores = []
    taken: set[str] = set()
    names: set[str] = set()
    for log in logs:
        began = time.perf_counter()
        log_score = _score(log, scenes, preset, evaluators, root, taken, names)
        wall_s = round(time.perf_counter() - began, 4)
        log_score.manifest = replace(log_score.manifest, wall_s=wall_s)
        scores.append(log_score)
        on_done(log_score.manifest)
    return scores


def _score(
    log: Path,
    scenes: KnownScenes,
    preset: Preset,
    evaluators: Sequence[PartSpec],
    root: Path,
    taken: set[str],
    names: set[str],
) -> LogScore:
    name = real(log).parent.name
    manifest = Manifest(
        renderer=UNKNOWN,
        policy=UNKNOWN,
        scene=UNKNOWN,
        seed=0,
        path="",
        status="failed",
        wall_s=None,
        rollout=name,
        log=str(log),
        preset=preset.name,
        reused=True,  # nothing was rendered, so these rows have no speed
    )
    try:
        check_vouched(log)
        rollout = read_asl(log)
    except InputError as error:
        return _failed(manifest, error, root, taken)
    # as in AlpaSim; a second log with that id gets its folder's name with it
    session = rollout.session_uuid or name
    session = session if session not in names else f"{session} ({name})"
    names.add(session)
    manifest = _with_log_facts(manifest, rollout, session)
    # A wrong --scene is an error of the command, not of the log.
    scene = scenes.of(rollout.scene_id, log).scene
    cameras = {image.camera for image in rollout.images}
    if os.path.exists(log.parent / MANIFEST) and preset.image_camera not in cameras:
        preset = replace(preset, image_camera=None)  # our runs name their cameras as they like
    try:
        check_complete(log, rollout, scene)
        parts = ", ".join(part.name for part in evaluators if part.is_users)
        if parts:
            work = partial(_values_of_log, preset=preset, evaluators=evaluators)
            series, rows, scores, read = apart(work, (log, scene), parts, 1)
        else:
            series, rows, scores, read = _values(rollout, scene, preset, evaluators)
    except SimrunError as error:
        return _failed(manifest, error, root, taken)
    path = _folder(manifest, taken)
    manifest = replace(scores.stated_in(manifest), status="ok", path=path, score_inputs=read)
    keys = dict(zip(KEYS, manifest.cell, strict=True)) | {"rollout": session}
    write_steps(root / manifest.path, [keys | row for row in rows], of_logs=True)
    run_uuid, run_name = run_names(log)
    return LogScore(manifest, ScoredRollout(rollout.scene_id, session, series, run_uuid, run_name))


def _with_log_facts(manifest: Manifest, rollout: RolloutLog, session: str) -> Manifest:
    """Return a manifest with the members that the log itself states.

    Args:
        manifest: So far.
        rollout: The log.
        session: Name of the rollout.
    """
    versions = rollout.info["versions"]
    return replace(
        manifest,
        renderer=_named(versions.get("sensorsim"), versions.get("video_model")),
        policy=_named(versions.get("egodriver")),
        scene=rollout.scene_id,
        seed=int(rollout.seed) & (2**63 - 1),
        rollout=session,
        session_uuid=rollout.session_uuid,
        frames=len(rollout.images),
        steps=_steps(rollout),
        warnings=tuple(rollout.warnings),
    )


# The series of a log, its rows of steps.parquet, its scores, and what evaluators read.
Values = tuple[tuple[MetricSeries, ...], list[JsonObject], Scores, dict[str, str]]


def _values_of_log(
    log_and_scene: tuple[Path, Scene], preset: Preset, evaluators: Sequence[PartSpec]
) -> Values:
    """Return what `_values` does, in a process of its own."""
    log, scene = log_and_scene
    return _values(read_asl(log), scene, preset, evaluators)


def _values(
    rollout: RolloutLog, scene: Scene, preset: Preset, evaluators: Sequence[PartSpec]
) -> Values:
    """Return the series of a log, and the rows and facts that `tabulate` makes of them, with the
    files that evaluators read beside their code.
    """
    with Inputs() as inputs:
        series = tuple(score(rollout, scene, preset, evaluators))
    rows, scores = tabulate(rollout, series, preset)
    stated = {path for part in evaluators for path in (*part.code, *part.files)}
    read = {path: content for path, content in inputs.files.items() if path not in stated}
    return series, rows, scores, read


def check_vouched(log: Path) -> None:
    """Refuse a log of a run folder that is not the one its manifest vouches for; logs without a
    manifest beside them pass.

    Raises:
        InputError: The log is damaged, or another one.
    """
    if log.name != LOG_NAME or not os.path.exists(log.parent / MANIFEST):
        return
    try:
        facts = read_manifest(log.parent).files.get(LOG_NAME)
        problem = None if facts is None else problem_of(log, facts, full=True)
    except InputError as error:
        problem = f"its {MANIFEST} is damaged: {error.message}"
    if problem is not None:
        run = next(
            (folder for folder in real(log).parents if os.path.exists(folder / RUN_INFO)), None
        )
        raise InputError(
            f"{log}: {problem}",
            f"Give the command of the run {run or ''} again: it drives the rollout.",
        )


def check_complete(log: Path, rollout: RolloutLog, scene: Scene) -> None:
    """Refuse the log of a rollout that did not finish.

    A finished rollout has the number of control steps in its header after the first policy time, or
    covers the recording, which a scene with a goal goes on behind. A rollout that the driver terminated
    is finished, and ours end with a pose that is the first beyond the end of the path, or lost when
    the recording is over.

    Raises:
        InfrastructureError: The log ends earlier.
    """
    if rollout.info["terminated"] or rollout.control_us <= 0 or len(rollout.ego) < 2:
        return
    first_us = int(rollout.ego.t_us[_first_policy_pose(rollout)])
    recorded = (int(rollout.ego_log.t_us[-1]) - first_us) // rollout.control_us
    planned = int(rollout.info["n_steps"]) or recorded
    steps = planned if scene.path_end == "goal" else min(planned, recorded)
    done = _steps(rollout)
    if done < steps and not _ends_with_the_path(rollout, scene):
        cut = f"; {rollout.warnings[0]}" if rollout.warnings else ""
        raise InfrastructureError(
            f"{log}: the rollout ended after {done} of {steps} control steps{cut}",
            "run this rollout again",
        )


def _ends_with_the_path(rollout: RolloutLog, scene: Scene) -> bool:
    rig = offset_trajectory(rollout.ego, inverse(rollout.T_rig_box))
    is_over = scene.path_end == "goal" and rig.t_us[-1] >= rollout.ego_log.t_us[-1]
    if is_over and PathEnd(scene).is_lost(rig.xyz[-1, :2]):
        return True
    return ends_with_path(rig.xyz[_first_policy_pose(rollout) :, :2], scene)


def _steps(rollout: RolloutLog) -> int:
    """Return how many control steps were driven, since the first policy time."""
    if len(rollout.ego) < 2 or rollout.control_us <= 0:
        return 0
    first_us = int(rollout.ego.t_us[_first_policy_pose(rollout)])
    return (int(rollout.ego.t_us[-1]) - first_us) // rollout.control_us


def _first_policy_pose(rollout: RolloutLog) -> int:
    """Return which logged pose is that of the first policy time, when rendering starts: the second
    one where the recording begins earlier, whose first pose is logged before it.
    """
    later = np.searchsorted(rollout.ego.t_us, rollout.render_start_us)
    return min(int(later), len(rollout.ego) - 1)


def run_names(log: Path) -> tuple[str | None, str | None]:
    """Return uuid and name of the run that a log belongs to, of the ``run_metadata.yaml`` in the
    nearest folder above it.

    Raises:
        InputError: The file is invalid.
    """
    for folder in list(real(log).parents)[:5]:
        path = folder / "run_metadata.yaml"
        if os.path.isfile(path):
            data = load_yaml(path).data
            uuid, name = (
                data.get(key) if isinstance(data, dict) else None
                for key in ("run_uuid", "run_name")
            )
            return None if uuid is None else str(uuid), None if name is None else str(name)
    return None, None


def _failed(manifest: Manifest, error: SimrunError, root: Path, taken: set[str]) -> LogScore:
    path = _folder(manifest, taken)
    return LogScore(replace(manifest, error=error_of(error), path=path), None)


def _folder(manifest: Manifest, taken: set[str]) -> str:
    """Return the folder of a log's results, relative to the run folder; logs with the same names
    get numbers.
    """
    base = rollout_folder(
        manifest.renderer, manifest.policy, manifest.scene, manifest.rollout or UNKNOWN
    ).as_posix()
    path = base
    number = 2
    while path in taken:
        path = f"{base}-{number}"
        number += 1
    taken.add(path)
    return path


def _named(*versions: str | None) -> str:
    return next((text for text in versions if text and text != SKIPPED), UNKNOWN)


def exit_code(
    scores: Sequence[LogScore], failures_allowed: bool, aggregate_error: EvaluatorError | None
) -> int:
    """Return the process exit code: 5 for a log that cannot be scored, 4 for a rollout cut short, 2
    for a log that cannot be read; where several meet, the order of all verbs decides.

    Args:
        scores: Of every log.
        failures_allowed: Rollouts cut short are accepted.
        aggregate_error: Why AlpaSim's aggregation could not be made.
    """
    classes = [
        log_score.manifest.failure_class or "" for log_score in scores if not log_score.manifest.ok
    ]
    if failures_allowed:
        classes = [name for name in classes if name in ("input", "evaluator")]
    if aggregate_error is not None:
        classes.append("evaluator")
    return outcome_of_failures(Failures(len(classes), len(scores), Counter(classes))).exit_code


class KnownScenes:
    """Finds scenes in files, suites and folders; each is read on first use.

    A log of a run folder is scored in the scene that was driven: with the overrides and the seed
    that the run states, of the content that it states.

    Args:
        places: Scenes (anything that ``simrun run`` drives), suites, or folders of them.

    Raises:
        InputError: A place without scenes, or two scenes with one id.
    """

    def __init__(self, places: Sequence[str | Path]) -> None:
        self.places = [str(place) for place in places]
        self._refs = refs_by_id(self.places)
        self._read: dict[ScenarioRef, Scenario | LoggedScene] = {}
        self._used: dict[str, Scenario | LoggedScene] = {}

    def of(self, scene_id: str, log: Path | None = None) -> LoggedScene | Scenario:
        """Return the scene with an id.

        Args:
            scene_id: As the log names it.
            log: The log; None returns the scene that the last log with this id was scored in.

        Raises:
            InputError: None of the places has it, it cannot be read, or it is not what was driven.
        """
        if log is None and scene_id in self._used:
            return self._used[scene_id]
        stated = None if log is None else _stated_scene(log, scene_id)
        driven = None if stated is None or stated.ref is None else ref_of(stated.ref)
        ref = self._ref(scene_id, driven)
        if ref not in self._read:
            self._read[ref] = _read_scene(ref, is_ours=stated is not None)
        scene = self._read[ref]
        if stated is not None and scene.content_hash != stated.content_hash:
            raise InputError(
                f"scene {scene_id!r}: {ref.path} is not what was driven: its content has changed",
                "give the scenario as it was driven, or run again",
            )
        if self._used.setdefault(scene_id, scene).content_hash != scene.content_hash:
            raise InputError(
                f"scene {scene_id!r}: the logs were driven in two scenes with this id",
                "score the runs one by one",
            )
        return scene

    def _ref(self, scene_id: str, driven: ScenarioRef | None) -> ScenarioRef:
        """Return how to load the scene with an id, of what is given; of a run as it was driven.

        Raises:
            InputError: None of the places has it.
        """
        seeded = SEEDED.fullmatch(scene_id)
        scene_ref = self._refs.get(scene_id)
        if scene_ref is None and driven is not None:
            paths = {real(ref.path): ref for ref in self._refs.values()}
            scene_ref = paths.get(real(driven.path))
        if scene_ref is None and seeded and seeded["own"] in self._refs:
            scene_ref = replace(self._refs[seeded["own"]], seed=int(seeded["seed"]))
        if scene_ref is None:
            scene_ids = sorted(self._refs)
            raise InputError(
                f"scene {scene_id!r}: not among the {len(scene_ids)} scenes of {', '.join(self.places)}: {some_of(scene_ids)}",
                "name the log's scene with --scene, or a folder that holds it",
            )
        if driven is None:
            return scene_ref
        require_installed([driven.source], f"scene {scene_id!r}")
        return replace(
            scene_ref, seed=driven.seed, overrides=driven.overrides, source=driven.source
        )


def _stated_scene(log: Path, scene_id: str) -> SceneFacts | None:
    """Return what the run of a log states of the scene that was driven; None for a log of another
    program.
    """
    root = next((folder for folder in real(log).parents if os.path.exists(folder / RUN_INFO)), None)
    if root is None or not os.path.exists(log.parent / MANIFEST):
        return None
    stated = read_run_json(root).scenes.get(scene_id)
    if stated is None or stated.ref is None or not stated.content_hash:
        return None
    return stated


def _read_scene(ref: ScenarioRef, is_ours: bool) -> Scenario | LoggedScene:
    """Return a scene; AlpaSim's own for a log of AlpaSim, which needs no map of ours."""
    if is_ours or not ref.path.endswith(".usdz"):
        return load_scenario(ref.path, ref.seed, ref.overrides, ref.source)
    record = read_usdz(Path(ref.path), needs_map=False)
    scene = Scene(
        record.scene_id, record.lane_map, record.ego_log, record.vehicle, record.alpasim_map
    )
    return LoggedScene(
        scene,
        record.source,
        record.content_hash,
        record.notes,
        record.actors,
        record.world_origin,
    )


def refs_by_id(places: Sequence[str]) -> dict[str, ScenarioRef]:
    """Return how to load each scene of files, suites, folders and shipped names, by its id.

    Raises:
        InputError: A scene cannot be read, or two have one id.
    """
    refs: dict[str, ScenarioRef] = {}
    for place in places:
        for ref in _refs_of(place):
            scene_id = (
                usdz_scene_id(Path(ref.path)) if ref.path.endswith(".usdz") else scene_id_of(ref)
            )
            before = refs.setdefault(scene_id, ref)
            if replace(before, path=str(real(before.path))) != replace(
                ref, path=str(real(ref.path))
            ):
                raise InputError(
                    f"{_named_ref(before)} and {_named_ref(ref)}: both have the scene id {scene_id!r}",
                    "give one of them another id, or name one alone",
                )
    return refs


def _named_ref(ref: ScenarioRef) -> str:
    """Name a scene for messages: its file, and what a suite sets in it."""
    return " ".join((ref.path, *ref.overrides))


def _refs_of(place: str) -> list[ScenarioRef]:
    """Return the scenes of a path, a folder or a shipped name."""
    path = Path(place)
    archives = sorted(path.rglob("*.usdz")) if os.path.isdir(path) else []
    if archives:
        return [ScenarioRef(str(archive)) for archive in archives]
    return load_suite(place)


def scenario_finder(places: Sequence[str]) -> Callable[[str], Scenario]:
    """Return what finds a scenario by its scene id among files, suites, folders and shipped names.

    Without places, and only then, every id gets a straight road, of which nothing is true but the
    id: a policy under test takes no more from its scenario than cameras and vehicle.

    Raises:
        InputError: A scene cannot be read, or two have one id; when called, none has the id.
    """
    if not places:
        blank = load_scenario("smoke/straight")
        return lambda scene_id: replace(blank, scene_id=scene_id, actors=())
    scenarios = {
        scene_id: load_scenario(ref.path, ref.seed, ref.overrides, ref.source)
        for scene_id, ref in refs_by_id(places).items()
    }

    def find(scene_id: str) -> Scenario:
        if scene_id not in scenarios:
            choices = some_of(sorted(scenarios))
            raise InputError(
                f"scene {scene_id!r}: not among the {len(scenarios)} scenes given: {choices}",
                "name it with --scenes",
            )
        return scenarios[scene_id]

    return find
