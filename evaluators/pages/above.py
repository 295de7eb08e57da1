"""What each rollout of a scene drove, from above: one still map for the report, which its script
draws as the replay draws its own.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import shapely

from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.core.types import F64
from alpasim_plugin.log.run_folder.rows import Rollout, Series
from evaluators.pages.drive_data import Place, map_data, mrad
from evaluators.pages.rollouts import clock_zero_us, events_of
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
    vehicle = content["vehicle"]
    recorded = np.column_stack([log["x_m"], log["y_m"]]).astype(np.float64)
    names_policy = len({rollout.policy for rollout in rollouts}) > 1
    driven = [one for one in rollouts if "ego_x_m" in series.get(one.key, {})]
    ends_us = [series[one.key]["ego_x_m"][0][[0, -1]] for one in driven]
    first_us = int(min((ends[0] for ends in ends_us), default=0))
    last_us = int(max((ends[1] for ends in ends_us), default=0))
    place = Place(recorded[0], clock_zero_us(content, first_us))
    tracks = []
    for rollout in driven:
        colour, dash = variant_of[rollout.renderer, rollout.policy]
        x, y = (series[rollout.key][name][1] for name in ("ego_x_m", "ego_y_m"))
        tracks.append(
            {"colour": colour, "dash": dash, "line": path(np.column_stack([x, y]), place)}
        )
    marks = []
    # road users are drawn at the scene's first event, else half way through
    at_us = (first_us + last_us) // 2
    moment = "half way"
    happened = []
    for rollout in rollouts:
        names = [rollout.renderer, rollout.policy] if names_policy else [rollout.renderer]
        label = " \u00b7 ".join([*names, f"seed {rollout.seed}"])
        for event in events_of(rollout, series):
            text = f"{label}: {event.what} at a time that no step shows"
            mark: JsonObject = {"colour": variant_of[rollout.renderer, rollout.policy][0]}
            mark |= {"kind": event.kind, "folder": rollout.path}
            if event.t_us is not None:
                happened.append((event.t_us, event.what))
                text = f"{label}: {event.what} at {fixed((event.t_us - place.zero_us) * 1e-6, 1)}\u00a0s"
            if event.x_m is not None and event.y_m is not None and event.yaw_rad is not None:
                ahead = np.array([np.cos(event.yaw_rad), np.sin(event.yaw_rad)])
                centre = np.array([event.x_m, event.y_m]) + vehicle["rear_axle_to_centre_m"] * ahead
                text += f", x {fixed(centre[0], 1)}, y {fixed(centre[1], 1)}\u00a0m"
                mark |= body(centre, event.yaw_rad, vehicle, place)
            marks.append(mark | {"text": text})
    if happened:
        at_us, event_name = min(happened)
        moment = f"when the first {event_name} happens"
    users = []
    line = shapely.linestrings(recorded)
    for actor in content.get("actors") or ():
        if actor["x_m"]:
            xy = np.column_stack([actor["x_m"], actor["y_m"]]).astype(float)
            step = int(np.argmin(np.abs(np.asarray(actor["t_us"]) - at_us)))
            user = {"label": actor["label"] or "other"}
            user |= body(xy[step], actor["yaw_rad"][step], actor, place)
            if float(np.ptp(xy, axis=0).max()) > LEAST_PATH_M:
                user["way"] = path(xy, place)
            users.append((float(shapely.distance(shapely.points(xy), line).min()), user))
    users.sort(key=lambda pair: pair[0])
    return {
        "scene": scene,
        "map": map_data(content, recorded, place),
        "tracks": tracks,
        "marks": marks,
        "users": [user for _, user in users[:MAX_ACTORS]],
        "users_at": f"at {fixed((at_us - place.zero_us) * 1e-6, 1)}\u00a0s, {moment}",
    }


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
