"""From a path or a shipped name to a `Scenario`, read from top to bottom: document, specification,
recording, scenario.
"""

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.clock import Clock
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import content_of, file_sha256
from alpasim_plugin.core.files.inputs import Inputs
from alpasim_plugin.core.geometry import arc_lengths, speeds
from alpasim_plugin.core.parts.source import package_digest
from alpasim_plugin.core.parts.spec import digest
from alpasim_plugin.core.types import (
    F64,
    Actor,
    BackgroundFile,
    Behaviour,
    Box,
    CameraSpec,
    Degradation,
    Environment,
    Latency,
    PlanRange,
    Rates,
    Route,
    Scenario,
    Trajectory,
    Vehicle,
)
from alpasim_plugin.world.markings import with_default_markings
from alpasim_plugin.world.route import EXTENSION_M, recorded_route
from scenarios.budget import check_record, check_scenario
from scenarios.build import UNPOSTED, before_end, built_drive
from scenarios.cameras import camera_spec, check_mounts, given_cameras
from scenarios.map_lines import alpasim_view
from scenarios.measured import measured_range
from scenarios.recorded import RecordedLog
from scenarios.schema import ScenarioSpec, VehicleSpec
from scenarios.sources import open_document, recorded_drive, source_digest
from scenarios.suite import ScenarioRef, find
from scenarios.variation import SceneDraft, draw

RECORDED_STREETS = ("usdz", "drive")  # sources whose street is recorded, whatever renders it
ALPASIM_WARMUP_US = 1_700_000  # its default force_gt_duration_us


def load_scenario(
    path_or_name: str | Path,
    seed: int | None = None,
    overrides: Sequence[str] = (),
    source: str | None = None,
) -> Scenario:
    """Load a scenario file, a recorded log, a map, or a shipped scenario by name.

    Args:
        path_or_name: Scenario YAML, Argoverse 2 log folder, CommonRoad XML, OpenDRIVE or
            Lanelet2 map, or a name such as ``smoke/straight``.
        seed: Scene seed; None takes the file's. Another seed than the file's makes another scene,
            with the seed in its id. Seed 0 is the file as written, but for its ``variations``.
        overrides: ``key=value`` with dotted keys, applied before validation.
        source: Who reads a recorded log, as `alpasim_plugin.core.parts.resolve` takes it; None finds the source
            that recognises the path.

    Returns:
        The scenario. The same input and seed give a bit-identical one.

    Raises:
        InputError: Anything wrong with the input, with file, line and column where there is one.
    """
    document = open_document(find(path_or_name), source)
    draft = draw(document, seed, overrides)
    # The scenario file enters as the resolved specification; everything else that is read, by its
    # content.
    with Inputs() as inputs:
        return _loaded(draft, source, inputs)


def _loaded(draft: SceneDraft, source: str | None, inputs: Inputs) -> Scenario:
    """Read what a specification names, and make the scenario of it."""
    cameras = given_cameras(draft)
    default = draft.spec.vehicle or VehicleSpec()
    if draft.spec.road is not None:
        drive = built_drive(draft, _vehicle(default))
    elif draft.spec.map is not None:
        from scenarios.map_drive import map_drive

        drive = map_drive(draft, _vehicle(default))
    else:
        drive = recorded_drive(draft, source)
    check_record(drive, draft.document.path)
    scenario = _scenario(draft, drive, cameras or drive.cameras or (camera_spec(),))
    for path in scenario.shown_files:
        content_of(path)
    inputs.setting("scene", scenario.content_hash)
    scenario = replace(
        scenario,
        content_hash=_with_ranges(inputs.key, draft.spec),
        files=inputs.files,
        plan_ranges=_plan_ranges(draft.spec, inputs.key),
    )
    if cameras is not None:
        check_mounts(draft, cameras, scenario.vehicle)
    check_scenario(scenario, draft.document.path)
    if scenario.source != "usdz":  # the map of an AlpaSim scene is in its form already
        scenario = replace(scenario, alpasim_map=alpasim_view(scenario.lane_map))
    _check_timing(draft, scenario)
    return scenario


def scene_id_of(ref: ScenarioRef) -> str:
    """Return the id of a scene; of a scenario file without building it.

    Raises:
        InputError: Anything wrong with the input.
    """
    path = find(ref.path)
    if path.suffix not in (".yaml", ".yml"):
        return load_scenario(ref.path, ref.seed, ref.overrides, ref.source).scene_id
    draft = draw(open_document(path, ref.source), ref.seed, ref.overrides)
    return _with_seed(draft, draft.spec.scene_id or draft.scene_id)


