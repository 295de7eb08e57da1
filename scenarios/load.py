"""One door for every source: a path or a shipped name becomes a `Scenario`."""

from __future__ import annotations

import difflib
import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.clock import Clock
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import (  # fmt: skip
    BackgroundFile,
    Behaviour,
    Box,
    CameraSpec,
    Degradation,
    Environment,
    Latency,
    Rates,
    Scenario,
    Vehicle,
)
from alpasim_plugin.io.config import Document, apply_overrides, load_yaml, validate
from alpasim_plugin.io.reading import check_regular, exists, parsing
from alpasim_plugin.plugins.parts.source import own_code_digest
from alpasim_plugin.plugins.parts.spec import digest
from alpasim_plugin.world.ground import flat
from scenarios.alpasim_map import alpasim_view
from scenarios.budget import check_record, check_scenario, check_specification
from scenarios.build import build, last_us
from scenarios.cameras import camera_spec
from scenarios.library import shipped_names
from scenarios.schema import ScenarioSpec, VehicleSpec
from scenarios.schema_road import SHIPPED
from scenarios.sources import detect, read_log, source_digest
from scenarios.variation import differences, draw, jitter

DOING = "reading a scenario"
AS_WRITTEN = 0  # the scene seed that jitters nothing
ALPASIM_WARMUP_US = 1_700_000  # its default force_gt_duration_us


def load_scenario(path_or_name: str | Path, seed: int | None = None, overrides: Sequence[str] = (), source: str | None = None) -> Scenario:
    """Load a scenario file, a recorded log, or a shipped scenario by name.

    Args:
        path_or_name: Scenario YAML, Argoverse 2 log folder, CommonRoad XML, Cosmos-Drive-Dreams folder, or a name such as
            ``smoke/straight``.
        seed: Scene seed; None takes the file's. Another seed than the file's makes another scene, with the seed in its id. Seed 0 is the
            file as written, but for its ``variations`` and ``samples``.
        overrides: ``key=value`` with dotted keys, applied before validation.
        source: Who reads a recorded log, as `alpasim_plugin.plugins.parts.resolve` takes it; None finds the source that recognises the path.

    Returns:
        The scenario. The same input and seed give a bit-identical one.

    Raises:
        InputError: Anything wrong with the input, with file, line and column where there is one.
    """
    path = find(path_or_name)
    document = _document(path, source)
    if isinstance(document.data, dict) and "scenarios" in document.data:
        raise document.error(DOING, ("scenarios",), "a suite, not a scenario", "use load_suite, or run it with simrun")
    document = apply_overrides(document, overrides, DOING)
    own_seed = document.data.get("seed", 0) if isinstance(document.data, dict) else 0
    if seed is not None:
        document = apply_overrides(document, [f"seed={int(seed)}"], DOING)
    written = spec = validate(ScenarioSpec, document, DOING)
    scene_id = spec.scene_id or _default_id(path)
    fixed = tuple(text.partition("=")[0].strip() for text in overrides)
    document = draw(document, spec, scene_id, spec.seed, fixed)
    spec = validate(ScenarioSpec, document, DOING)
    _check_actors(document, spec)
    spec = jitter(spec, scene_id, spec.seed, fixed) if spec.seed != AS_WRITTEN else spec
    scenario = _from_log(document, spec, scene_id) if spec.log is not None else _from_road(document, spec, scene_id)
    scenario = replace(scenario, varied=differences(written, spec))
    if spec.seed != own_seed:
        scenario = replace(scenario, scene_id=f"{scenario.scene_id}-seed{spec.seed}")
    check_scenario(scenario, document.path)
    if scenario.source != "usdz":  # the map of an AlpaSim scene is in its form already
        scenario = replace(scenario, alpasim_map=alpasim_view(scenario.lane_map))
    return _timed(document, spec, scenario)


def find(path_or_name: str | Path) -> Path:
    """Return the path of an existing file or folder, or of a shipped scenario's file.

    Raises:
        InputError: Neither exists; the nearest shipped names are given.
    """
    path = Path(path_or_name)
    if exists(path):
        return path
    shipped = shipped_names()
    name = str(path_or_name).removesuffix(".yaml")
    if name in shipped:
        return shipped[name]
    near = difflib.get_close_matches(name, list(shipped), n=3, cutoff=0.5) or difflib.get_close_matches(
        name.rsplit("/", 1)[-1], [n.rsplit("/", 1)[-1] for n in shipped], n=3, cutoff=0.5
    )
    hint = f"did you mean {' or '.join(near)}? " if near else ""
    raise InputError(
        DOING, str(path_or_name), "no such file or folder, and no shipped scenario has that name",
        f"{hint}give a path, or a name that 'simrun list scenarios' shows",
    )  # fmt: skip


def _document(path: Path, source: str | None) -> Document:
    kind = source or detect(path)
    if kind == "yaml":
        return load_yaml(path, DOING)
    log = {kind: str(path.resolve())} if kind in SHIPPED else {"source": kind, "path": str(path.resolve())}
    return Document({"version": 1, "log": log}, {}, str(path))


