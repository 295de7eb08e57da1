"""Query one policy at the same poses behind several renderers: the effect of the renderer alone on
the plans.

The logged rollout is replayed with its own parts and compared with its log. Every renderer under
test renders every request. Each has a policy instance of its own, which sees its frames and is
queried at the same instants. Only the plans of the logged renderer's policy drive.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from alpasim_plugin.core.atomic import write_bytes, write_json
from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.geometry import quat_from_yaw
from alpasim_plugin.core.interfaces import Policy, Renderer
from alpasim_plugin.core.parts import resolve_renderer
from alpasim_plugin.core.places import temporary_folder
from alpasim_plugin.core.types import (
    F64,
    Frame,
    Observation,
    Plan,
    RenderRequest,
    Route,
    SensorSpec,
    Trajectory,
)
from alpasim_plugin.log import encode_image
from alpasim_plugin.log.run_folder.schema import PROBE_JSON, PROBE_PLOT, PROBE_TABLE, probe_folder
from alpasim_plugin.log.run_folder.writer import write_table
from alpasim_plugin.log.trace import first_difference
from alpasim_plugin.runs.cell import build_parts
from alpasim_plugin.runs.certificate import log_trace
from alpasim_plugin.runs.execute import thread_budget
from alpasim_plugin.runs.guards import checked_frames, checked_plan
from alpasim_plugin.runs.logged_rollout import LoggedRollout
from alpasim_plugin.runs.recorder import Recorder
from alpasim_plugin.runs.rollout import run_rollout
from evaluators.metrics.plan import DIVERGED_M, HORIZON_US, plan_gap

HORIZONS_S = (1.0, 3.0)
DOING = "probing renderers along a logged rollout"
SCHEMA = pa.schema(
    [
        ("reference", pa.string()),
        ("renderer", pa.string()),
        ("t_us", pa.int64()),
        ("after_us", pa.int64()),
    ]
    + [
        (f"{what}_{h:g}s_{unit}", pa.float64())
        for h in HORIZONS_S
        for what, unit in (("gap", "m"), ("turn", "rad"))
    ]
    + [("levels", pa.float64())]
)


@dataclass(frozen=True)
class PolicyQuery:
    """The plans of one query and the frames they were made from, by renderer."""

    t_us: int
    plans: Mapping[str, Plan]
    frames: Mapping[str, Frame]  # of the policy's first camera; none for a policy without one
    observation: Observation  # behind the driving renderer


@dataclass(frozen=True)
class Pair:
    """A renderer compared with the reference over all queries ``(Q,)``.

    Attributes:
        gap_m: Distance between the plans at `HORIZONS_S` ``(Q, 2)``; NaN where a plan ends earlier.
        turn_rad: Heading of the renderer's plan minus that of the reference's ``(Q, 2)``.
        levels: Mean absolute difference of the two images, 8-bit levels ``(Q,)``.
        first: Row of the first divergence as in `evaluators.metrics.plan`, or None.
        first_gap_m: The gap there, at the horizon or the end of the shorter plan.
    """

    reference: str
    renderer: str
    gap_m: F64
    turn_rad: F64
    levels: F64
    first: int | None
    first_gap_m: float | None


@dataclass(frozen=True)
class Probe:
    """Result of a probe."""

    queries: tuple[PolicyQuery, ...]
    pairs: tuple[Pair, ...]


class _MultiRenderer(Renderer):
    """Renders every request with all renderers and returns the driving renderer's frames."""

    def __init__(self, renderers: Mapping[str, Renderer], driver: str) -> None:
        self.renderers, self.driver = renderers, driver
        self.block = renderers[driver].block
        other = next(
            (name for name, renderer in renderers.items() if renderer.block != self.block), None
        )
        if other is not None:
            raise InputError(
                f"--renderers {','.join(renderers)}: {other!r} renders {renderers[other].block or 'frames one by one'}, {driver!r} {self.block or 'frames one by one'}",
                "choose the mode 'speculative' for both",
            )
        self.lookahead = max(renderer.lookahead for renderer in renderers.values())
        self.latest: dict[str, dict[str, Frame]] = {name: {} for name in renderers}

    def render(self, request: RenderRequest) -> Frame:
        return self.render_batch([request])[0]

    def render_batch(self, requests: Sequence[RenderRequest]) -> Sequence[Frame]:
        for name, renderer in self.renderers.items():
            frames = checked_frames(renderer, requests)
            self.latest[name] |= {frame.camera: frame for frame in frames}
            if name == self.driver:
                driven, self.stage_ms = frames, dict(renderer.stage_ms)
        return driven


@dataclass
class _MultiPolicy(Policy):
    """Queries one policy per renderer, each with its renderer's frames, and returns the driving
    renderer's plan.
    """

    policies: Mapping[str, Policy]
    renderer: _MultiRenderer
    queries: list[PolicyQuery] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.sensors: Sequence[SensorSpec] = self.policies[self.renderer.driver].sensors

    def reset(self, seed: int, route: Route) -> None:
        for policy in self.policies.values():
            policy.reset(seed, route)

    def act(self, observation: Observation) -> Plan:
        latest = self.renderer.latest
        plans = {
            name: checked_plan(policy, replace(observation, frames=dict(latest[name])))
            for name, policy in self.policies.items()
        }
        frames = (
            {name: latest[name][self.sensors[0].camera] for name in self.policies}
            if self.sensors
            else {}
        )
        self.queries.append(PolicyQuery(observation.t_us, plans, frames, observation))
        return plans[self.renderer.driver]