def catches_of(ref: ScenarioRef) -> tuple[str, ...]:
    """Return the faults of a policy that a scenario file says its scene catches.

    Raises:
        InputError: Anything wrong with the file.
    """
    return draw(open_document(find(ref.path), ref.source), ref.seed, ref.overrides).spec.catches


def _with_seed(draft: SceneDraft, scene_id: str) -> str:
    """Return the id of a scene, which names a seed that is another one than its file's."""
    return f"{scene_id}-seed{draft.spec.seed}" if draft.reseeded else scene_id


def code_digest_of(scenario: Scenario) -> str | None:
    """Return what identifies the code that made a scenario: this package's, and that of its source;
    None where it has no digest.
    """
    package = package_digest()
    if scenario.source_part is None:
        return package
    source = source_digest(scenario.source_part)
    return None if source is None else digest([package, source])


def _scenario(draft: SceneDraft, drive: RecordedLog, cameras: tuple[CameraSpec, ...]) -> Scenario:
    """Put the settings of the specification beside a map, a drive and its traffic."""
    spec = draft.spec
    timing = draft.spec.timing
    kind = None if draft.spec.log is None else draft.spec.log.recorded[0]
    is_file = Path(draft.document.path).suffix in (".yaml", ".yml")
    # A bare log keeps its id whatever is overridden.
    scene_id = spec.scene_id or (draft.scene_id if is_file else drive.scene_id)
    start, end = _window(draft, drive)
    background = _background(draft)
    # A street that is built gets markings where its map names none; what is painted on a recorded
    # street and not in its map stays unknown.
    recorded = drive.source in RECORDED_STREETS or (
        background is not None and not background.keep_road
    )
    lane_map = drive.lane_map if recorded else with_default_markings(drive.lane_map)
    route, beyond = _route(drive, (end - start) * 1e-6)
    return Scenario(
        scene_id=_with_seed(draft, scene_id),
        source=drive.source,
        seed=spec.seed,
        lane_map=lane_map,
        ground=drive.ground,
        ego_log=drive.ego_log,
        vehicle=replace(
            _vehicle(spec.vehicle) if spec.vehicle else drive.vehicle,
            friction=spec.environment.friction,
        ),
        route=route,
        actors=_actors(draft, drive),
        cameras=cameras,
        rates=Rates(**spec.rates.model_dump()),
        start_us=start,
        end_us=end,
        warmup_us=ALPASIM_WARMUP_US if timing.timeline == "alpasim" else timing.warmup_us,
        route_offset_m=spec.route.start_offset_m,
        latency=Latency(**spec.latency.model_dump()),
        environment=Environment(**spec.environment.model_dump(exclude={"friction"})),
        degradation=Degradation(**spec.degradation.model_dump()),
        background=background,
        world_origin=drive.world_origin,
        content_hash=_hash(draft, scene_id, drive.content_hash),
        notes=drive.notes,
        alpasim_map=drive.alpasim_map,
        source_part=kind,
        varied=draft.varied,
        recording=drive.recording,
        model=drive.model,
        measured=measured_range(drive, cameras),
        standing=drive.standing,
        path_beyond=beyond,
        path_end="road" if drive.path_end == "record" and len(beyond) else drive.path_end,
        stop_at_path_end=timing.stop_at_path_end,
    )


def _route(drive: RecordedLog, seconds: float) -> tuple[Route, F64]:
    """Return where the ego should go, and the part of it behind the recorded drive ``(N, 3)`` on
    which a rollout goes on: of a recorded log the lanes of its map, as far as the fastest
    admissible drive comes. Where the street is recorded its images end with the drive.
    """
    nothing = np.zeros((0, 3))
    if drive.route is not None:
        return drive.route, nothing if drive.path_beyond is None else drive.path_beyond
    limits = [lane.speed_limit_mps for lane in drive.lane_map.lanes.values()]
    top_mps = float(np.max(speeds(drive.ego_log), initial=0.0))
    fastest_mps = max([UNPOSTED * top_mps, *(limit for limit in limits if limit is not None)])
    driven_m = float(arc_lengths(drive.ego_log.xyz)[-1])
    more_m = max(EXTENSION_M, fastest_mps * seconds - driven_m)
    route, ahead = recorded_route(drive.lane_map, drive.ego_log, more_m)
    ends = drive.source in RECORDED_STREETS or drive.model is not None or bool(drive.recording)
    return route, nothing if ends else before_end(ahead, drive.vehicle)


