"""Each rollout of a run: when and where its outcomes began, and all of them as columns inside the
page.

The browser draws the table row by row as it is scrolled, so it may have any length. The page holds
one block: a header in JSON, then the columns as bytes, compressed together. 100,000 rollouts with
25 metrics take some seven megabytes; a row of HTML each would take a hundred. Numbers are rounded
to 13 significant bits (four digits), which the tables of the run are not.
"""

from __future__ import annotations

import base64
import gzip
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.types import U8
from alpasim_plugin.log.run_folder.rows import Own, Rollout, Series, series_by_cell
from alpasim_plugin.log.run_folder.schema import WHY_NAME
from evaluators.metrics.outcomes import (
    OUTCOMES,
    POLICY_FAULT,
    has_ended,
    in_words,
    outcomes_of,
    told,
)
from evaluators.opening import Run

COLLISION = (
    "collision_any",
    "collision_at_fault",
    "collision_front",
    "collision_lateral",
    "collision_rear",
)
SIDES = {"collision_front": "front", "collision_lateral": "side", "collision_rear": "rear"}
OTHERS = tuple(
    name for name in OUTCOMES if name != POLICY_FAULT and not name.startswith("collision")
)
SERIES = (
    *COLLISION,
    *OTHERS,
    "eval_relevant",
    "ego_x_m",
    "ego_y_m",
    "ego_yaw_rad",
    "lateral_bias_m",
)


@dataclass(frozen=True)
class Event:
    """The first time of an outcome of one rollout.

    Attributes:
        kind: "collision", or the name of an outcome that touches nothing.
        t_s: Seconds since the rollout's first step; None where no step shows the event that the
            rollout's metric counts.
        t_us: The same instant on the rollout's own clock; None with ``t_s``.
        x_m, y_m, yaw_rad: Pose of the ego's rear axle at that time, world; None with ``t_s`` or
            where poses are not logged.
        side: Which part of the ego was touched, or "".
    """

    kind: str
    rollout: Rollout
    t_s: float | None = None
    x_m: float | None = None
    y_m: float | None = None
    yaw_rad: float | None = None
    side: str = ""
    t_us: int | None = None

    @property
    def what(self) -> str:
        """Name the event."""
        if self.kind != "collision":
            return OUTCOMES[self.kind].words
        return f"collision ({self.side})" if self.side else "collision"


def clock_zero_us(content: Mapping[str, Any], first_us: int) -> int:
    """Return the instant that the times of a scene count from: its first camera frame.

    Args:
        content: ``scenes/SCENE.json``.
        first_us: The first logged pose, which counts where the scene does not say when it runs
            (scored logs of others).
    """
    return max(int(content.get("start_us") or 0), first_us)


def read_series(run: Run, scenes: Sequence[str] | None = None) -> Series:
    """Read every series that events and plots need, for some scenes or all."""
    return series_by_cell(run.steps(SERIES, scenes))


def events_of(rollout: Rollout, series: Series) -> list[Event]:
    """List the events that the rollout's own metrics count, at most one of each kind.

    Steps that do not count (``eval_relevant`` 0, during warm-up) are passed over, so that the time
    shown is that of the event counted.
    """
    own = series.get(rollout.cell, {})
    found = []
    if rollout.flag(*COLLISION):
        found.append(_event("collision", rollout, own, [m for m in COLLISION if rollout.flag(m)]))
    shown = {one.name for one in told(outcomes_of(rollout))}
    return [*found, *(_event(name, rollout, own, [name]) for name in OTHERS if name in shown)]


def _event(kind: str, rollout: Rollout, own: Own, metrics: list[str]) -> Event:
    firsts = {m: t for m in metrics if (t := _first(own, m)) is not None}
    side = next((SIDES[m] for m in metrics if m in SIDES), "")
    if not firsts:
        return Event(kind, rollout, side=side)
    t_us = min(firsts.values())
    zero_us = min(int(t[0]) for t, _ in own.values())
    x_m, y_m, yaw_rad = (_at(own, name, t_us) for name in ("ego_x_m", "ego_y_m", "ego_yaw_rad"))
    return Event(kind, rollout, (t_us - zero_us) * 1e-6, x_m, y_m, yaw_rad, side, t_us)


def _first(own: Own, metric: str) -> int | None:
    if metric not in own:
        return None
    t_us, value = own[metric]
    hit = value >= 0.5
    if "eval_relevant" in own:
        relevant_t, relevant = own["eval_relevant"]
        hit &= np.isin(t_us, relevant_t[relevant >= 0.5])
    return int(t_us[int(np.argmax(hit))]) if hit.any() else None


def _at(own: Own, name: str, t_us: int) -> float | None:
    if name not in own or not own[name][0].size:
        return None
    times, values = own[name]
    return float(values[int(np.argmin(np.abs(times - t_us)))])


MAX_ROLLOUTS = 200_000  # more make a page that browsers are slow with
MAX_TEXT = 300  # letters of a failure's message
KEPT_BITS = 13  # of a number's mantissa
COLLIDED, OTHERWISE, FAILED, HAS_FOLDER, HAS_CLIP, HAS_WHY = (1 << bit for bit in range(6))
CLIP = "front.mp4"


