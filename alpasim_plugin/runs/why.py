"""Find why a drive failed: replay it, show what the policy saw and planned, try single changes, and
drive those that would mend it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.parts import build
from alpasim_plugin.core.places import temporary_folder
from alpasim_plugin.log import read_asl
from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.log.run_folder.schema import LOG_NAME
from alpasim_plugin.runs.cell import RolloutParts, build_parts, run_cell
from alpasim_plugin.runs.execute import thread_budget
from alpasim_plugin.runs.logged_rollout import LoggedRollout
from alpasim_plugin.runs.probe import PolicyQuery, compare, replay
from alpasim_plugin.runs.trials import Changed, Findings, Trial, Tried, investigate
from evaluators.metrics.outcomes import OUTCOMES, in_words
from evaluators.metrics.plan import first_divergence
from evaluators.opening import Run
from evaluators.report.flips import baseline_of
from evaluators.viewer.cause import (
    Cause,
    Look,
    Parting,
    behind_others,
    chosen,
    commands,
    failed_at,
    half_seconds,
    sentence,
)
from evaluators.viewer.drive_data import MAX_SAMPLES

DOING = "finding why a drive failed"
MOST_DRIVES = 8
# once a change mends the drive, those with up to so many times its distance from the recording are
# driven as well
NEARLY = 1.5
SLOW_US = 150_000  # a policy that answers later than this has a latency of its own
Say = Callable[[str], None]


@dataclass(frozen=True)
class Driven:
    """A drive with a change: how it ended, whether without an event, and how far beside the
    recorded path it went.
    """

    trial: Trial
    outcome: str
    mends: bool
    aside_m: float = np.inf


def explain(past: LoggedRollout, run: Run, say: Say) -> Cause:
    """Replay a logged rollout and find out why it ended as it did.

    Args:
        past: The rollout.
        run: Its run, whose other arms it is compared with.
        say: Told what is being done.

    Raises:
        InputError: It cannot be replayed; see `alpasim_plugin.runs.probe.replay`.
        InfrastructureError: The replay is not equal to the log.
    """
    own = past.cell.renderer.name
    rollout = next(one for one in run.rollouts if one.cell == tuple(past.cell.names.values()))
    others = [
        r
        for r in run.renderers
        if r != own
        and any(one.renderer == r and one.scene == rollout.scene for one in run.rollouts)
    ]
    say(
        f"replaying the drive, and rendering its poses with {', '.join(others)}"
        if others
        else "replaying the drive"
    )
    notes = []
    try:
        queries = replay(past, [*others])
    except InputError as error:
        if not others:
            raise
        notes.append(f"Other renderers cannot be shown at the same poses: {error.message}.")
        queries = replay(past)
    failed_us = failed_at(past.manifest)
    until = [one for one in queries if failed_us is None or one.t_us <= failed_us]
    say("trying changes of what the policy sees and answers")
    findings = investigate(
        lambda: build(past.cell.policy, scenario=past.scenario),
        [one.plans[own] for one in until],
        [one.observation for one in until],
        past.scenario.ego_log,
        seed=past.cell.seed,
        its_route=past.scenario.route,
    )
    driven = _drives(past, findings.promising(MOST_DRIVES), say) if failed_us is not None else []
    partings = [*_by_renderer(past, run, until), *_by_policy(past, run, rollout)]
    pictures = behind_others(run, rollout)
    return Cause(
        rollout=rollout,
        outcome=in_words(_outcomes(past.manifest)),
        failed_us=failed_us,
        start_us=past.scenario.start_us,
        looks=_looks(queries, own, failed_us),
        sentences=(
            *pictures,
            *_sentences(
                findings, driven, partings, past.scenario.start_us, failed_us, bool(pictures)
            ),
        ),
        tried=_tried(findings, driven),
        depends=[
            (one.what, "yes" if one.is_used else "no", f"{one.apart_m:.2f} m")
            for one in findings.depends
        ],
        partings=tuple(partings),
        commands=commands(run, rollout, past.scenario.start_us, failed_us, partings),
        notes=tuple(notes),
    )


def _outcomes(manifest: Mapping[str, Any]) -> frozenset[str]:
    """Return the names of the outcomes of a manifest."""
    values = manifest.get("metrics") or {}
    return frozenset(
        name
        for name in OUTCOMES
        if (values.get(name) or {}).get("valid") and values[name]["value"] >= 0.5
    )


def _looks(queries: Sequence[PolicyQuery], own: str, failed_us: int | None) -> list[Look]:
    """Return the queries that the page shows: those before the failure, or an even choice of the
    whole drive.
    """
    found = []
    for query in chosen(queries, failed_us, [one.t_us for one in queries]):
        o = query.observation
        plans = {
            name: [
                half_seconds(plan.times_us, one) for one in (plan.xy, *plan.samples[:MAX_SAMPLES])
            ]
            for name, plan in query.plans.items()
        }
        frames = {name: (frame.t_us, frame.rgb) for name, frame in query.frames.items()}
        debug = query.plans[own].debug
        found.append(
            Look(
                query.t_us,
                o.ego.T_world_rig,
                o.ego.speed_mps,
                o.route_rig[:, :2],
                plans,
                frames,
                debug,
            )
        )
    return found


def _tried(findings: Findings, driven: Sequence[Driven]) -> list[tuple[str, str, str]]:
    """Return a row a change, the policy as it is first."""
    ends = {one.trial.name: one.outcome for one in driven}
    errors = [
        one.why_not if one.error_m is None else f"{one.error_m:.2f} m" for one in findings.tried
    ]
    names = [one.trial.name for one in findings.tried]
    return [
        ("none", f"{findings.own_error_m:.2f} m", ""),
        *((n, error, ends.get(n, "")) for n, error in zip(names, errors, strict=True)),
    ]


def _drives(past: LoggedRollout, promising: Sequence[Tried], say: Say) -> list[Driven]:
    """Drive with one change after the other, the best first, until those that are left are much
    worse than one that mends the drive.
    """
    driven: list[Driven] = []
    far_m = np.inf
    for tried in promising:
        error_m = tried.error_m or 0.0
        if error_m > far_m:
            break
        driven.append(_drive(past, tried, say))
        far_m = min(far_m, NEARLY * error_m) if driven[-1].mends else far_m
    return driven


def _drive(past: LoggedRollout, tried: Tried, say: Say) -> Driven:
    """Drive the scene with a change."""
    say(f"driving with the change: {tried.trial.name}")

    def parts(*args: Any) -> RolloutParts:
        made = build_parts(*args)
        return replace(made, policy=Changed(made.policy, tried.trial))

    with temporary_folder("simrun-why-") as folder:
        options = replace(past.options, images="none", video="none")
        manifest = run_cell(
            past.cell,
            options,
            Path(folder),
            thread_budget(1, 1).per_worker,
            parts,
            lambda _: past.scenario,
        )
    if manifest["status"] != "ok":
        return Driven(tried.trial, f"failed: {manifest['error']['message']}", False)
    outcomes, aside = _outcomes(manifest), manifest["metrics"].get("lateral_distance_m") or {}
    return Driven(
        tried.trial,
        in_words(outcomes),
        not outcomes,
        aside["value"] if aside.get("valid") else np.inf,
    )


# --- where plans part


def _by_renderer(past: LoggedRollout, run: Run, queries: Sequence[PolicyQuery]) -> list[Parting]:
    """Find when plans part from those behind the reference renderer at the same poses."""
    own, base = past.cell.renderer.name, baseline_of(run)
    shown = set(queries[0].frames)
    reference = next((r for r in ("clean", base, *shown) if r in shown and r != own), None)
    if reference is None:
        return []
    pair = compare(queries, reference, own)
    if pair.first is None:
        gaps = pair.gap_m[np.isfinite(pair.gap_m)]
        return [Parting(reference, "renderer", None, float(gaps.max(initial=0.0)))]
    query = queries[pair.first]
    frames = (query.frames[reference].rgb, query.frames[own].rgb)
    return [Parting(reference, "renderer", query.t_us, float(pair.first_gap_m or 0.0), frames)]


def _by_policy(past: LoggedRollout, run: Run, rollout: Rollout) -> list[Parting]:
    """Find when the drive's plans part from those of the run's first policy that ended without a
    failure behind the same renderer.
    """
    partners = [
        r
        for r in run.rollouts
        if r.ok and (r.renderer, r.scene, r.seed) == (rollout.renderer, rollout.scene, rollout.seed)
    ]
    better = [
        r
        for r in partners
        if r.policy != rollout.policy and not any(r.flag(name) for name in OUTCOMES)
    ]
    for partner in better[:1]:
        path = run.file_of(partner, LOG_NAME)
        if path is None:
            return []
        mine, theirs = (read_asl(file, images=False) for file in (past.folder / LOG_NAME, path))
        found = first_divergence(mine.plans, theirs.plans)
        return [
            Parting(
                partner.policy,
                "policy",
                None if found is None else found.t_us,
                0.0 if found is None else found.gap_m,
            )
        ]
    return []


# --- in words


def _sentences(
    findings: Findings,
    driven: Sequence[Driven],
    partings: Sequence[Parting],
    start_us: int,
    failed_us: int | None,
    is_explained: bool,
) -> list[tuple[str, str]]:
    """Return what was found, the surest first, each with how sure it is: shown, seen or not found.

    Several changes may mend a drive: the one that goes nearest to the recorded path is the likely
    cause, unless the pictures already explain it (``is_explained``): then a change shows only what
    helps.
    """
    out = _about_pictures(findings, start_us, is_explained)
    mend = sorted((one for one in driven if one.mends), key=lambda one: one.aside_m)
    if is_explained and mend:
        out.append(
            (
                "seen",
                f"with {' or '.join(one.trial.name for one in mend)} the drive ends without an event too.",
            )
        )
    else:
        out += [
            ("shown", f"With {one.trial.name} the drive ends without an event: {one.trial.cause}.")
            for one in mend[:1]
        ]
    if mend[1:] and not is_explained:
        out.append(
            (
                "seen",
                f"it ends so with {', '.join(one.trial.name for one in mend[1:])} too, but farther from the recorded path.",
            )
        )
    for one in partings:
        same = one.kind == "renderer" and one.t_us is None
        out.append(
            ("seen", f"the pictures are not the cause. {sentence(one, start_us)[1]}")
            if same
            else sentence(one, start_us)
        )
    for used in findings.depends:
        if not used.is_used and "picture" not in used.what:
            out.append(("seen", f"its plans do not depend on the {used.what.split(',')[0]}."))
    if not findings.repeatable:
        out.append(
            (
                "seen",
                "it plans otherwise when asked the same again, so nothing was tried: a policy must repeat itself for a seed.",
            )
        )
    elif failed_us is not None and not is_explained and not any(how == "shown" for how, _ in out):
        out.append(("not found", "no single change of what it sees or answers mends the drive."))
    out.sort(key=lambda one: one[0] != "shown")
    return [(how, text[0].upper() + text[1:]) for how, text in out]


def _about_pictures(findings: Findings, start_us: int, is_explained: bool) -> list[tuple[str, str]]:
    """Say whether, when and how late plans react to pictures."""
    blind = next(
        (one for one in findings.depends if "picture" in one.what and not one.is_used), None
    )
    if blind is not None and is_explained:
        return [
            (
                "seen",
                "whatever is done to these pictures, its plans are the same: it finds nothing in them.",
            )
        ]
    if blind is not None:
        return [
            (
                "shown",
                "its plans do not depend on the pictures: whatever is done to them, the plans are the same. It is blind.",
            )
        ]
    late = [one.after_us for one in findings.pulses if one.after_us]
    deaf = [one for one in findings.pulses if one.after_us is None]
    heard = [one for one in findings.pulses if one.after_us is not None]
    out = []
    if late and min(late) >= SLOW_US:
        out.append(("shown", f"its plans react to a picture {min(late) * 1e-6:.1f} s late."))
    if heard and deaf and min(one.t_us for one in deaf) > max(one.t_us for one in heard):
        first, last = (
            (t_us - start_us) * 1e-6
            for t_us in (max(one.t_us for one in heard), min(one.t_us for one in deaf))
        )
        told = f"between {first:.1f} and {last:.1f} s its plans stop to react to pictures: one is frozen, or it finds nothing in them."
        out.append(("seen", told))
    return out