def _window(draft: SceneDraft, drive: RecordedLog) -> tuple[int, int]:
    """Return the times of the first frame and of the end."""
    timing = draft.spec.timing
    first = int(drive.ego_log.t_us[0])
    last = int(drive.ego_log.t_us[-1])
    # Who does not stop at the goal gets the expert's time, unless the file states another.
    if drive.goes_on_until_us and (timing.stop_at_path_end or timing.duration_us is not None):
        last = drive.goes_on_until_us
    start = first + timing.start_us
    if draft.spec.road is not None:
        return start + timing.start_time_offset_us, draft.spec.built_until_us
    if timing.timeline == "alpasim" and drive.first_frame_us is not None:
        start = drive.first_frame_us
    start += timing.start_time_offset_us
    _check_first_frame(draft, drive.ego_log, start)
    end = last if timing.duration_us is None else start + timing.duration_us
    if end > last:
        fault = f"ends at {(end - first) / 1e6:.2f} s of a log {(last - first) / 1e6:.2f} s long"
        raise draft.document.error(
            ("timing", "duration_us"), fault, "shorten timing.duration_us or leave it out"
        )
    return start, end


def _check_first_frame(draft: SceneDraft, log: Trajectory, start_us: int) -> None:
    """Check that a first frame that the file delays lies on the recorded drive."""
    timing = draft.spec.timing
    key = "start_us" if timing.start_us else "start_time_offset_us"
    is_on_log = start_us + draft.spec.rates.control_us <= log.t_us[-1]
    if is_on_log or not getattr(timing, key):
        return
    begin_s = (start_us - int(log.t_us[0])) * 1e-6
    length_s = int(log.t_us[-1] - log.t_us[0]) * 1e-6
    fault = f"the first frame is at {begin_s:.2f} s of a recorded drive {length_s:.2f} s long"
    raise draft.document.error(("timing", key), fault, f"choose a smaller timing.{key}")


def _actors(draft: SceneDraft, drive: RecordedLog) -> tuple[Actor, ...]:
    """Return the traffic; that of a recorded log is replayed, reacts, or is left out, as
    ``log.actors`` says.
    """
    log = draft.spec.log
    if log is None:
        files = {actor.id: _appearance(draft, i) for i, actor in enumerate(draft.spec.actors)}
        for i, name in enumerate(files):
            if files[name] and name not in {actor.actor_id for actor in drive.actors}:
                raise draft.document.error(
                    ("actors", i, "appearance"),
                    f"{name!r} is a row of several vehicles",
                    "give each vehicle an entry of its own",
                )
        return tuple(replace(actor, appearance=files.get(actor.actor_id)) for actor in drive.actors)
    if log.actors == "replay":
        return drive.actors
    return () if log.actors == "none" else tuple(_reactive(actor) for actor in drive.actors)


def _appearance(draft: SceneDraft, i: int) -> str | None:
    """Return the file of an actor's Gaussians; None where it is built."""
    document, file, key = (
        draft.document,
        draft.spec.actors[i].appearance,
        ("actors", i, "appearance"),
    )
    if file is None:
        return None
    path = document.folder_of(key) / file
    if not os.path.isfile(path):
        raise document.error(key, f"{path} is no file", "correct the path")
    return str(path)


def _reactive(actor: Actor) -> Actor:
    if actor.is_static:
        return actor
    if actor.label in ("pedestrian", "other"):
        return replace(actor, behaviour=Behaviour("replay"))
    top_mps = float(np.max(speeds(actor.track)))
    return replace(actor, behaviour=Behaviour("idm", {"desired_speed_mps": max(top_mps, 2.0)}))


def _check_timing(draft: SceneDraft, scenario: Scenario) -> None:
    """Check the periods and the length with the loop's own clock."""
    document = draft.document
    timing = draft.spec.timing
    control_us = scenario.rates.control_us
    warmup_us = scenario.warmup_us
    try:
        clock = Clock(scenario.start_us, scenario.end_us, scenario.rates)
    except InputError as e:
        key = next(
            (
                k
                for k in ("control_us", "camera_us", "policy_us")
                if e.message.startswith(f"rates.{k}")
            ),
            None,
        )
        loc: tuple[str, ...] = ("rates", key) if key else ("timing", "duration_us")
        raise document.error(loc, f"{e.message}", e.hint) from e
    if timing.timeline == "alpasim" and warmup_us % control_us:
        fault = f"a control period of {control_us} us, of which {warmup_us} us is not a multiple"
        raise document.error(
            ("timing", "timeline"),
            fault,
            "choose a rates.control_us that divides AlpaSim's 1.7 s",
        )
    if timing.start_time_offset_us and timing.timeline != "alpasim":
        fault = f"an offset of {timing.start_time_offset_us} us in the scenario's own time line"
        raise document.error(
            ("timing", "start_time_offset_us"),
            fault,
            "set timing.start_us, or timing.timeline: alpasim",
        )
    recorded_us = (scenario.recorded_until_us - scenario.start_us) // control_us * control_us
    if scenario.path_end == "goal" and warmup_us >= recorded_us:
        fault = f"warmup_us = {warmup_us}, and the expert's drive ends after {recorded_us} us"
        raise document.error(
            ("timing", "warmup_us"), fault, "shorten timing.warmup_us or choose a longer route"
        )
    length_us = clock.n_steps * control_us
    if warmup_us >= length_us:
        fault = f"warmup_us = {warmup_us} of a scene of {length_us} us: nothing is left to drive"
        raise document.error(
            ("timing", "warmup_us"),
            fault,
            "shorten timing.warmup_us or lengthen timing.duration_us",
        )


