"""How a run ends on a terminal: the verdict in a sentence, the paired differences behind it, the cost, the next command worth trying."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

from alpasim_plugin.run_folder.reader import Run
from alpasim_plugin.run_folder.rows import Rollout
from evaluators.report.flips import find_flips
from evaluators.report.headline import Finding, find
from evaluators.report.numbers import finite, fixed

LABEL = 9  # width of the labels
MORE_SCENES = "suites/urban"
SEEING = "lane-camera"  # a shipped policy with a camera


def ending_lines(run: Run) -> list[str]:
    """Return the last lines of a run's terminal output, without the path of its report.

    Args:
        run: A finished run.
    """
    finding = find(run)
    lines = [_line("verdict", finding.title)]
    lines += [_line("", f"{finding.name_of(point)}: {point.lead}") for point in finding.points if point.lead]
    cost = cost_text(run.summary)
    return [*lines, *([_line("cost", cost)] if cost else [])]


def next_line(run: Run) -> str:
    """Return the line that names the next command worth trying, and why."""
    command, why = next_command(run, find(run))
    return _line("next", f"{shlex.join(command)}   # {why}")


def cost_text(summary: Mapping[str, Any]) -> str:
    """Say what a camera frame costs behind each renderer: the mean, which is what a drive pays; empty where nothing was timed."""
    means = {name: finite(times.get("ms_per_frame_mean")) for name, times in (summary.get("speed") or {}).items()}
    parts = [f"{name} {fixed(ms, 0 if ms >= 10 else 1)} ms" for name, ms in means.items() if ms is not None]
    return f"{', '.join(parts)} a frame, the whole loop (mean)" if parts else ""


def next_command(run: Run, finding: Finding) -> tuple[list[str], str]:
    """Choose the command that most helps with what was found, and say why.

    Returns:
        Its words, and the reason.
    """
    failed = [r for r in run.rollouts if not r.ok]
    if any(r.failure_class == "policy" for r in failed):
        policy = next(r.policy for r in failed if r.failure_class == "policy")
        return ["simrun", "check-policy", policy], "finds every fault of the policy in seconds"
    if failed:
        return ["simrun", "check", str(run.folder)], "says what is damaged or missing; the same command runs it again"
    if all(r.frames == 0 for r in run.rollouts):
        names = ",".join(run.renderers if len(run.renderers) > 1 else [*run.renderers, _other(run)])
        why = "a policy that looks: without a camera it drives alike behind every renderer"
        return _again(run, names, run.scenes_asked or [MORE_SCENES], SEEING), why
    if not finding.points:
        more = _other(run)
        names = ",".join([*run.renderers, more])
        return _again(run, names, run.scenes_asked or [MORE_SCENES]), f"compares with {more}, pair by pair"
    flips, _ = find_flips(run)
    if flips:
        return _probe(run, flips[0].other, flips[0].base.renderer), "the same poses behind both: where the plans part"
    if finding.tone == "unclear":
        return _again(run, ",".join(run.renderers), [MORE_SCENES]), "more scenes: the interval is too wide to decide"
    worst = max((r for r in run.rollouts if r.renderer == finding.points[0].name), key=_away, default=run.rollouts[0])
    return _probe(run, worst, finding.points[0].baseline), "the same poses behind both renderers: how far the plans differ, frame by frame"


def _away(rollout: Rollout) -> float:
    return rollout.metrics.get("lateral_distance_m") or 0.0


def _probe(run: Run, rollout: Rollout, baseline: str) -> list[str]:
    cell = f"{rollout.renderer}/{rollout.policy}/{rollout.scene}/{rollout.seed}"
    return ["simrun", "probe", str(run.folder), "--cell", cell, "--renderers", ",".join(dict.fromkeys([baseline, rollout.renderer]))]


def _other(run: Run) -> str:
    return "3dgs" if "3dgs" not in run.renderers else "onefixer"


def _again(run: Run, renderers: str, scenes: list[str], policy: str = "") -> list[str]:
    seeds = max(1, len(run.info.get("seeds") or ()))
    return ["simrun", "--renderer", renderers, "--policy", policy or ",".join(run.policies), "--seeds", str(seeds), *scenes]


def _line(label: str, text: str) -> str:
    return f"{label:<{LABEL}}{text}".replace("\u00a0", " ")