def probe_rollout(past: LoggedRollout, renderers: Sequence[str]) -> Probe:
    """Query the policy of a logged rollout at its logged poses behind several renderers.

    Args:
        past: The logged rollout, which is replayed.
        renderers: Which to compare; the first is the reference. The logged renderer need not be
            among them.

    Raises:
        InputError: Fewer than two renderers, a policy without cameras, measured latency, or
            renderers with different blocks.
        InfrastructureError: The replay is not equal to the log.
        RendererError: A renderer failed.
        PolicyError: The policy failed with one of them.
    """
    if len(set(renderers)) < 2 or len(set(renderers)) < len(renderers):
        raise InputError(
            f"--renderers {','.join(renderers)}: fewer than two, or one of them twice",
            "name two renderers",
        )
    queries = replay(past, renderers, must_see=True)
    return Probe(queries, tuple(compare(queries, renderers[0], name) for name in renderers[1:]))


def replay(
    past: LoggedRollout, renderers: Sequence[str] = (), must_see: bool = False
) -> tuple[PolicyQuery, ...]:
    """Drive a logged rollout again and return its queries, with what these renderers beside its own
    show at its poses.

    Raises:
        As `probe_rollout`.
    """
    past.check_repeatable()
    own, threads = past.cell, thread_budget(1, 1).per_worker
    specs = {own.renderer.name: own.renderer} | {
        name: resolve_renderer(name, past.options.fixer)
        for name in renderers
        if name != own.renderer.name
    }
    parts = {
        name: build_parts(replace(own, renderer=spec), past.options, past.scenario, threads)
        for name, spec in specs.items()
    }
    renderer = _MultiRenderer({name: p.renderer for name, p in parts.items()}, own.renderer.name)
    policy = _MultiPolicy({name: p.policy for name, p in parts.items()}, renderer)
    if must_see and not policy.sensors:
        raise InputError(
            f"{past.name}: the policy {own.policy.name!r} has no camera",
            "probe a rollout of a policy with cameras",
        )
    with temporary_folder("simrun-probe-") as folder:
        with Recorder(
            past.scenario, own.seed, Path(folder), own.rollout_key, past.options.images
        ) as recorder:
            run_rollout(
                past.scenario,
                renderer,
                policy,
                own.seed,
                recorder,
                parts[own.renderer.name].controller,
            )
        one, other = log_trace(past.folder), log_trace(Path(folder))
    difference = first_difference(
        one, other, past.scenario.start_us, past.scenario.rates.control_us
    )
    if difference is not None:
        raise InfrastructureError(
            f"{past.name}: its replay differs from the log: {difference}",
            "use the machine and the versions in run.json, or run the rollout again",
        )
    return tuple(policy.queries)


def compare(queries: Sequence[PolicyQuery], reference: str, renderer: str) -> Pair:
    """Compare the plans of two renderers over all queries."""
    n = len(queries)
    first = None
    first_gap = None
    gap = np.full((n, len(HORIZONS_S)), np.nan)
    turn = np.full((n, len(HORIZONS_S)), np.nan)
    levels = np.zeros(n)
    for row, query in enumerate(queries):
        # Plans as rig poses in the frame of the query, which all renderers share.
        plans = [query.plans[name] for name in (reference, renderer)]
        a, b = (
            Trajectory(
                p.times_us, np.column_stack([p.xy, np.zeros(len(p.times_us))]), quat_from_yaw(p.yaw)
            )
            for p in plans
        )
        end_us = min(query.t_us + HORIZON_US, int(a.t_us[-1]), int(b.t_us[-1]))
        distances, turns = plan_gap(
            a, b, [*(query.t_us + round(h * 1e6) for h in HORIZONS_S), end_us]
        )
        gap[row], turn[row] = distances[:-1], turns[:-1]
        if first is None and distances[-1] > DIVERGED_M:
            first, first_gap = row, float(distances[-1])
        images = (query.frames[name].rgb.astype(np.int16) for name in (reference, renderer))
        levels[row] = float(np.mean(np.abs(np.subtract(*images))))
    return Pair(reference, renderer, gap, turn, levels, first, first_gap)