def _vehicle(v: VehicleSpec) -> Vehicle:
    chassis = v.model_dump(exclude={"length_m", "width_m", "height_m"})
    return Vehicle(Box(v.length_m, v.width_m, v.height_m), **chassis)


def _background(draft: SceneDraft) -> BackgroundFile | None:
    document = draft.document
    background = draft.spec.background
    if background is None:
        return None
    path = document.folder_of(("background", "file")) / background.file
    if not os.path.isfile(path):
        raise document.error(("background", "file"), f"{path} does not exist", "correct the path")
    matrix = np.eye(4) if background.transform is None else np.array(background.transform)
    if abs(np.linalg.det(matrix[:3, :3])) < 1e-12 or not np.allclose(matrix[3], [0, 0, 0, 1]):
        fault = "no inverse, or a last row other than 0 0 0 1"
        raise document.error(("background", "transform"), fault, "give rotation, scale and shift")
    return BackgroundFile(str(path), matrix, background.keep_road)


def _hash(draft: SceneDraft, scene_id: str, source_hash: str) -> str:
    """Hash the resolved specification, the scene id (it keys the random streams) and the bytes of
    every data file.

    Words for people, the places where data files lie, where a rollout ends and up to where plans
    are near do not matter: they do not change the scene.
    """
    spec = draft.spec
    content = spec.model_dump(
        mode="json",
        exclude={
            "description": True,
            "tags": True,
            "catches": True,
            "plan_ranges": True,
            "timing": {"stop_at_path_end"},
        },
    )
    if isinstance(spec.cameras, tuple):
        content["cameras"].sort(key=lambda camera: camera["name"])
    if spec.log is not None:
        content["log"][spec.log.recorded[2]] = "given by its content"
        _drop(content["log"], ("osi",))
    for i, actor in enumerate(content["actors"]):
        _drop(actor, ("yields",) if actor.get("role") else ("yields", "role", "gap_m"))
        _drop(actor, ("appearance",))
        if "appearance" in actor:
            folder = draft.document.folder_of(("actors", i, "appearance"))
            actor["appearance"] = file_sha256(folder / actor["appearance"])
    if spec.map is None:
        del content["map"]
    else:
        content["map"][spec.map.source[0]] = "given by its content"
        _drop(content["map"], ("lanelet2", "cyclists"))
    if spec.background is not None:
        content["background"]["file"] = "given by its content"
    scene = hashlib.sha256(json.dumps([scene_id, source_hash, content], sort_keys=True).encode())
    if spec.background is not None:
        file = draft.document.folder_of(("background", "file")) / spec.background.file
        scene.update(bytes.fromhex(file_sha256(file)))
    return scene.hexdigest()


def _plan_ranges(spec: ScenarioSpec, content_hash: str) -> tuple[PlanRange, ...]:
    """Return up to where plans are near, and whether that was looked for on this scene."""
    return tuple(
        PlanRange(
            entry.renderer,
            entry.policy,
            entry.near_to_m,
            is_current=content_hash.startswith(entry.scene.removeprefix("sha256-")),
            renderer_digest=entry.renderer_digest,
            policy_digest=entry.policy_digest,
        )
        for entry in spec.plan_ranges
    )


def _with_ranges(content_hash: str, spec: ScenarioSpec) -> str:
    """Return the digest of a scene with its ranges, on which the scores of a rollout depend."""
    if not spec.plan_ranges:
        return content_hash
    ranges = [entry.model_dump(mode="json") for entry in spec.plan_ranges]
    return hashlib.sha256(json.dumps([content_hash, ranges]).encode()).hexdigest()


def _drop(content: dict[str, Any], keys: Sequence[str]) -> None:
    """Remove keys without effect, by which a file of before they existed is the scene it was."""
    for key in keys:
        if key in content and (key == "gap_m" or not content[key]):
            del content[key]


__all__ = ["find", "load_scenario"]
