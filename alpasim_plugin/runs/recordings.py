"""Write one scene, policy and seed behind each renderer as a recording in MCAP, on one time line.

The messages have Foxglove's schemas (https://docs.foxglove.dev/docs/sdk/schemas), of which
``foxglove.json`` holds the members that are written, as JSON, so that every MCAP reader gives them
without generated classes. Positions are world metres, times are microseconds of the log.
"""

import base64
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import InputError, SimrunError
from alpasim_plugin.core.files import read_json, real
from alpasim_plugin.core.files.atomic import atomic_file
from alpasim_plugin.core.geometry import inverse, offset_trajectory, quat_from_matrix
from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.core.lazy import require_library
from alpasim_plugin.core.types import F64, Box, CameraSpec, LensModel, RolloutLog, Trajectory
from alpasim_plugin.log import encode_image
from alpasim_plugin.log.run_folder.rows import CellSeries, Rollout, series_by_rollout
from evaluators.pages.cells import Logs, WatchedCell
from evaluators.pages.images import NO_FRAMES, Source, sources
from evaluators.pages.rollouts import events_of
from evaluators.statistics.opening import Run

Rgb = tuple[float, float, float]
Message = JsonObject
Item = tuple[int, str, Message, Message]  # time in microseconds, topic, schema, message

SCHEMAS: dict[str, Message] = read_json(Path(__file__).with_name("foxglove.json"))
NUMBER = {"type": "number"}
RENDERER_COLORS: tuple[Rgb, ...] = (
    (0.04, 0.42, 0.70),
    (0.85, 0.40, 0.08),
    (0.0, 0.60, 0.45),
    (0.65, 0.33, 0.60),
    (0.65, 0.52, 0.0),
)
MAP_COLORS: dict[str, Rgb] = {
    "lane border": (0.75, 0.75, 0.78),
    "road edge": (0.45, 0.48, 0.52),
    "crosswalk": (0.60, 0.62, 0.65),
    "recorded drive": (0.95, 0.95, 0.95),
}
ROAD_USER_COLOR: Rgb = (0.55, 0.57, 0.60)
PLAN_M = 0.3  # thickness of a line
THIN_M = 0.12
PATH_ALPHA = 0.6
SAMPLE_ALPHA = 0.35
WORLD = "world"
CHUNK_BYTES = 4 * 2**20
LINE_STRIP = 0
WARNING = 3


def require_mcap() -> Any:
    """Import the library; see `require_library`."""
    return require_library("mcap.writer", "--mcap", "install the extra [mcap], or pip install mcap")


def export_mcap(run: Run, cell: WatchedCell, logs: Logs, path: Path) -> JsonObject:
    """Write the rollouts of one scene, policy and seed as a recording.

    Args:
        run: The run.
        cell: Which ones.
        logs: Its logs (`evaluators.pages.cells.read_logs`).
        path: The file; replaced.

    Returns:
        ``recording`` (scene, policy and seed), ``file``, ``bytes``, ``messages``, ``channels``
        (topic -> messages), ``notes`` (what is missing, one sentence each).

    Raises:
        InputError: A log is damaged, there is none, or one has an instant before zero, which MCAP
            cannot write; or the library ``mcap`` is not installed.
        InfrastructureError: The disk refuses.
    """
    notes = [
        f"{rollout.renderer}: failed ({rollout.failure_class or 'unknown'}), so there is no rollout"
        for rollout in cell.rollouts
        if not rollout.ok
    ]
    recorded: list[RolloutLog] = []
    labels: list[str] = []
    items: list[Item] = []
    for rollout in cell.rollouts:
        log = _usable_log(cell, rollout, logs)
        if log is None:
            if rollout.ok:
                notes.append(f"{rollout.renderer}: its log is not there, so it is left out")
            continue
        color = RENDERER_COLORS[len(recorded) % len(RENDERER_COLORS)]
        label = _label(rollout.renderer, labels)
        recorded.append(log)
        labels.append(label)
        items += _rollout_items(run, rollout, log, label, color)
        cameras = sources(run, rollout, log)
        if not cameras:
            notes.append(f"{rollout.renderer}: {NO_FRAMES}")
        for camera in cameras:
            items += _camera_items(camera, log, label)
    if not recorded:
        raise InputError(
            f"{cell.name}: {'; '.join(notes) or 'no rollout'}",
            "Export a run whose rollouts have finished, with their logs.",
        )
    scene_data = run.scene_data(cell.scene)
    if scene_data is None:
        notes.append("the run has no map of the scene")
    else:
        first_us = min(int(log.ego.t_us[0]) for log in recorded)
        items.insert(0, _map_item(scene_data, recorded[0].ego_log.xyz, first_us))
    facts = _facts(run, cell) | {"recording": cell.name, "notes": "\n".join(notes)}
    counts = _write(path, items, facts)
    size = {"bytes": path.stat().st_size, "messages": sum(counts.values()), "channels": counts}
    return {"recording": cell.name, "file": str(path), **size, "notes": notes}