@dataclass(frozen=True)
class RolloutBlock:
    """The block of the page.

    Attributes:
        data: Base64 of the compressed columns.
        shown: Rollouts in it.
        left_out: Rollouts that are not.
    """

    data: str
    shown: int
    left_out: int


def rollout_block(run: Run) -> RolloutBlock:
    """Pack the rollouts of a run.

    The block is gzip of: length of the header (uint32), header (UTF-8 JSON, spaces up to a multiple
    of four), columns. Little-endian. The header names the columns in their order, each ``{"name",
    "type", "values"?}``: type is ``u8``, ``u32`` or ``f32``; the bytes of a column stand by
    significance, all lowest ones first, which compresses better. ``values`` are the texts that a
    ``u32`` column counts through. A missing number is NaN.
    """
    rollouts = run.rollouts[:MAX_ROLLOUTS]
    parents = [os.path.split(r.path) for r in rollouts]
    header: list[dict[str, Any]] = []
    columns: list[U8] = []

    def add(name: str, kind: str, data: npt.NDArray[Any], **more: Any) -> None:
        header.append({"name": name, "type": kind} | more)
        by_significance = data.view(np.uint8).reshape(len(data), data.itemsize).T
        columns.append(np.ascontiguousarray(by_significance).reshape(-1))

    texts: dict[str, Iterable[str]] = {
        "scene": (r.scene for r in rollouts),
        "renderer": (r.renderer for r in rollouts),
        "policy": (r.policy for r in rollouts),
        "seed": (str(r.seed) for r in rollouts),
        "folder": (quote(parent) for parent, _ in parents),
        "leaf": (quote(leaf) for _, leaf in parents),
        "outcome": (in_words(outcomes_of(r)) if has_ended(r) else "failed" for r in rollouts),
        "failure": (
            (f"{r.failure_class or 'unknown cause'}: {r.failure}"[:MAX_TEXT] if not r.ok else "")
            for r in rollouts
        ),
    }
    for name, column in texts.items():
        codes, values = _coded(column)
        add(name, "u32", codes, values=values)
    add("state", "u8", _states(run, parents))
    add(
        "wall_s",
        "f32",
        _rounded([r.wall_s for r in rollouts]),
        unit="s",
        percent=False,
        headline=False,
        flag=False,
    )
    for metric in run.table.ordered(run.metric_names):
        numbers = _rounded([r.metrics.get(metric) for r in rollouts])
        facts = run.table.shown(metric)
        add(
            metric,
            "f32",
            numbers,
            unit=facts.unit,
            percent=facts.in_percent,
            headline=facts.is_headline,
            flag=facts.is_flag,
        )
    head = json.dumps(
        {"rows": len(rollouts), "columns": header, "renderers": run.renderers},
        separators=(",", ":"),
    ).encode()
    head += b" " * (-len(head) % 4)
    packed = gzip.compress(
        np.uint32(len(head)).tobytes() + head + b"".join(one.tobytes() for one in columns),
        compresslevel=9,
        mtime=0,
    )
    return RolloutBlock(
        base64.b64encode(packed).decode(), len(rollouts), len(run.rollouts) - len(rollouts)
    )


def _coded(values: Iterable[str]) -> tuple[npt.NDArray[np.uint32], list[str]]:
    """Return the number of each value ``(N,)``, and the values in order of appearance."""
    known: dict[str, int] = {}
    codes = [known.setdefault(value, len(known)) for value in values]
    return np.array(codes, dtype="<u4"), list(known)


def _rounded(values: Sequence[float | None]) -> npt.NDArray[np.float32]:
    """Return numbers ``(N,)`` with `KEPT_BITS` significant bits, NaN for None; bits that say
    nothing are what does not compress.
    """
    exact = np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    mantissa, exponent = np.frexp(exact)
    return np.asarray(
        np.ldexp(np.round(np.ldexp(mantissa, KEPT_BITS)), exponent - KEPT_BITS), dtype="<f4"
    )


def _states(run: Run, parents: Sequence[tuple[str, str]]) -> U8:
    """Return what each rollout ended with, and which files of it are there, as bits."""
    has_clips = str((run.info.get("config") or {}).get("video") or "none") != "none"
    names: dict[str, frozenset[str]] = {}
    states = []
    for rollout, (parent, leaf) in zip(run.rollouts, parents, strict=False):
        state = 0 if rollout.ok else FAILED
        if rollout.ok:
            had = outcomes_of(rollout)
            state |= COLLIDED if rollout.flag(*COLLISION) else OTHERWISE if had else 0
        if parent not in names:
            names[parent] = frozenset()
            path = run.folder / parent
            if (
                parent and path.is_dir() and path.resolve().is_relative_to(run.folder.resolve())
            ):  # links may lead out of the run
                with os.scandir(path) as found:
                    names[parent] = frozenset(
                        one.name for one in found if one.is_dir(follow_symlinks=False)
                    )
        if leaf in names[parent]:
            state |= HAS_FOLDER | (
                HAS_CLIP if has_clips and (run.folder / parent / leaf / CLIP).is_file() else 0
            )
            state |= (
                HAS_WHY
                if state & (COLLIDED | OTHERWISE)
                and (run.folder / parent / leaf / WHY_NAME).is_file()
                else 0
            )
        states.append(state)
    return np.array(states, dtype=np.uint8)
