"""Digests of a rollout by component and time, and the first difference of two rollouts."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from alpasim_plugin.core.atomic import atomic_file
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.reading import read_json_lines
from alpasim_plugin.log.asl import AslReader
from alpasim_plugin.log.schema import EGO

# In the order in which the loop makes them at one instant: poses of the ego and of the other road
# users, frames of the cameras, plans of the policy.
COMPONENTS = ("ego", "actors", "frames", "plans")

Fact = str | int | float | bool | None
Key = tuple[int, str]  # time in microseconds, part of the component, such as a camera
Trace = Mapping[str, Mapping[Key, str]]  # component -> key -> SHA-256


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
    rows: list[dict[str, Fact]] = read_json_lines(path, do_this="run the rollout again")
    return rows


@dataclass(frozen=True)
class Difference:
    """The first place where two rollouts are not the same."""

    component: str
    t_us: int
    step: int | None  # control step; None before the first frame
    what: str

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return asdict(self)

    def __str__(self) -> str:
        at = f"step {self.step}" if self.step is not None else "before the first frame"
        return f"{self.component} at {at} ({self.what}, t = {self.t_us} us)"


def trace_log(path: Path, facts: Iterable[Mapping[str, Fact]] = ()) -> dict[str, dict[Key, str]]:
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
    parts: dict[str, dict[Key, str]] = {name: {} for name in COMPONENTS}
    asked_us = 0
    for entry in AslReader(path):
        kind = entry.WhichOneof("log_entry")
        if kind == "actor_poses":
            poses = entry.actor_poses
            parts["ego"][poses.timestamp_us, "pose"] = _joined(
                p.SerializeToString() for p in poses.actor_poses if p.actor_id == EGO
            )
            parts["actors"][poses.timestamp_us, "poses"] = _joined(
                p.SerializeToString() for p in poses.actor_poses if p.actor_id != EGO
            )
        elif kind == "controller_return":
            states = entry.controller_return.states
            parts["ego"][states[-1].timestamp_us, "motion"] = _joined(
                state.SerializeToString() for state in states
            )
        elif kind == "driver_camera_image":
            image = entry.driver_camera_image.camera_image
            parts["frames"][image.frame_end_us, f"camera {image.logical_id} as logged"] = sha256(
                image.image_bytes
            )
        elif kind == "driver_request":
            asked_us = entry.driver_request.time_now_us
        elif kind == "driver_return":
            parts["plans"][asked_us, "plan"] = sha256(entry.driver_return.SerializeToString())
    for fact in facts:
        text = json.dumps(
            {name: value for name, value in fact.items() if not name.endswith("_ms")},
            sort_keys=True,
        )
        t_us, camera = fact.get("t_us"), fact.get("camera")
        if not isinstance(t_us, int) or not isinstance(camera, str):
            raise InputError(
                f"{path}: frame facts of camera {camera!r} at t_us {t_us!r}",
                "run the rollout again: its facts are damaged",
            )
        parts["frames"][t_us, f"camera {camera}"] = sha256(text.encode())
    return parts


def first_difference(
    one: Trace,
    other: Trace,
    start_us: int,
    control_us: int,
    until_us: Mapping[str, int] | None = None,
) -> Difference | None:
    """Return the earliest difference of two rollouts, or None.

    An entry that only one of them has is a difference too. At equal times the component that the
    loop makes first is named.

    Args:
        one: A rollout.
        other: Another one.
        start_us: Time of the first frame, from which steps are counted.
        control_us: Length of a step.
        until_us: Component -> first time that is not compared. None compares everything.
    """
    differences = []
    for rank, component in enumerate(COMPONENTS):
        a = one.get(component, {})
        b = other.get(component, {})
        for t_us, part in {**a, **b}:
            compared = until_us is None or t_us < until_us[component]
            if compared and a.get((t_us, part)) != b.get((t_us, part)):
                in_both = (t_us, part) in a and (t_us, part) in b
                text = part if in_both else f"{part}, in one only"
                differences.append((t_us, rank, text))
    if not differences:
        return None
    t_us, rank, text = min(differences)
    step = (t_us - start_us) // control_us if t_us >= start_us else None
    return Difference(COMPONENTS[rank], t_us, step, text)


def sha256(data: bytes) -> str:
    """Return the hexadecimal SHA-256 of some bytes."""
    return hashlib.sha256(data).hexdigest()


def _joined(parts: Iterable[bytes]) -> str:
    return sha256(b"".join(len(part).to_bytes(4, "big") + part for part in parts))