def _usable_log(cell: WatchedCell, rollout: Rollout, logs: Logs) -> RolloutLog | None:
    """Return the log of a rollout; None where there is none.

    Raises:
        SimrunError: The log could not be read.
        InputError: It has an instant before zero.
    """
    log = logs.get(rollout.path)
    if isinstance(log, SimrunError):
        raise log
    if log is not None and int(log.ego.t_us[0]) < 0:
        raise InputError(
            f"{cell.name}, {rollout.renderer}: times before zero",
            "Give a log whose clock begins at zero or later.",
        )
    return log


def _write(path: Path, items: Iterable[Item], facts: Mapping[str, str]) -> dict[str, int]:
    """Write messages in order of time and return how many each topic has."""
    mcap = require_mcap()
    counts: dict[str, int] = {}
    channels: dict[str, int] = {}
    schemas: dict[str, int] = {}
    with atomic_file(path) as partial, partial.open("wb") as stream:
        writer = mcap.Writer(stream, chunk_size=CHUNK_BYTES)
        writer.start(profile="", library=f"simrun {facts.get('simrun', '')}".strip())
        writer.add_metadata("simrun", dict(facts))
        for t_us, topic, schema, message in sorted(items, key=lambda item: item[0]):
            if topic not in channels:
                text = json.dumps(schema)
                if text not in schemas:
                    schemas[text] = writer.register_schema(
                        schema["title"], "jsonschema", text.encode()
                    )
                channels[topic] = writer.register_channel(topic, "json", schemas[text])
                counts[topic] = 0
            data = json.dumps(message, allow_nan=False, separators=(",", ":"), default=_base64)
            writer.add_message(
                channels[topic], 1000 * t_us, data.encode(), 1000 * t_us, counts[topic]
            )
            counts[topic] += 1
        writer.finish()
    return counts


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def _label(name: str, taken: Sequence[str]) -> str:
    """Return a renderer's name for topics: letters, digits and ``@+._-``, unlike those taken."""
    plain = re.sub(r"[^A-Za-z0-9@+._-]+", "_", name).strip("_") or "renderer"
    label = plain
    while label in taken:
        label = f"{plain}-{taken.index(label) + 2}"
    return label


def _facts(run: Run, cell: WatchedCell) -> dict[str, str]:
    """Return where the recording comes from."""
    project = run.info.project
    scene = run.info.scenes.get(cell.scene)
    facts = {
        "run": real(run.folder).name,
        "key": run.info.key,
        "scene": cell.scene,
        "policy": cell.policy,
        "seed": cell.seed,
        "preset": run.info.preset,
        "simrun": run.info.version,
        "commit": None if project is None else project.commit,
        "content_hash": None if scene is None else scene.content_hash,
    }
    return {key: str(value) for key, value in facts.items() if value not in (None, "")}


def _map_item(content: JsonView, recorded: F64, t_us: int) -> Item:
    """Return the map that a run keeps, which is flat, laid at the height of the nearest point of
    the recorded drive ``(R, 3)``.
    """
    borders = [lane[side] for lane in content["lanes"] for side in ("left", "right")]
    flat = {
        "lane border": [border for border in borders if border is not None],
        "road edge": content["road_edges"],
        "crosswalk": [[*ring, ring[0]] for ring in content["crosswalks"]],
    }
    entities = []
    for kind, polylines in flat.items():
        unique = {str(line): line for line in polylines if len(line) >= 2}  # lanes share borders
        lines = []
        for line in unique.values():
            xy = np.array(line)[:, :2]
            squared_m2 = ((xy[:, None] - recorded[None, :, :2]) ** 2).sum(axis=2)
            xyz = np.column_stack([xy, recorded[squared_m2.argmin(axis=1), 2]])
            lines.append(_line(xyz, MAP_COLORS[kind], THIN_M))
        if lines:
            entities.append(_entity(t_us, kind, lines=lines))
    path = _line(recorded, MAP_COLORS["recorded drive"], THIN_M)
    entities.append(_entity(t_us, "recorded drive", lines=[path]))
    return _update(t_us, "/map", entities)


