"""How a run and a rollout look in a notebook: a sentence, a small table, a strip of frames. Everything from a file is escaped."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from alpasim_plugin.run_folder.rows import Rollout
from evaluators.metrics import MetricInfo
from evaluators.opening import Run
from evaluators.report.flips import inline_jpeg
from evaluators.report.headline import find
from evaluators.report.numbers import DASH, short
from evaluators.report.tables import metric_rows

MOST_RENDERERS = 6
LEFT = 'style="text-align:left"'


def run_html(run: Run) -> str:
    """Return a run: its verdict, its headline metrics by renderer, and a strip of frames of its first rollout."""
    rows = metric_rows(run.summary, known=run.table)
    rows = [row for row in rows if row.is_headline] or rows
    names = list(run.summary.get("metrics") or {})[:MOST_RENDERERS]
    lines = []
    for row in rows:
        label = " ".join(part for part in (row.name, row.unit, row.arrow) if part)
        cells = [f"{cell.text} <small>{escape(cell.detail or cell.count)}</small>" for cell in row.cells[: len(names)]]
        lines.append([escape(label), *cells])
    first = next((rollout for rollout in run.rollouts if run.file_of(rollout, "strip.jpg") is not None), None)
    preset = escape(str(run.summary.get("preset")))
    return _block(
        f"<b>{escape(find(run).title)}</b>",
        f"{len(run.rollouts)} rollouts, {len(run.scenes)} scenes, preset {preset}: {escape(str(run.folder))}",
        _table(["", *(escape(name) for name in names)], lines),
        "" if first is None else _picture(run, first),
    )


def rollout_html(run: Run, rollout: Rollout) -> str:
    """Return a rollout: how it ended, its headline metrics, and its strip of frames."""
    metrics = [run.table.shown(name) for name in run.table.ordered(rollout.metrics)]
    metrics = [metric for metric in metrics if metric.is_headline] or metrics
    lines = [[escape(metric.name), _number(rollout.metrics.get(metric.name), metric)] for metric in metrics]
    return _block(
        f"<b>{escape(outcome(rollout))}</b>",
        escape(title(rollout)),
        _table(["metric", "value"], lines),
        _picture(run, rollout),
    )


def title(rollout: Rollout) -> str:
    """Name a rollout."""
    return f"{rollout.renderer}, {rollout.policy}, {rollout.scene}, seed {rollout.seed}"


def outcome(rollout: Rollout) -> str:
    """Say in a few words how a rollout ended."""
    if not rollout.ok:
        return f"failed ({rollout.failure_class}): {rollout.failure}"
    events = [word for word, metric in (("collision", "collision_any"), ("off-road", "offroad")) if rollout.flag(metric)]
    return " and ".join(events) or "no event"


def _number(value: float | None, metric: MetricInfo) -> str:
    if value is None:
        return DASH
    return f"{100 * value:.1f} %" if metric.in_percent else escape(short(value, metric.unit))


def _picture(run: Run, rollout: Rollout) -> str:
    path = run.file_of(rollout, "strip.jpg")
    picture = None if path is None else inline_jpeg(path)
    if picture is None:
        return "<small>no frames: the policy has no camera, or the rollout failed</small>"
    source, width, height = picture
    words = escape(f"frames of {title(rollout)}", quote=True)
    return f'<img src="{source}" width="{width}" height="{height}" style="max-width:100%;height:auto" alt="{words}">'


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    heads = "".join(f'<th scope="col" {LEFT}>{cell}</th>' for cell in head)
    lines = [f'<tr><th scope="row" {LEFT}>{row[0]}</th>' + "".join(f"<td>{cell}</td>" for cell in row[1:]) + "</tr>" for row in rows]
    return f"<table><thead><tr>{heads}</tr></thead><tbody>{''.join(lines)}</tbody></table>"


def _block(*parts: str) -> str:
    return "<div>" + "".join(f"<div>{part}</div>" for part in parts if part) + "</div>"
