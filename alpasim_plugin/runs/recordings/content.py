"""What a recording holds: one scene, policy and seed behind each renderer, on one time line, in
world metres and microseconds.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse, offset_trajectory
from alpasim_plugin.core.types import F64, I64, CameraSpec, RolloutLog, Trajectory
from alpasim_plugin.log import encode_image
from alpasim_plugin.log.run_folder.rows import Own, Rollout, series_by_cell
from evaluators.opening import Run
from evaluators.report.rollouts import events_of
from evaluators.viewer.cells import Logs, WatchedCell, no_frames
from evaluators.viewer.pictures import Source, sources

DOING = "exporting a rollout"
Kind = Literal["lane border", "road edge", "crosswalk", "recorded drive"]
MEDIA = {b"\x89PNG": "image/png", b"\xff\xd8": "image/jpeg"}  # by the first bytes


@dataclass(frozen=True)
class Line:
    """One line of the map; ``points``: (N, 3) metres, world."""

    kind: Kind
    points: F64


@dataclass(frozen=True)
class Picture:
    """An encoded camera frame as it was kept; ``media_type`` is ``image/png`` or ``image/jpeg``."""

    t_us: int
    media_type: str
    data: bytes


@dataclass(frozen=True)
class Camera:
    """A camera that has frames.

    Attributes:
        name: Its name in the log.
        spec: Pinhole and place on the rig; None where the log does not say, as of a video alone.
        source: Where its frames are.
    """

    name: str
    spec: CameraSpec | None
    source: Source

    def pictures(self) -> Iterator[Picture]:
        """Yield its frames in order of time: those of a log byte for byte, those of a video as
        JPEG.

        Raises:
            InputError: A frame is neither PNG nor JPEG, or the video is damaged.
        """
        for image in self.source.images:
            yield Picture(
                image.end_us,
                media_type_of(image.data, f"camera {self.name!r} at {image.end_us} us"),
                image.data,
            )
        for t_us, rgb in self.source.filmed():
            yield Picture(t_us, "image/jpeg", encode_image(rgb, "jpeg"))


@dataclass(frozen=True)
class Drive:
    """One rollout.

    Attributes:
        renderer: Its name.
        label: The same for topics and frames: letters, digits and ``@+._-``, distinct from those of
            the other drives.
        log: Its log.
        rig: Poses of the rear axle on the ground, world.
        cameras: Those with frames.
        metrics: Metric -> times ``(T,)`` and values ``(T,)``; instants without a valid value are
            left out, never zero.
        events: Time and words of what its metrics count: the first contact, the first departure
            from the road.
    """

    renderer: str
    label: str
    log: RolloutLog
    rig: Trajectory
    cameras: tuple[Camera, ...]
    metrics: Own
    events: tuple[tuple[int, str], ...]


@dataclass(frozen=True)
class Recording:
    """Everything that a file holds.

    Attributes:
        name: Scene, policy and seed.
        facts: Where it comes from, as text.
        lines: The map.
        drives: One for each renderer.
        notes: What is missing, one sentence each.
    """

    name: str
    facts: Mapping[str, str]
    lines: tuple[Line, ...]
    drives: tuple[Drive, ...]
    notes: tuple[str, ...]

    @property
    def start_us(self) -> int:
        """Give the first instant of all drives."""
        return min(int(drive.log.ego.t_us[0]) for drive in self.drives)


def media_type_of(data: bytes, what: str) -> str:
    """Return the media type of an encoded image.

    Raises:
        InputError: Neither PNG nor JPEG.
    """
    for head, media_type in MEDIA.items():
        if data.startswith(head):
            return media_type
    raise InputError(
        f"{what}: an image that begins with {data[:4].hex()}",
        "store PNG or JPEG images in the log",
    )


def collect(run: Run, cell: WatchedCell, logs: Logs) -> Recording:
    """Collect a cell of a run.

    Args:
        run: The run.
        cell: One of its cells.
        logs: Its logs (`evaluators.viewer.cells.read_logs`).

    Raises:
        InputError: A log is damaged, there is none, or one has an instant before zero, which MCAP
            cannot write.
    """
    notes = [
        f"{r.renderer}: failed ({r.failure_class or 'unknown'}), so there is no rollout"
        for r in cell.rollouts
        if not r.ok
    ]
    found: list[tuple[Rollout, RolloutLog]] = []
    for rollout in cell.rollouts:
        log = logs.get(rollout.path)
        if isinstance(log, RolloutLog):
            found.append((rollout, log))
        elif log is not None:
            raise log
        elif rollout.ok:
            notes.append(f"{rollout.renderer}: its log is not there, so it is left out")
    if not found:
        raise InputError(
            f"{cell.name}: {'; '.join(notes) or 'no rollout'}",
            "export a run whose rollouts have finished, with their logs",
        )
    early = [rollout.renderer for rollout, log in found if int(log.ego.t_us[0]) < 0]
    if early:
        raise InputError(
            f"{cell.name}, {early[0]}: times before zero",
            "give a log whose clock begins at zero or later",
        )
    labels = distinct_labels([rollout.renderer for rollout, _ in found])
    drives = tuple(
        _drive(run, rollout, log, label)
        for (rollout, log), label in zip(found, labels, strict=True)
    )
    notes += [
        f"{d.renderer}: {no_frames(run.manifest(r), True, None)}"
        for d, (r, _) in zip(drives, found, strict=True)
        if not d.cameras
    ]
    content = run.scene_data(cell.scene)
    lines = () if content is None else map_lines(content, found[0][1].ego_log)
    if content is None:
        notes.append("the run has no map of the scene")
    return Recording(cell.name, _facts(run, cell), lines, drives, tuple(notes))


def _drive(run: Run, rollout: Rollout, log: RolloutLog, label: str) -> Drive:
    specs = {spec.name: spec for spec in log.info["cameras"]}
    cameras = tuple(
        Camera(one.camera, specs.get(one.camera), one) for one in sources(run, rollout, log)
    )
    series = series_by_cell(run.steps_of(rollout))
    events = tuple(
        (event.t_us, event.what) for event in events_of(rollout, series) if event.t_us is not None
    )
    rig = offset_trajectory(log.ego, inverse(log.T_rig_box))
    return Drive(
        rollout.renderer, label, log, rig, cameras, next(iter(series.values()), {}), events
    )


def _facts(run: Run, cell: WatchedCell) -> dict[str, str]:
    info = run.info
    facts = {
        "run": run.folder.resolve().name,
        "key": info.get("key"),
        "scene": cell.scene,
        "policy": cell.policy,
        "seed": cell.seed,
        "preset": info.get("preset"),
        "simrun": info.get("version"),
        "commit": (info.get("project") or {}).get("commit"),
        "content_hash": ((info.get("scenes") or {}).get(cell.scene) or {}).get("content_hash"),
    }
    return {key: str(value) for key, value in facts.items() if value not in (None, "")}


def map_lines(content: Mapping[str, Any], recorded: Trajectory) -> tuple[Line, ...]:
    """Return the map that a run keeps, which is flat, laid at the height of the nearest point of
    the recorded drive.

    Args:
        content: ``scenes/SCENE.json``.
        recorded: Rig poses of the recorded drive, world, at least one.
    """
    found: dict[bytes, Line] = {}

    def add(kind: Kind, line: Sequence[Sequence[float]] | None) -> None:
        if line is not None and len(line) >= 2:
            xy = np.asarray(line, dtype=np.float64)[:, :2]
            found.setdefault(
                xy.tobytes(), Line(kind, np.column_stack([xy, heights(xy, recorded.xyz)]))
            )  # lanes share borders

    for lane in content.get("lanes") or []:
        add("lane border", lane.get("left"))
        add("lane border", lane.get("right"))
    for edge in content.get("road_edges") or []:
        add("road edge", edge)
    for ring in content.get("crosswalks") or []:
        add("crosswalk", [*ring, ring[0]])
    return (*found.values(), Line("recorded drive", recorded.xyz))


def heights(xy: F64, recorded: F64) -> F64:
    """Return ``(N,)`` the height of the recorded point nearest to each of ``(N, 2)``.

    Example:
        >>> heights(np.array([[0.0, 5.0], [9.0, 0.0]]), np.array([[0.0, 0.0, 1.0], [10.0, 0.0, 2.0]])).tolist()
        [1.0, 2.0]
    """
    gaps = ((xy[:, None] - recorded[None, :, :2]) ** 2).sum(axis=2)  # (N, R)
    nearest: F64 = recorded[gaps.argmin(axis=1), 2]
    return nearest


def distinct_labels(names: Sequence[str]) -> list[str]:
    """Return names of letters, digits and ``@+._-`` alone, all different.

    Example:
        >>> distinct_labels(["3dgs", "nre://host:1", "nre///host/1"])
        ['3dgs', 'nre_host_1', 'nre_host_1-2']
    """
    labels: list[str] = []
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9@+._-]+", "_", name).strip("_") or "renderer"
        tries = (plain, *(f"{plain}-{k}" for k in range(2, len(names) + 2)))
        labels.append(next(one for one in tries if one not in labels))
    return labels


def present(track: Trajectory, t_us: I64) -> I64:
    """Return the index ``(T,)`` of each instant among a track's own, -1 where the body is not
    there.
    """
    at = np.searchsorted(track.t_us, t_us)
    inside = at < len(track)
    same = np.zeros(len(t_us), dtype=bool)
    same[inside] = track.t_us[at[inside]] == t_us[inside]
    return np.where(same, at, -1).astype(np.int64)


Rgba = tuple[float, float, float, float]

RENDERERS: tuple[Rgba, ...] = (
    (0.04, 0.42, 0.70, 1.0),
    (0.85, 0.40, 0.08, 1.0),
    (0.0, 0.60, 0.45, 1.0),
    (0.65, 0.33, 0.60, 1.0),
    (0.65, 0.52, 0.0, 1.0),
)
MAP: dict[Kind, Rgba] = {
    "lane border": (0.75, 0.75, 0.78, 1.0),
    "road edge": (0.45, 0.48, 0.52, 1.0),
    "crosswalk": (0.60, 0.62, 0.65, 1.0),
    "recorded drive": (0.95, 0.95, 0.95, 0.8),
}
ROAD_USER: Rgba = (0.55, 0.57, 0.60, 0.8)


def of_renderer(number: int) -> Rgba:
    """Return the colour of the n-th renderer."""
    return RENDERERS[number % len(RENDERERS)]


def fainter(rgba: Rgba, alpha: float) -> Rgba:
    """Return a colour that lets more through."""
    return (*rgba[:3], alpha)


def as_bytes(rgba: Rgba) -> tuple[int, int, int, int]:
    """Return the parts from 0 to 255."""
    red, green, blue, alpha = (round(255 * part) for part in rgba)
    return red, green, blue, alpha
