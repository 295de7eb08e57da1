"""Digests of a rollout by component and time, and the first difference of two rollouts."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parsing, read_json_lines
from alpasim_plugin.core.files.atomic import atomic_file
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.log.asl import AslReader
from alpasim_plugin.log.schema import EGO

# In the order in which the loop makes them at one instant: poses of the ego and of the other road
# users, frames of the cameras, plans of the policy.
COMPONENTS = ("ego", "actors", "frames", "plans")

Fact = str | int | float | bool | None
Key = tuple[int, str, str]  # time in microseconds, component, and part of it, such as a camera
Trace = dict[Key, str]  # key -> SHA-256


def write_facts(path: Path | str, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write one JSON object a line, such as ``{"t_us": 100000, "camera": "front", "alpha_mean":
    0.98, "render_ms": 12.1}``.

    The file appears under its name only once complete. NaN and infinities are refused: a fact that
    is missing is left out.

    Raises:
        InputError: A value that JSON cannot hold.
        InfrastructureError: The disk refuses.
    """
    path = Path(path)
    try:
        with (
            atomic_file(path) as partial,
            partial.open("w", encoding="utf-8") as stream,
        ):
            stream.writelines(json.dumps(dict(row), allow_nan=False) + "\n" for row in rows)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{path}: {error}",
            "give finite numbers, text or booleans",
        ) from error


def read_facts(path: Path | str) -> list[dict[str, Fact]]:
    """Read what `write_facts` wrote.

    Raises:
        InputError: Missing file, or a line that is no JSON object.
    """
    return read_json_lines(path, do_this="run the rollout again")


def trace_log(path: Path, facts: Iterable[Mapping[str, Fact]]) -> Trace:
    """Read the components of a rollout out of its log.

    Names of sessions and services are not part of any component: rollouts of different names can be
    equal.

    Args:
        path: The ``.asl`` file.
        facts: Rows of the frame facts beside it: they hold the digest of the pixels before the
            log's image compression. Times that were measured (names ending in ``_ms``) are left
            out.

    Raises:
        InputError: The log is missing or damaged.
    """
    trace: Trace = {}
    asked_us = 0
    for entry in AslReader(path):
        kind = entry.WhichOneof("log_entry")
        if kind == "actor_poses":
            poses = entry.actor_poses
            ego = [pose.SerializeToString() for pose in poses.actor_poses if pose.actor_id == EGO]
            others = [
                pose.SerializeToString() for pose in poses.actor_poses if pose.actor_id != EGO
            ]
            trace[poses.timestamp_us, "ego", "pose"] = _joined(ego)
            trace[poses.timestamp_us, "actors", "poses"] = _joined(others)
        elif kind == "controller_return":
            states = entry.controller_return.states
            motion = _joined(state.SerializeToString() for state in states)
            trace[states[-1].timestamp_us, "ego", "motion"] = motion
        elif kind == "driver_camera_image":
            image = entry.driver_camera_image.camera_image
            part = f"camera {image.logical_id} as logged"
            trace[image.frame_end_us, "frames", part] = _sha256(image.image_bytes)
        elif kind == "driver_request":
            asked_us = entry.driver_request.time_now_us
        elif kind == "driver_return":
            trace[asked_us, "plans", "plan"] = _sha256(entry.driver_return.SerializeToString())
    with parsing(path, "run the rollout again", "its frame facts are damaged"):
        for fact in facts:
            lasting = {name: value for name, value in fact.items() if not name.endswith("_ms")}
            text = json.dumps(lasting, sort_keys=True)
            key = int(str(fact["t_us"])), "frames", f"camera {fact['camera']}"
            trace[key] = _sha256(text.encode())
    return trace


def first_difference(
    trace: Trace,
    other: Trace,
    start_us: int,
    control_us: int,
    until_us: Mapping[str, int] | None = None,
) -> JsonObject | None:
    """Return the earliest difference of two rollouts, or None.

    An entry that only one of them has is a difference too. At equal times the component that the
    loop makes first is named.

    Args:
        trace: A rollout.
        other: Another one.
        start_us: Time of the first frame, from which steps are counted.
        control_us: Length of a step.
        until_us: Component -> first time that is not compared. None compares everything.

    Returns:
        ``component``, ``t_us``, ``step`` (None before the first frame) and ``what``.
    """
    differences = []
    for key in trace | other:
        t_us, component, part = key
        is_compared = until_us is None or t_us < until_us[component]
        if is_compared and trace.get(key) != other.get(key):
            text = part if key in trace and key in other else f"{part}, in one only"
            differences.append((t_us, COMPONENTS.index(component), text))
    if not differences:
        return None
    t_us, rank, text = min(differences)
    step = (t_us - start_us) // control_us if t_us >= start_us else None
    return {"component": COMPONENTS[rank], "t_us": t_us, "step": step, "what": text}


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _joined(parts: Iterable[bytes]) -> str:
    return _sha256(b"".join(len(part).to_bytes(4, "big") + part for part in parts))