def _default_id(path: Path) -> str:
    resolved = path.resolve()
    if path.suffix in (".yaml", ".yml"):
        return f"{resolved.parent.name}-{resolved.stem}"
    return resolved.stem if resolved.is_file() else resolved.name


def _check_actors(document: Document, spec: ScenarioSpec) -> None:
    seen: dict[str, int] = {}
    for i, actor in enumerate(spec.actors):
        if actor.id in seen:
            first = document.mark(("actors", seen[actor.id], "id"))
            raise document.error(DOING, ("actors", i, "id"), f"duplicate actor id {actor.id!r}, first at {first}", "give it another id")
        seen[actor.id] = i
    names = [c.name for c in spec.cameras or ()]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise document.error(DOING, ("cameras", i, "name"), f"duplicate camera name {name!r}", "give it another name")
    if spec.log is not None and spec.actors:
        raise document.error(DOING, ("actors",), "actors beside a recorded log", "remove actors; log.actors chooses the recorded traffic")


def _from_road(document: Document, spec: ScenarioSpec, scene_id: str) -> Scenario:
    vehicle = _vehicle(spec.vehicle or VehicleSpec())

    def fail(loc: tuple[str | int, ...], e: InputError) -> InputError:
        return InputError(e.doing, f"{document.mark(loc)} ({e.with_what})", e.found, e.do_this)

    check_specification(spec, lambda loc, found, do_this: document.error(DOING, loc, found, do_this))
    built = build(spec, vehicle, fail)
    start, warmup = spec.timing.start_us + spec.timing.start_time_offset_us, _warmup_us(spec)
    cameras = tuple(camera_spec(c) for c in spec.cameras) if spec.cameras else (camera_spec(),)
    return Scenario(
        scene_id, "yaml", spec.seed, built.lane_map, flat(0.0), built.ego_log, vehicle, built.route, built.actors, cameras,
        _rates(spec), start, last_us(spec), warmup, Latency(**spec.latency.model_dump()),
        _environment(spec), _degradation(spec), _background(document, spec), content_hash=_hash(document, spec, scene_id),
        stop_at_path_end=spec.timing.stop_at_path_end,
    )  # fmt: skip


def _from_log(document: Document, spec: ScenarioSpec, scene_id: str) -> Scenario:
    from alpasim_plugin.world.route import route_from_log

    assert spec.log is not None
    kind, text, key = spec.log.recorded
    path = document.folder_of(("log", key)) / text if document.marks else Path(text)
    if not path.exists():
        raise document.error(DOING, ("log", key), f"{path} does not exist", "correct the path; it is relative to the scenario file")
    with parsing(DOING, path, "repair this log, or use another one"):
        record = read_log(kind, path, spec.log.ego)
        check_record(record, str(path))
    behaviour = Behaviour("idm") if spec.log.actors == "idm" else Behaviour("replay")
    actors = () if spec.log.actors == "none" else tuple(
        a if a.is_static or behaviour.kind == "replay" else replace(a, behaviour=_idm(a)) for a in record.actors
    )  # fmt: skip
    cameras: tuple[CameraSpec, ...]
    cameras = tuple(camera_spec(c) for c in spec.cameras) if spec.cameras else record.cameras or (camera_spec(),)
    first, last = int(record.ego_log.t_us[0]), int(record.ego_log.t_us[-1])
    start = first + spec.timing.start_us
    if spec.timing.timeline == "alpasim" and record.first_frame_us is not None:
        start = record.first_frame_us
    start += spec.timing.start_time_offset_us
    end = last if spec.timing.duration_us is None else start + spec.timing.duration_us
    if end > last:
        raise document.error(
            DOING, ("timing", "duration_us"), f"ends at {(end - first) / 1e6:.2f} s of a log {(last - first) / 1e6:.2f} s long",
            "shorten timing.duration_us or leave it out",
        )  # fmt: skip
    is_file = Path(document.path).suffix in (".yaml", ".yml")
    chosen_id = spec.scene_id or (scene_id if is_file else record.scene_id)  # a bare log keeps its id whatever is overridden
    return Scenario(
        chosen_id, record.source, spec.seed, record.lane_map, record.ground, record.ego_log,
        _vehicle(spec.vehicle) if spec.vehicle else record.vehicle, route_from_log(record.lane_map, record.ego_log), actors, cameras,
        _rates(spec), start, end, _warmup_us(spec), Latency(**spec.latency.model_dump()), _environment(spec),
        _degradation(spec), _background(document, spec), record.world_origin,
        _hash(document, spec, chosen_id, record.content_hash), record.notes, record.alpasim_map, kind,
        stop_at_path_end=spec.timing.stop_at_path_end,
    )  # fmt: skip


