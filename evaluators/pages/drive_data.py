"""Numbers of a page in whole centimetres, milliseconds and milliradians: the map of a scene, and
what moves and happens in a rollout.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import yaw_from_quat
from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.core.types import F64, I64, Actor, LoggedPlan, RolloutLog, Trajectory
from alpasim_plugin.log.run_folder.records import Contact
from alpasim_plugin.log.run_folder.rows import Rollout, series_by_rollout
from evaluators.pages.birdseye import chord_angle, drawn_map
from evaluators.pages.images import Rows
from evaluators.pages.rollouts import SERIES, events_of
from evaluators.statistics.opening import Run
from evaluators.statistics.sentences import seen_before

METRIC_DIGITS = 5
PLAN_STEP_US = 500_000
MAX_SAMPLES = 8  # of a plan; the first ones
POSE_SERIES = ("ego_x_m", "ego_y_m", "ego_yaw_rad")
MAX_FRAME_EVENTS = 20
CONTACT_TOLERANCE_S = 0.25  # between a contact and the step that counts it
AROUND_M = 120.0  # what is farther from the recorded drive is not drawn
TOLERANCE_M = 0.04  # of simplified lines


@dataclass(frozen=True)
class Place:
    """Where and when a scene's page counts from.

    Attributes:
        origin: ``(2,)`` metres, world: the first point of the recorded drive.
        zero_us: The first camera frame (`evaluators.pages.rollouts.clock_zero_us`), on the scene's
            clock.
    """

    origin: F64
    zero_us: int

    def cm(self, xy: npt.ArrayLike) -> list[list[int]]:
        """Return ``(N, 2)`` world metres as x and y in whole centimetres."""
        scaled = np.rint(
            (np.asarray(xy, dtype=np.float64).reshape(-1, 2) - self.origin) * 100.0
        ).astype(int)
        return [scaled[:, 0].tolist(), scaled[:, 1].tolist()]

    def ms(self, t_us: I64 | Sequence[int]) -> list[int]:
        """Return times ``(N,)`` in whole milliseconds."""
        return (
            np.rint((np.asarray(t_us, dtype=np.int64) - self.zero_us) / 1000.0).astype(int).tolist()
        )

    def track(self, trajectory: Trajectory) -> dict[str, list[int]]:
        """Return a trajectory as t (ms), x, y (cm) and a (heading, mrad; continuous, so that it can
        be interpolated).
        """
        x, y = self.cm(trajectory.xyz[:, :2])
        return {
            "t": self.ms(trajectory.t_us),
            "x": x,
            "y": y,
            "a": mrad(yaw_from_quat(trajectory.quat)),
        }


def mrad(yaw: npt.ArrayLike) -> list[int]:
    """Return headings ``(N,)`` in radians as continuous whole milliradians."""
    return np.rint(np.unwrap(np.asarray(yaw, dtype=np.float64)) * 1000.0).astype(int).tolist()


def rounded(values: F64) -> list[float | None]:
    """Return values with `METRIC_DIGITS` digits; None where not finite.

    Example:
        >>> rounded(np.array([0.123456789, np.nan, 3.0]))
        [0.12346, None, 3.0]
    """
    return [
        float(f"{value:.{METRIC_DIGITS}g}") if np.isfinite(value) else None
        for value in values.tolist()
    ]


def scene_of(run: Run, scene: str) -> tuple[JsonView, F64]:
    """Return ``scenes/SCENE.json`` of a run, and the recorded drive in it, ``(N, 2)`` metres, world.

    Raises:
        InputError: The run has no such file, or its recorded drive has fewer than two points.
    """
    content = run.scene_data(scene)
    if content is None:
        raise InputError(
            f"{run.folder / 'scenes'}: no file of scene {scene}",
            "Make the run again; runs of earlier versions kept no maps.",
        )
    log = np.column_stack([content["ego_log"]["x_m"], content["ego_log"]["y_m"]]).astype(np.float64)
    if len(log) < 2:
        raise InputError(f"{scene}: a recorded drive of {len(log)} points", "Make the run again.")
    return content, log


def map_data(content: JsonView, log: F64, place: Place) -> JsonObject:
    """Return the map in whole centimetres.

    Args:
        content: ``scenes/SCENE.json``.
        log: As `scene_of` returns it.
        place: Where numbers count from.
    """
    window = shapely.box(*(log.min(axis=0) - AROUND_M), *(log.max(axis=0) + AROUND_M))

    def near(lines: Sequence[F64]) -> list[list[list[int]]]:
        """Simplify the lines that come near."""
        shapes = shapely.simplify(
            [shapely.linestrings(line) for line in lines], TOLERANCE_M, preserve_topology=False
        )
        kept = {
            shape.wkb: shape for shape in shapes if window.intersects(shape)
        }  # a border shared by two lanes is drawn once
        return [place.cm(shapely.get_coordinates(shape)) for shape in kept.values()]

    lines = {kind: near(lines_of_kind) for kind, lines_of_kind in drawn_map(content).items()}
    return {
        "turn": round(chord_angle(log), 4),
        **lines,
        "log": place.cm(log),
        "source": str(content.get("source") or ""),
    }


class Tracks:
    """The ways of all road users of a cell; one that several rollouts share is kept once."""

    def __init__(self) -> None:
        self.all: list[JsonObject] = []
        self._known: dict[str, int] = {}

    def add(self, track: JsonObject) -> int:
        """Return a track's place in the list."""
        key = repr(track)
        if key not in self._known:
            self._known[key] = len(self.all)
            self.all.append(track)
        return self._known[key]


