"""What each rollout of a scene drove, from above: one still map for the report, which its script
draws as the replay draws its own.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import shapely

from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.core.types import F64
from alpasim_plugin.log.run_folder.rows import CellSeries, Rollout, Series
from evaluators.pages.drive_data import Place, map_data, mrad
from evaluators.pages.rollouts import Event, clock_zero_us, events_of
from evaluators.statistics.numbers import fixed

LEAST_PATH_M = 1.0  # of a road user that moves
MAX_ACTORS = 60  # the nearest ones to the recorded drive
TOLERANCE_M = 0.1  # of simplified paths


def still_map(
    scene: str,
    content: JsonView,
    rollouts: Sequence[Rollout],
    series: Series,
    variant_of: Mapping[tuple[str, str], tuple[int, int]],
) -> JsonObject:
    """Return the map of a scene, and what its rollouts drove, as JSON: lengths in whole
    centimetres.

    Args:
        scene: Its name.
        content: ``scenes/SCENE.json``, with a recorded drive of two points or more.
        rollouts: Its rollouts.
        series: Pose and event series, by rollout.
        variant_of: (renderer, policy) -> (colour index, dash index).
    """
    log = content["ego_log"]
    recorded = np.column_stack([log["x_m"], log["y_m"]]).astype(np.float64)
    driven = [rollout for rollout in rollouts if "ego_x_m" in series.get(rollout.key, {})]
    ends_us = [series[rollout.key]["ego_x_m"][0][[0, -1]] for rollout in driven]
    first_us = int(min((ends[0] for ends in ends_us), default=0))
    last_us = int(max((ends[1] for ends in ends_us), default=0))
    place = Place(recorded[0], clock_zero_us(content, first_us))
    events = [(rollout, event) for rollout in rollouts for event in events_of(rollout, series)]
    # Road users are drawn at the scene's first event, else half way through.
    users_us = (first_us + last_us) // 2
    moment = "half way"
    timed = [(event.t_us, event.what) for _, event in events if event.t_us is not None]
    if timed:
        users_us, event_name = min(timed)
        moment = f"when the first {event_name} happens"
    names_policy = len({rollout.policy for rollout in rollouts}) > 1
    return {
        "scene": scene,
        "map": map_data(content, recorded, place),
        "tracks": [
            _track(series[rollout.key], *variant_of[rollout.renderer, rollout.policy], place)
            for rollout in driven
        ],
        "marks": [
            {"colour": variant_of[rollout.renderer, rollout.policy][0]}
            | _mark(rollout, event, names_policy, content["vehicle"], place)
            for rollout, event in events
        ],
        "users": _users(content.get("actors") or (), users_us, recorded, place),
        "users_at": f"at {_clock_s(users_us, place)}\u00a0s, {moment}",
    }


def _clock_s(t_us: int, place: Place) -> str:
    """Print a time as the scene's clock shows it, seconds."""
    return fixed((t_us - place.zero_us) * 1e-6, 1)


def _track(cell_series: CellSeries, colour: int, dash: int, place: Place) -> JsonObject:
    """Return the way of a rollout's ego."""
    x, y = (cell_series[name][1] for name in ("ego_x_m", "ego_y_m"))
    return {"colour": colour, "dash": dash, "line": path(np.column_stack([x, y]), place)}


def _mark(
    rollout: Rollout, event: Event, names_policy: bool, vehicle: JsonView, place: Place
) -> JsonObject:
    """Return the mark of an event with its sentence, and where its place is known the ego's body."""
    names = [rollout.renderer, rollout.policy] if names_policy else [rollout.renderer]
    label = " \u00b7 ".join([*names, f"seed {rollout.seed}"])
    mark: JsonObject = {"kind": event.kind, "folder": rollout.path}
    if event.t_us is None:
        text = f"{label}: {event.what} at a time that no step shows"
    else:
        text = f"{label}: {event.what} at {_clock_s(event.t_us, place)}\u00a0s"
    if event.x_m is not None and event.y_m is not None and event.yaw_rad is not None:
        ahead = np.array([np.cos(event.yaw_rad), np.sin(event.yaw_rad)])
        centre = np.array([event.x_m, event.y_m]) + vehicle["rear_axle_to_centre_m"] * ahead
        text += f", x {fixed(centre[0], 1)}, y {fixed(centre[1], 1)}\u00a0m"
        mark |= body(centre, event.yaw_rad, vehicle, place)
    return mark | {"text": text}


def _users(actors: Sequence[JsonView], t_us: int, recorded: F64, place: Place) -> list[JsonObject]:
    """Return the road users at an instant: those nearest to the recorded drive ``(N, 2)``, the
    nearest first.
    """
    drive = shapely.linestrings(recorded)
    users = []
    for actor in actors:
        if not actor["x_m"]:
            continue
        xy = np.column_stack([actor["x_m"], actor["y_m"]]).astype(float)
        step = int(np.argmin(np.abs(np.asarray(actor["t_us"]) - t_us)))
        user: JsonObject = {"label": actor["label"] or "other"}
        user |= body(xy[step], actor["yaw_rad"][step], actor, place)
        if float(np.ptp(xy, axis=0).max()) > LEAST_PATH_M:
            user["way"] = path(xy, place)
        users.append((float(shapely.distance(shapely.points(xy), drive).min()), user))
    users.sort(key=lambda pair: pair[0])
    return [user for _, user in users[:MAX_ACTORS]]


def path(xy: F64, place: Place) -> list[list[int]]:
    """Return a line ``(N, 2)`` in world metres, simplified, in whole centimetres."""
    if len(xy) < 2:
        return place.cm(xy)
    line = shapely.simplify(shapely.linestrings(xy), TOLERANCE_M, preserve_topology=False)
    return place.cm(shapely.get_coordinates(line))


def body(centre: F64, yaw_rad: float, sides: Mapping[str, float], place: Place) -> JsonObject:
    """Return the box of a vehicle or a road user, seen from above."""
    x, y = place.cm(centre)
    size = [round(100 * sides[side]) for side in ("length_m", "width_m")]
    return {"x": x[0], "y": y[0], "a": mrad([yaw_rad])[0], "size": size}