def _idm(actor: Any) -> Behaviour:
    from alpasim_plugin.world.state import speeds

    if actor.label in ("pedestrian", "other"):
        return Behaviour("replay")
    return Behaviour("idm", {"desired_speed_mps": max(float(np.max(speeds(actor.track))), 2.0)})


def _timed(document: Document, spec: ScenarioSpec, scenario: Scenario) -> Scenario:
    """Check the periods and the length with the loop's own clock."""
    try:
        clock = Clock(scenario.start_us, scenario.end_us, scenario.rates)
    except InputError as e:
        key = next((k for k in ("control_us", "camera_us", "policy_us") if f"rates.{k}" in e.with_what), None)
        loc: tuple[str, ...] = ("rates", key) if key else ("timing", "duration_us")
        raise document.error(DOING, loc, f"{e.with_what}: {e.found}", e.do_this) from e
    if spec.timing.timeline == "alpasim" and scenario.warmup_us % scenario.rates.control_us:
        found = f"a control period of {scenario.rates.control_us} us, of which {scenario.warmup_us} us is no multiple"
        raise document.error(DOING, ("timing", "timeline"), found, "choose a rates.control_us that divides AlpaSim's 1.7 s")
    if spec.timing.start_time_offset_us and spec.timing.timeline != "alpasim":
        found = f"an offset of {spec.timing.start_time_offset_us} us in the scenario's own time line"
        raise document.error(DOING, ("timing", "start_time_offset_us"), found, "set timing.start_us, or timing.timeline: alpasim")
    length = clock.n_steps * scenario.rates.control_us
    if scenario.warmup_us >= length:
        raise document.error(
            DOING, ("timing", "warmup_us"), f"warmup_us = {scenario.warmup_us} of a scene of {length} us: nothing is left to drive",
            "shorten timing.warmup_us or lengthen timing.duration_us",
        )  # fmt: skip
    return scenario


def _vehicle(v: VehicleSpec) -> Vehicle:
    return Vehicle(
        Box(v.length_m, v.width_m, v.height_m), v.rear_axle_to_centre_m, v.wheelbase_m, v.max_steer_rad, v.max_steer_rate_radps,
        v.max_accel_mps2, v.max_brake_mps2,
    )  # fmt: skip


def _warmup_us(spec: ScenarioSpec) -> int:
    return ALPASIM_WARMUP_US if spec.timing.timeline == "alpasim" else spec.timing.warmup_us


def _rates(spec: ScenarioSpec) -> Rates:
    return Rates(spec.rates.control_us, spec.rates.camera_us, spec.rates.policy_us)


def _environment(spec: ScenarioSpec) -> Environment:
    e = spec.environment
    return Environment(e.buildings, e.building_height_m, e.trees_per_100m, e.poles_spacing_m, e.sky, e.texture)


def _degradation(spec: ScenarioSpec) -> Degradation:
    d = spec.degradation
    return Degradation(d.kind, d.share, d.shift_m, d.severity, d.onset_m, d.full_m, d.views_per_s, d.depth_error, d.pose_error_m)


def _background(document: Document, spec: ScenarioSpec) -> BackgroundFile | None:
    if spec.background is None:
        return None
    path = document.folder_of(("background", "file")) / spec.background.file
    if not path.is_file():
        raise document.error(DOING, ("background", "file"), f"{path} does not exist", "correct the path")
    matrix = np.eye(4) if spec.background.transform is None else np.array(spec.background.transform)
    if abs(np.linalg.det(matrix[:3, :3])) < 1e-12 or not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise document.error(
            DOING, ("background", "transform"), "no inverse, or a last row other than 0 0 0 1", "give rotation, scale and shift"
        )
    return BackgroundFile(str(path), matrix, spec.background.keep_road)


def code_digest_of(scenario: Scenario) -> str | None:
    """Return what identifies the code that made a scenario: this package's, and that of its source; None where it has no digest."""
    own = own_code_digest("scenarios.load")
    if scenario.source_part is None:
        return own
    source = source_digest(scenario.source_part)
    return None if source is None else digest([own, source])


def _hash(document: Document, spec: ScenarioSpec, scene_id: str, source_hash: str = "") -> str:
    """Hash the resolved specification, the scene id (it keys the random streams) and the bytes of every data file.

    Words for people, the places where data files lie, and where a rollout ends do not matter: they do not change the scene.
    """
    content = spec.model_dump(mode="json", exclude={"description": True, "tags": True, "timing": {"stop_at_path_end"}})
    if spec.log is not None:
        _, _, key = spec.log.recorded
        content["log"][key] = "given by its content"
    if spec.background is not None:
        content["background"]["file"] = "given by its content"
    digest = hashlib.sha256(json.dumps([scene_id, source_hash, content], sort_keys=True).encode())
    if spec.background is not None:
        file = document.folder_of(("background", "file")) / spec.background.file
        check_regular(file, DOING)
        with file.open("rb") as stream:
            digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()


__all__ = ["find", "load_scenario"]