def drive_data(
    run: Run, rollout: Rollout, log: RolloutLog, place: Place, tracks: Tracks, frames: Rows
) -> JsonObject:
    """Return what a page draws of a rollout, without its camera frames.

    Args:
        run: The run.
        rollout: One that ran to its end.
        log: Its log.
        place: Where numbers count from.
        tracks: Gets the ways of the road users.
        frames: Facts of its camera frames.
    """
    steps = run.steps_of(rollout)
    manifest = run.manifest(rollout)
    contacts = () if manifest is None else manifest.contacts
    return {
        "ego": place.track(log.ego),
        "size": [round(100 * side) for side in (log.ego_box.length_m, log.ego_box.width_m)],
        "rear": round(100 * float(log.T_rig_box[0, 3])),
        "users": [tracks.add(user_data(actor, place)) for actor in log.actors.values()],
        "plans": [
            {"t": place.ms([plan.now_us])[0], "lines": plan_lines(plan, place)}
            for plan in log.plans
        ],
        "curves": curves(steps, place),
        "moments": moments(rollout, steps, contacts, place, frames),
    }


def user_data(actor: Actor, place: Place) -> JsonObject:
    """Return a road user: its label, its size in centimetres, its way."""
    way = place.track(actor.track)
    box = actor.box
    poses = set(zip(way["x"], way["y"], way["a"], strict=True))
    if len(poses) == 1:  # it stands: two poses say when it is there
        way = {key: [values[0], values[-1]] for key, values in way.items()}
    size = [round(100 * side) for side in box.size_m]
    return {"id": actor.actor_id, "label": actor.label or "other", "size": size, **way}


def plan_lines(plan: LoggedPlan, place: Place) -> list[list[list[int]]]:
    """Return a plan and its samples: points every half second from now on."""
    return [
        place.cm(half_seconds(line.t_us, line.xyz) if len(line) else np.empty((0, 2)))
        for line in (plan.trajectory, *plan.samples[:MAX_SAMPLES])
    ]


def half_seconds(times_us: I64, xy: F64) -> F64:
    """Return positions ``(T, 2+)`` every half second ``(N, 2)``, on which the pages count."""
    steps_us = np.arange(times_us[0], times_us[-1] + 1, PLAN_STEP_US)
    return np.stack([np.interp(steps_us, times_us, xy[:, axis]) for axis in (0, 1)], axis=1)


def curves(steps: pa.Table, place: Place) -> JsonObject:
    """Return every metric over time: t (ms), v (null where invalid), and why it is invalid where it
    is.

    Args:
        steps: As `Run.steps_of` returns them.
        place: Where times count from.
    """
    rows: dict[str, list[tuple[int, float | None, str | None]]] = {}
    for row in sorted(steps.to_pylist(), key=lambda row: (row["metric"], row["t_us"])):
        if row["metric"] not in POSE_SERIES:
            value = row["value"] if row["valid"] else None
            rows.setdefault(row["metric"], []).append((row["t_us"], value, row["reason"]))
    metrics: JsonObject = {}
    for metric, of_metric in rows.items():
        times_us, values, reasons = zip(*of_metric, strict=True)
        metrics[metric] = {"t": place.ms(times_us), "v": rounded(np.array(values, dtype=float))}
        why = "; ".join(dict.fromkeys(filter(None, reasons)))
        if why:
            metrics[metric]["why"] = why
    return metrics


def moments(
    rollout: Rollout, steps: pa.Table, contacts: Sequence[Contact], place: Place, frames: Rows
) -> list[JsonObject]:
    """List what happened when: counted collisions and departures from the road, and frames that a
    guard replaced or named.
    """
    event_steps = (
        steps.filter(pc.is_in(steps["metric"], pa.array(SERIES))) if steps.num_rows else steps
    )
    event_rows = []
    for event in events_of(rollout, series_by_rollout(event_steps)):
        text = event.what
        t_ms = None
        if event.t_us is not None and event.t_s is not None:
            t_ms = place.ms([event.t_us])[0]
            if event.kind == "collision":
                for contact in contacts:
                    if abs(contact.t_s - event.t_s) <= CONTACT_TOLERANCE_S:
                        text += f" with {contact.actor_id}"
                        break
            text = "; ".join(filter(None, (text, seen_before(frames, event.t_us))))
        event_rows.append({"t": t_ms, "kind": event.kind, "text": text})
    # Consecutive frames with the same event, such as replaced frames, make one event at the first.
    began = []
    before: set[str] = set()
    for row in frames:
        now = set(str(row.get("events") or "").split())
        if isinstance(row.get("t_us"), int):
            began_ms = place.ms([row["t_us"]])[0]
            started = sorted(now - before)
            began += [
                {"t": began_ms, "kind": "frame", "text": f"frame: {name}"} for name in started
            ]
        before = now
    return event_rows + began[:MAX_FRAME_EVENTS]


def plans_part(flips: Sequence[JsonView], place: Place, by_policy: bool) -> list[JsonObject]:
    """Return when plans first diverged, of entries of ``flips.json``; ``by_policy`` as in
    `WatchedCell`.
    """
    moments = []
    for entry in flips:
        if entry.get("t_us") is None:
            continue
        side = entry["renderer"]
        other = entry["baseline"]
        if by_policy:
            side, other = entry["policy"], str(entry["against"]).removeprefix(f"{side}/")
        text = f"plans part by {float(entry['gap_m']):.2f} m from {other}"
        moment = {"t": place.ms([entry["t_us"]])[0], "kind": "plans", "text": text}
        moments.append(moment | {"renderer": side})
    return moments
