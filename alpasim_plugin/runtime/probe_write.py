"""Write a probe: a table, a summary and a plot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from alpasim_plugin.io.atomic import write_bytes, write_json
from alpasim_plugin.log import encode_image
from alpasim_plugin.runtime.logged_rollout import LoggedRollout
from alpasim_plugin.runtime.probe import HORIZONS_S, Probe, summarise
from alpasim_plugin.runtime.probe_files import PROBE_JSON, PROBE_PLOT, PROBE_TABLE, probe_folder
from alpasim_plugin.runtime.store import write_table
from evaluators.plan_gap import DIVERGED_M, HORIZON_US

SCHEMA = pa.schema(
    [("reference", pa.string()), ("renderer", pa.string()), ("t_us", pa.int64()), ("after_us", pa.int64())]
    + [(f"{what}_{h:g}s_{unit}", pa.float64()) for h in HORIZONS_S for what, unit in (("gap", "m"), ("turn", "rad"))]
    + [("levels", pa.float64())]
)


def write_probe(probe: Probe, past: LoggedRollout, renderers: tuple[str, ...], out: Path | None = None) -> Path:
    """Write ``probe.parquet``, ``probe.json``, ``probe.png`` and the frames of each first divergence; return the folder.

    Args:
        probe: The probe.
        past: The rollout it went along.
        renderers: The renderers compared.
        out: Folder; by default one below ``probes/`` in the rollout's run folder, where the report looks.
    """
    cell = past.cell
    folder = out or past.root / probe_folder(cell.renderer.name, cell.policy.name, cell.scene, cell.seed, renderers)
    folder.mkdir(parents=True, exist_ok=True)
    start_us = past.scenario.start_us
    pairs, rows = [], []
    for number, pair in enumerate(probe.pairs):
        entry = summarise(pair, probe.queries, start_us)
        if pair.first is not None:
            frames = probe.queries[pair.first].frames
            names = {name: f"first-{number}-{side}.jpg" for side, name in enumerate((pair.reference, pair.renderer))}
            for name, file in names.items():
                write_bytes(folder / file, encode_image(frames[name].rgb, "jpeg", 85))
            entry["first_divergence"]["frames"] = names
        pairs.append(entry)
        for i, query in enumerate(probe.queries):
            row = {"reference": pair.reference, "renderer": pair.renderer, "t_us": query.t_us, "after_us": query.t_us - start_us}
            for j, h in enumerate(HORIZONS_S):
                row |= {f"gap_{h:g}s_m": _number(pair.gap_m[i, j]), f"turn_{h:g}s_rad": _number(pair.turn_rad[i, j])}
            rows.append(row | {"levels": float(pair.levels[i])})
    write_table(folder / PROBE_TABLE, rows, SCHEMA)
    about = {"along": past.name, "renderers": list(renderers), "threshold_m": DIVERGED_M, "horizon_s": HORIZON_US * 1e-6, "pairs": pairs}
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
    above.axhline(DIVERGED_M, color="0.5", linestyle=":", linewidth=1.0, label=f"diverged: {DIVERGED_M} m")
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
        f"{past.cell.policy.name} along {past.cell.scene}, seed {past.cell.seed}: compared with {reference} (grey: warm-up)", fontsize=10
    )
    figure.savefig(path, dpi=110)