def _rollout_items(
    run: Run, rollout: Rollout, log: RolloutLog, label: str, color: Rgb
) -> Iterator[Item]:
    """Yield everything of a rollout but its images."""
    rig = offset_trajectory(log.ego, inverse(log.T_rig_box))  # the rear axle, on the ground
    for t_us, xyz, quat in zip(rig.t_us.tolist(), rig.xyz, rig.quat, strict=True):
        yield _transform(t_us, WORLD, f"{label}/rig", xyz, quat)
    yield from _boxes(rollout.renderer, log, label, color)
    first_us = int(rig.t_us[0])
    path = _line(rig.xyz, color, THIN_M, PATH_ALPHA)
    yield _update(first_us, f"/{label}/path", [_entity(first_us, "path", lines=[path])])
    for plan in log.plans:
        lines = [_line(plan.trajectory.xyz, color, PLAN_M)]
        lines += [_line(sample.xyz, color, THIN_M, SAMPLE_ALPHA) for sample in plan.samples]
        entity = _entity(plan.now_us, "plan", lines=lines)
        yield _update(plan.now_us, f"/{label}/plan", [entity])
    series = series_by_rollout(run.steps_of(rollout))
    yield from _metrics(next(iter(series.values()), {}), label)
    for event in events_of(rollout, series):
        if event.t_us is not None:
            message = {
                "timestamp": _time(event.t_us),
                "level": WARNING,
                "message": event.what,
                "name": rollout.renderer,
                "file": "",
                "line": 0,
            }
            yield event.t_us, f"/{label}/events", SCHEMAS["Log"], message


def _boxes(renderer: str, log: RolloutLog, label: str, color: Rgb) -> Iterator[Item]:
    """Yield the ego and all road users that are there, at each step; a box whose actor is gone is
    gone with the next message.
    """
    steps = {
        name: {t_us: i for i, t_us in enumerate(actor.track.t_us.tolist())}
        for name, actor in log.actors.items()
    }
    before: list[str] = []
    for k, t_us in enumerate(log.ego.t_us.tolist()):
        ego = _cube(log.ego_box, log.ego, k, color)
        entities = [_entity(t_us, "ego", cubes=[ego], facts={"renderer": renderer})]
        present = [name for name in log.actors if t_us in steps[name]]
        for name in present:
            actor = log.actors[name]
            cube = _cube(actor.box, actor.track, steps[name][t_us], ROAD_USER_COLOR, 0.8)
            facts = {"id": name, "label": actor.label}
            entities.append(_entity(t_us, f"user {name}", cubes=[cube], facts=facts))
        gone = [name for name in before if name not in present]
        yield _update(t_us, f"/{label}/boxes", entities, gone=[f"user {name}" for name in gone])
        before = present


def _metrics(metrics: CellSeries, label: str) -> Iterator[Item]:
    """Yield one message an instant with the metrics that are valid then; a metric that is not has
    no value, never zero.
    """
    properties = {"timestamp": SCHEMAS["Log"]["properties"]["timestamp"]}
    properties |= dict.fromkeys(metrics, NUMBER)
    schema = {"title": "simrun.Metrics", "type": "object", "properties": properties}
    messages: dict[int, Message] = {}
    for name, (times_us, values) in metrics.items():
        for t_us, value in zip(times_us.tolist(), values.tolist(), strict=True):
            messages.setdefault(t_us, {"timestamp": _time(t_us)})[name] = value
    for t_us, message in messages.items():
        yield t_us, f"/{label}/metrics", schema, message


