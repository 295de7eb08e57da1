"""How many contacts each preset sees in random passes, by the length of the step.

Run: ``python docs/scripts/contact_sampling.py 300``. Ego and one road user drive straight on at 0
    to 20 m/s in any two directions; after
4 s their centres are within 5 m. The truth is `strict` at steps of 20 ms.
"""

from __future__ import annotations

import sys

import numpy as np

from alpasim_plugin.core.geometry import quat_from_yaw
from alpasim_plugin.core.types import Actor, Box, RolloutLog, Trajectory
from evaluators import contact_events
from evaluators.metrics.contact import find_contacts
from evaluators.metrics.footprint import ActorTable, ego_footprints, origin_of
from evaluators.metrics.presets import PRESETS

STEPS_MS = (20, 100, 200, 500)
CAR = Box(4.855, 1.88, 1.5)


def straight(t_us: np.ndarray, middle: np.ndarray, speed: float, yaw: float) -> Trajectory:
    """A drive that is at a place after 4 s."""
    along = (t_us * 1e-6 - 4.0)[:, None] * speed * np.array([np.cos(yaw), np.sin(yaw), 0.0])
    return Trajectory(t_us, np.append(middle, 0.0) + along, quat_from_yaw(np.full(len(t_us), yaw)))


def touches(draw: np.ndarray, step_ms: int, preset: str) -> bool:
    """Whether a preset sees a contact."""
    t_us = np.arange(0, 8_000_001, step_ms * 1000, dtype=np.int64)
    speed, other, yaw, turn, away, side = draw
    ego = straight(t_us, np.zeros(2), 20 * speed, 6.28 * yaw)
    middle = 5 * away * np.array([np.cos(6.28 * side), np.sin(6.28 * side)])
    actor = Actor("a", "car", CAR, straight(t_us, middle, 20 * other, 6.28 * turn))
    log = RolloutLog(
        "s", "u", CAR, np.eye(4), ego, {"a": actor}, (), (), ego, 0, 0, 0, step_ms * 1000
    )
    if preset == "strict":
        return bool(contact_events(log, preset))
    chosen = PRESETS[preset]
    origin = origin_of(ego, chosen)
    return bool(
        len(
            find_contacts(
                ego_footprints(log, chosen, origin), ActorTable(log, chosen, origin), t_us
            )[0].step
        )
    )


def main(passes: int) -> None:
    """Print the table of docs/presets.md."""
    draws = np.random.default_rng(0).random((passes, 6))
    print(
        "| preset | "
        + " | ".join(f"{ms} ms" for ms in STEPS_MS)
        + " |\n|---" * 1
        + "|---" * len(STEPS_MS)
        + "|"
    )
    for preset in ("paper", "strict"):
        seen = [100 * np.mean([touches(draw, ms, preset) for draw in draws]) for ms in STEPS_MS]
        print(
            f"| `{preset}` | " + " | ".join(f"{share:.1f} %" for share in seen) + " |", flush=True
        )


if __name__ == "__main__":
    main(int(sys.argv[1]))