def summarise(pair: Pair, queries: Sequence[PolicyQuery], start_us: int) -> dict[str, Any]:
    """Return the numbers of a pair for JSON, without the frames."""
    out: dict[str, Any] = {
        "reference": pair.reference,
        "renderer": pair.renderer,
        "queries": len(queries),
    }
    for j, horizon in enumerate(HORIZONS_S):
        known = pair.gap_m[np.isfinite(pair.gap_m[:, j]), j]
        turns = np.abs(pair.turn_rad[np.isfinite(pair.turn_rad[:, j]), j])
        stats = {"median": 50, "p95": 95, "max": 100}
        out[f"gap_{horizon:g}s_m"] = (
            {k: round(float(np.percentile(known, q)), 4) for k, q in stats.items()}
            if len(known)
            else None
        )
        out[f"turn_{horizon:g}s_rad"] = (
            {k: round(float(np.percentile(turns, q)), 5) for k, q in stats.items()}
            if len(turns)
            else None
        )
    out["levels_mean"] = round(float(np.mean(pair.levels)), 3) if len(pair.levels) else None
    out["first_divergence"] = None
    if pair.first is not None and pair.first_gap_m is not None:
        t_us = queries[pair.first].t_us
        out["first_divergence"] = {
            "t_us": t_us,
            "after_us": t_us - start_us,
            "gap_m": round(pair.first_gap_m, 4),
        }
    return out


def write_probe(
    probe: Probe, past: LoggedRollout, renderers: tuple[str, ...], out: Path | None = None
) -> Path:
    """Write ``probe.parquet``, ``probe.json``, ``probe.png`` and the frames of each first
    divergence; return the folder.

    Args:
        probe: The probe.
        past: The rollout it went along.
        renderers: The renderers compared.
        out: Folder; by default one below ``probes/`` in the rollout's run folder, where the report
            looks.
    """
    cell = past.cell
    folder = out or past.root / probe_folder(
        cell.renderer.name, cell.policy.name, cell.scene, cell.seed, renderers
    )
    folder.mkdir(parents=True, exist_ok=True)
    start_us = past.scenario.start_us
    pairs, rows = [], []
    for number, pair in enumerate(probe.pairs):
        entry = summarise(pair, probe.queries, start_us)
        if pair.first is not None:
            frames = probe.queries[pair.first].frames
            names = {
                name: f"first-{number}-{side}.jpg"
                for side, name in enumerate((pair.reference, pair.renderer))
            }
            for name, file in names.items():
                write_bytes(folder / file, encode_image(frames[name].rgb, "jpeg", 85))
            entry["first_divergence"]["frames"] = names
        pairs.append(entry)
        for i, query in enumerate(probe.queries):
            row = {
                "reference": pair.reference,
                "renderer": pair.renderer,
                "t_us": query.t_us,
                "after_us": query.t_us - start_us,
            }
            for j, h in enumerate(HORIZONS_S):
                row |= {
                    f"gap_{h:g}s_m": _number(pair.gap_m[i, j]),
                    f"turn_{h:g}s_rad": _number(pair.turn_rad[i, j]),
                }
            rows.append(row | {"levels": float(pair.levels[i])})
    write_table(folder / PROBE_TABLE, rows, SCHEMA)
    about = {
        "along": past.name,
        "renderers": list(renderers),
        "threshold_m": DIVERGED_M,
        "horizon_s": HORIZON_US * 1e-6,
        "pairs": pairs,
    }
    write_json(folder / PROBE_JSON, about)
    _plot(folder / PROBE_PLOT, probe, past)
    return folder


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _plot(path: Path, probe: Probe, past: LoggedRollout) -> None:
    start_us, warmup_s = past.scenario.start_us, past.scenario.warmup_us * 1e-6
    seconds = np.array([query.t_us - start_us for query in probe.queries]) * 1e-6
    figure = Figure(figsize=(9.0, 6.4), layout="constrained")
    FigureCanvasAgg(figure)
    above, middle, below = figure.subplots(3, 1, sharex=True)
    for k, pair in enumerate(probe.pairs):
        for j, (horizon, style) in enumerate(zip(HORIZONS_S, ("--", "-"), strict=True)):
            label = f"{pair.renderer}, {horizon:g} s ahead"
            above.plot(seconds, pair.gap_m[:, j], style, color=f"C{k}", label=label)
            middle.plot(seconds, np.rad2deg(pair.turn_rad[:, j]), style, color=f"C{k}", label=label)
        below.plot(seconds, pair.levels, color=f"C{k}", label=pair.renderer)
        if pair.first is not None:
            above.axvline(seconds[pair.first], color=f"C{k}", linewidth=0.8, alpha=0.6)
    above.axhline(
        DIVERGED_M, color="0.5", linestyle=":", linewidth=1.0, label=f"diverged: {DIVERGED_M} m"
    )
    above.set_ylabel("distance of plans, m")
    middle.set_ylabel("heading difference, degrees")
    below.set_ylabel("image difference, 8-bit levels")
    below.set_xlabel("time since the first frame, s")
    above.set_ylim(bottom=0.0)
    below.set_ylim(bottom=0.0)
    for axes in (above, middle, below):
        axes.axvspan(0.0, warmup_s, color="0.92", zorder=0)
        axes.grid(color="0.9")
        axes.spines[["top", "right"]].set_visible(False)
    above.legend(fontsize=8, loc="upper left")
    reference = probe.pairs[0].reference
    above.set_title(
        f"{past.cell.policy.name} along {past.cell.scene}, seed {past.cell.seed}: compared with {reference} (grey: warm-up)",
        fontsize=10,
    )
    figure.savefig(path, dpi=110)