def _camera_items(camera: Source, log: RolloutLog, label: str) -> Iterator[Item]:
    """Yield the calibration of a camera, where the log has it and MCAP has a model of its lens, and
    its images: those of a log byte for byte, those of a video as JPEG.
    """
    topic = f"/{label}/{camera.camera}"
    frame = topic[1:]
    specs: dict[str, CameraSpec] = {spec.name: spec for spec in log.info["cameras"]}
    spec = specs.get(camera.camera)
    if spec is not None:
        t_us = int(log.ego.t_us[0])
        mounting = spec.T_rig_camera
        quat = quat_from_matrix(mounting[:3, :3])
        yield _transform(t_us, f"{label}/rig", frame, mounting[:3, 3], quat)
        distortion = _distortion(spec.lens)
        if distortion is not None:
            calibration = distortion | {
                "timestamp": _time(t_us),
                "frame_id": frame,
                "width": spec.width,
                "height": spec.height,
                "K": spec.K.ravel().tolist(),
                "R": np.eye(3).ravel().tolist(),
                "P": np.column_stack([spec.K, np.zeros(3)]).ravel().tolist(),
            }
            yield t_us, f"{topic}/calibration", SCHEMAS["CameraCalibration"], calibration
    images = [(image.end_us, image.data) for image in camera.images]
    images += [(t_us, encode_image(rgb, "jpeg")) for t_us, rgb in camera.filmed()]
    for t_us, data in images:
        kind = "png" if data.startswith(b"\x89PNG") else "jpeg"
        message = {"timestamp": _time(t_us), "frame_id": frame, "data": data, "format": kind}
        yield t_us, topic, SCHEMAS["CompressedImage"], message


def _distortion(lens: LensModel | None) -> Message | None:
    """Return the model of a lens by its name in `foxglove.CameraCalibration`; None where none of
    them states it: an f-theta lens, a fisheye with more than four terms, and one with thin prism
    terms.
    """
    if lens is None:
        return {"distortion_model": "", "D": []}
    terms = [*lens.coefficients, *[0.0] * (12 - len(lens.coefficients))]
    if lens.kind == "fisheye" and not any(terms[4:]):
        return {"distortion_model": "kannala_brandt", "D": terms[:4]}
    if lens.kind == "opencv" and not any(terms[8:]):
        return {"distortion_model": "rational_polynomial", "D": terms[:8]}
    return None


def _update(t_us: int, topic: str, entities: Sequence[Message], gone: Sequence[str] = ()) -> Item:
    """Return an update of entities that removes those that are gone."""
    removed = [{"timestamp": _time(t_us), "type": 0, "id": name} for name in gone]
    return t_us, topic, SCHEMAS["SceneUpdate"], {"deletions": removed, "entities": entities}


def _entity(
    t_us: int,
    name: str,
    cubes: Sequence[Message] = (),
    lines: Sequence[Message] = (),
    facts: Mapping[str, str] | None = None,
) -> Message:
    """Return an entity that stays until one of the same name replaces it."""
    return {
        "timestamp": _time(t_us),
        "frame_id": WORLD,
        "id": name,
        "lifetime": _time(0),
        "frame_locked": True,
        "metadata": [{"key": key, "value": value} for key, value in (facts or {}).items()],
        "cubes": cubes,
        "lines": lines,
    }


def _transform(t_us: int, parent: str, child: str, xyz: F64, quat: F64) -> Item:
    """Return the pose of a frame in another; ``quat`` is wxyz."""
    message = {
        "timestamp": _time(t_us),
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": _members("xyz", xyz),
        "rotation": _members("wxyz", quat),
    }
    return t_us, "/tf", SCHEMAS["FrameTransform"], message


def _cube(box: Box, track: Trajectory, step: int, color: Rgb, alpha: float = 1.0) -> Message:
    return {
        "pose": _pose(track.xyz[step], track.quat[step]),
        "size": _members("xyz", box.size_m),
        "color": _members("rgba", (*color, alpha)),
    }


def _line(points: F64, color: Rgb, thickness_m: float, alpha: float = 1.0) -> Message:
    """Return a line through ``(N, 3)`` metres."""
    return {
        "type": LINE_STRIP,
        "pose": _pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
        "thickness": thickness_m,
        "scale_invariant": False,
        "points": [_members("xyz", point) for point in points],
        "color": _members("rgba", (*color, alpha)),
        "colors": [],
        "indices": [],
    }


def _pose(xyz: Iterable[float], quat: Iterable[float]) -> Message:
    return {"position": _members("xyz", xyz), "orientation": _members("wxyz", quat)}


def _members(names: str, values: Iterable[float]) -> Message:
    return dict(zip(names, map(float, values), strict=True))


def _time(t_us: int) -> Message:
    return {"sec": t_us // 1_000_000, "nsec": t_us % 1_000_000 * 1000}
