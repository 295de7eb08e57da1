"""The error budget of a headline: what each step and each sample adds to the difference that README
states, as shares of its interval.

    python docs/scripts/error_budget.py drive DRIVES.json [SCENE[#DRAW]...]    # 20 shipped scenes by default; what the file has is kept
    python docs/scripts/error_budget.py rescore RECORD SCORES.json       # one seed's logs, scored again at half the step
    python docs/scripts/error_budget.py table RECORD DRIVES.json SCORES.json      # writes docs/experiments/error-budget.md

RECORD is a run folder of ``docs/scripts/closed_loop.py``. A drive is repeated with one step halved
and all else equal; its change of the headline, over scenes, is what the step adds. Short drives
behind the surrogate stand for the record's (no model is fitted for them).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from copy import copy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pyarrow.parquet as pq
import scipy
from closed_loop import duration_us, family
from headline import BASELINE, DISTANCE, EVENT, FIXED, POLICY
from results import DOCS
from results import replace as put

from alpasim_plugin import load_scenario, make_policy, make_renderer, run_rollout
from alpasim_plugin.control import tracker
from alpasim_plugin.control.bicycle import MAX_SUBSTEP_S, step
from alpasim_plugin.core.atomic import write_json
from alpasim_plugin.core.geometry import interpolate, trajectory_from_poses
from alpasim_plugin.core.types import RolloutLog, Scene
from alpasim_plugin.gaussians.scene.scene_graph import SceneGraph
from alpasim_plugin.log import read_asl
from alpasim_plugin.renderers.gaussian import CleanRenderer
from evaluators import reduce_rollout, score
from evaluators.statistics.families import family_bounds
from evaluators.statistics.intervals import cluster_means
from scenarios.suite import expand

SECONDS = 4
SUITES = ("smoke", "urban", "highway")
MOST = 20
STEPS = {  # what is halved -> from and to
    "vehicle step": f"{1e3 * MAX_SUBSTEP_S:g} to {500 * MAX_SUBSTEP_S:g} ms",
    "raster precision": "float32 to float64, by noise",
    "Gaussian budget": "cells of 3.5 to 1.75 pixels",
    "resolution": "256x144 to 512x288",
    "loop period": "100 to 50 ms: camera, policy and control",
    "fixer precision": "fp32 to bf16",
}
EVALUATOR = "evaluator step"
PRESET = "strict"
TENTH = 0.1
LEAST_SHARE = 1e-4  # of a raster's values is taken to be off, where one frame has none


@contextmanager
def halved(what: str, share: float) -> Iterator[None]:
    """Change what is not an option of a scenario or fixer; ``share`` of the raster's values are off
    by one level.
    """
    draw, choose = CleanRenderer._frame, SceneGraph._choose
    noise = np.random.default_rng(0)

    def rounded(self: CleanRenderer, request: Any, out: Any) -> Any:
        frame = draw(self, request, out)
        off = (noise.random(frame.rgb.shape) < share) * noise.choice([-1, 1], frame.rgb.shape)
        return replace(
            frame, rgb=np.clip(frame.rgb.astype(np.int16) + off, 0, 255).astype(np.uint8)
        )

    def finer(self: SceneGraph, *args: Any) -> Any:
        graph = copy(self)
        graph.cell_px = self.cell_px / 2
        return choose(graph, *args)

    with ExitStack() as changed:
        if what == "vehicle step":
            changed.enter_context(
                patch.object(tracker, "step", partial(step, max_substep_s=MAX_SUBSTEP_S / 2))
            )
        if what == "raster precision":
            changed.enter_context(patch.object(CleanRenderer, "_frame", rounded))
        if what == "Gaussian budget":
            changed.enter_context(patch.object(SceneGraph, "_choose", finer))
        yield


def camera(width: int, height: int) -> str:
    """Return the setting of one camera of that size."""
    return f"cameras=[{{width: {width}, height: {height}}}]"


def overrides(what: str, seconds_us: int) -> list[str]:
    """Return the scenario's settings."""
    more = {
        "resolution": (camera(512, 288),),
        "loop period": tuple(f"rates.{name}_us=50000" for name in ("control", "camera", "policy")),
    }
    return [f"timing.duration_us={seconds_us}", "degradation.kind=surrogate", *more.get(what, ())]


def judged(log: RolloutLog, scene: Scene) -> dict[str, float | None]:
    """Return the headline's two numbers of a drive."""
    values = reduce_rollout(score(log, scene, preset=PRESET), PRESET).values
    return {name: values[name].value if values[name].valid else None for name in (EVENT, DISTANCE)}


def one_drive(
    path: Path,
    draw: int,
    what: str,
    renderer: str,
    share: float,
    given: Sequence[str] = (),
    size: str = "",
) -> dict[str, Any]:
    """Drive a scene as jitter draws it, and give its numbers and its processor milliseconds per
    frame.

    ``given`` sets the fixer, ``size`` the camera.
    """
    scenario = load_scenario(
        path, draw, [*overrides(what, duration_us(path, SECONDS)), *([size] if size else [])]
    )
    setting = ("precision=bf16" if what == "fixer precision" else "precision=fp32", *given)
    with halved(what, share):
        made = make_renderer(
            renderer, scenario, threads=1, overrides=setting if renderer == FIXED else ()
        )
        policy = make_policy(POLICY, scenario)
        began = time.process_time()
        log = run_rollout(scenario, made, policy, seed=0).log()
        spent = time.process_time() - began
    return {
        **judged(log, scenario.scene),
        "ms": 1e3 * spent / max(1, len(log.images)),
        "frames": len(log.images),
    }


def raster_share(path: Path, draw: int) -> tuple[float, int]:
    """Return the share of a first frame's 8-bit values that float64 rounds otherwise, at least
    `LEAST_SHARE`, and the most levels.
    """
    scenario = load_scenario(
        path, draw, [*overrides("", duration_us(path, SECONDS)), camera(128, 72)]
    )
    seen: list[tuple[Any, Any]] = []

    class Seen(Exception):
        pass

    made: Any = make_renderer(BASELINE, scenario, threads=1)
    real = made.render

    def once(request: Any) -> Any:
        seen.append((request, real(request)))
        raise Seen

    with patch.object(made, "render", once):
        try:
            run_rollout(scenario, made, make_policy("lane-camera", scenario))
        except Exception:
            assert seen
    made.backend = "reference"
    request, fast = seen[0]
    apart = np.abs(fast.rgb.astype(np.int16) - real(request).rgb)
    return max(float((apart > 0).mean()), LEAST_SHARE), int(apart.max())


def scenes() -> list[str]:
    """Return the shipped scenes that are driven."""
    return [ref.path for suite in SUITES for ref in expand(f"suites/{suite}")][:MOST]


def drive(out: Path, asked: Sequence[str]) -> None:
    """Add drives to a file, all steps of a scene before the next scene; ``SCENE#2`` is its second
    draw.
    """
    known = json.loads(out.read_text()) if out.exists() else {"drives": {}, "raster": {}}
    for file, _, drawn in (one.partition("#") for one in asked):
        path, draw = Path(expand(file)[0].path), int(drawn or 0)
        name = f"{path.parent.name}/{path.stem}" + (f"#{draw}" if draw else "")
        if name not in known["raster"]:
            known["raster"][name] = raster_share(path, draw)
            write_json(out, known)
        for what in ("", *STEPS):
            for renderer in (BASELINE, FIXED):
                key = f"{name}|{what}|{renderer}"
                if key in known["drives"] or (what == "fixer precision" and renderer == BASELINE):
                    continue
                known["drives"][key] = one_drive(
                    path, draw, what, renderer, known["raster"][name][0]
                )
                print(key, known["drives"][key], flush=True)
                write_json(out, known)


def finer(log: RolloutLog) -> RolloutLog:
    """Return a log with a pose between every two of the ego's."""
    t_us = log.ego.t_us
    t_us = np.unique(np.concatenate([t_us, (t_us[:-1] + t_us[1:]) // 2]))
    return replace(log, ego=trajectory_from_poses(t_us, interpolate(log.ego, t_us)))


def rescore(record: Path, out: Path) -> None:
    """Score one seed's logs of a record as they are and at half the step, families mixed; what the
    file has is kept.
    """
    known = json.loads(out.read_text()) if out.exists() else {}
    listed = json.loads((record / "run.json").read_text())["scenes"]
    for name in sorted(listed, key=lambda name: name[::-1]):
        ref = listed[name]["ref"]
        folders = [
            {
                one: record / "rollouts" / one / POLICY / name / str(seed)
                for one in (BASELINE, FIXED)
            }
            for seed in range(5)
        ]
        whole = next(
            (
                of
                for of in folders
                if all((folder / "rollout.asl").exists() for folder in of.values())
            ),
            {},
        )
        for renderer, folder in whole.items():
            if f"{name}|{renderer}" in known:
                continue
            scene, log = (
                load_scenario(ref["path"], ref["seed"], ref["overrides"]).scene,
                read_asl(folder / "rollout.asl"),
            )
            known[f"{name}|{renderer}"] = [judged(one, scene) for one in (log, finer(log))]
            write_json(out, known)


Table = dict[str, dict[str, float]]  # scene -> the headline's difference, by metric


def headline_of(rows: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return the differences of scenes that have both renderers, from ``SCENE|RENDERER`` ->
    numbers.
    """
    names = dict.fromkeys(key.split("|")[0] for key in rows)
    out: Table = {}
    for name in names:
        here, there = rows.get(f"{name}|{FIXED}"), rows.get(f"{name}|{BASELINE}")
        if (
            here
            and there
            and None not in (here[EVENT], here[DISTANCE], there[EVENT], there[DISTANCE])
        ):
            out[name] = {metric: here[metric] - there[metric] for metric in (EVENT, DISTANCE)}
    return out


def mean_with_bounds(x: np.ndarray) -> tuple[float, float]:
    """Return the mean of ``(n,)`` scenes and the half of its 95 % t interval."""
    return float(x.mean()), float(
        scipy.special.stdtrit(len(x) - 1, 0.975) * x.std(ddof=1) / np.sqrt(len(x))
    )


def sources(delta: np.ndarray, scene: np.ndarray, families: np.ndarray) -> dict[str, float]:
    """Return half intervals of a headline's mean: with ``families`` as the unit, with scenes, and
    what its seeds alone would give.

    Args:
        delta: ``(N,)`` differences of cells.
        scene: ``(N,)`` their scenes, from 0.
        families: ``(G,)`` the scenes' families, from 0.
    """
    means, counts = cluster_means(delta, scene)
    inside = np.array(
        [delta[scene == k].var(ddof=1) / n if n > 1 else 0.0 for k, n in enumerate(counts)]
    )
    _, whole = mean_with_bounds(means)
    seeds = float(
        scipy.special.stdtrit(len(means) - 1, 0.975) * np.sqrt(inside.mean() / len(means))
    )
    low, high = family_bounds(means, families)
    scenes = float(np.sqrt(max(0.0, whole**2 - seeds**2)))
    return {
        "families": (high - low) / 2,
        "scenes and seeds": whole,
        "scenes": scenes,
        "seeds": seeds,
    }


def of_record(record: Path) -> dict[str, dict[str, float]]:
    """Return `sources` of both metrics, with the ``mean``."""
    cells = {
        (row["renderer"], row["scene"], row["seed"]): row
        for row in pq.read_table(record / "rollouts.parquet").to_pylist()
    }
    out = {}
    for metric in (EVENT, DISTANCE):
        pairs = [
            (scene, row[metric] - cells[BASELINE, scene, seed][metric], family(row))
            for (renderer, scene, seed), row in sorted(cells.items())
            if renderer == FIXED and None not in (row[metric], cells[BASELINE, scene, seed][metric])
        ]
        names, at = np.unique([one[0] for one in pairs], return_inverse=True)
        kinds = dict((one[0], one[2]) for one in pairs)
        _, of = np.unique([kinds[name] for name in names], return_inverse=True)
        delta = np.array([one[1] for one in pairs])
        out[metric] = {"mean": float(cluster_means(delta, at)[0].mean()), **sources(delta, at, of)}
    return out


def step_rows(known: Mapping[str, Any], rescored: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return for every step the changes of scenes' differences ``(n,)`` by metric, the flips, and
    the ratio of processor times.
    """
    drives = known["drives"]

    def of(what: str) -> dict[str, Any]:
        found = {
            key.replace(f"|{what}|", "|"): row
            for key, row in drives.items()
            if key.split("|")[1] == what
        }
        usual = {
            key.replace("||", "|"): row
            for key, row in drives.items()
            if "||" in key and key.endswith(BASELINE)
        }
        return usual | found if what == "fixer precision" else found

    usual, out = of(""), {}
    for what in STEPS:
        out[what] = changed(usual, of(what))
    before, after = ({key: pair[k] for key, pair in rescored.items()} for k in (0, 1))
    return out | {EVALUATOR: changed(before, after)}


def changed(usual: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """Compare drives with one step halved with the same as usual."""
    one, two = headline_of(usual), headline_of(other)
    both = [name for name in two if name in one]
    cells = [key for key in other if key in usual]
    flips = sum(usual[key][EVENT] != other[key][EVENT] for key in cells)
    _, scene = np.unique([name.partition("#")[0] for name in both], return_inverse=True)
    moved = {
        metric: scene_means([two[name][metric] - one[name][metric] for name in both], scene)
        for metric in (EVENT, DISTANCE)
    }
    timed = [name for name in both if "ms" in other[f"{name}|{FIXED}"]]
    _, scene = np.unique([name.partition("#")[0] for name in timed], return_inverse=True)
    ratio = scene_means(
        [np.log(other[f"{name}|{FIXED}"]["ms"] / usual[f"{name}|{FIXED}"]["ms"]) for name in timed],
        scene,
    )
    return {
        "scenes": len(moved[DISTANCE]),
        "moved": moved,
        "flips": flips,
        "cells": len(cells),
        "log_ratio": ratio,
    }


def scene_means(values: Sequence[float], scene: np.ndarray) -> np.ndarray:
    """Return the mean of every scene over its draws."""
    return cluster_means(np.array(values), scene)[0] if len(values) else np.zeros(0)


def verdict(mean: float, half: float, most: float) -> str:
    """Say whether a change with its half interval is within the bar."""
    return (
        "met" if abs(mean) + half <= most else "missed" if abs(mean) - half > most else "undecided"
    )


def table(record: Path, known: Mapping[str, Any], rescored: Mapping[str, Any]) -> str:
    """Return the tables of the page."""
    whole, lines = of_record(record), []
    width = {metric: 2 * whole[metric]["scenes and seeds"] for metric in whole}
    lines += [
        f"| source | `{EVENT}`: half interval, points | share | `{DISTANCE}`: half interval, m | share |",
        "|---|---:|---:|---:|---:|",
    ]
    for source in ("families", "scenes and seeds", "scenes", "seeds"):
        event, distance = (whole[metric][source] for metric in (EVENT, DISTANCE))
        shares = (2 * event / width[EVENT], 2 * distance / width[DISTANCE])
        lines.append(
            f"| {source} | {100 * event:.2f} | {100 * shares[0]:.0f} % | {distance:.3f} | {100 * shares[1]:.0f} % |"
        )
    mean = {metric: whole[metric]["mean"] for metric in whole}
    lines += [
        "",
        f"The headline: `{FIXED}` minus `{BASELINE}`, {100 * mean[EVENT]:+.1f} points and {mean[DISTANCE]:+.3f} m.",
        "",
        f"| halved | | scenes | change of `{DISTANCE}`, m | share of the interval | a tenth | event flips in | processor time, ratio |",
        "|---|---|---:|---:|---:|---|---:|---:|",
    ]
    rows = []
    for what, row in step_rows(known, rescored).items():
        if row["scenes"] < 2:
            continue
        change, half = mean_with_bounds(row["moved"][DISTANCE])
        share = abs(change) / width[DISTANCE]
        kept = row["cells"] - row["flips"]
        most = float(scipy.special.betaincinv(row["flips"] + 1, kept, 0.975)) if kept else 1.0
        flips = f"{row['flips']} of {row['cells']} (below {100 * most:.1f} %)"
        spent = (
            ""
            if len(row["log_ratio"]) < 2
            else "{:.2f} ± {:.2f}".format(*ratio_of(row["log_ratio"]))
        )
        said = verdict(change, half, TENTH * width[DISTANCE])
        cells = f"{change:+.4f} ± {half:.4f} | {100 * share:.1f} % | {said} | {flips} | {spent}"
        rows.append(
            (
                share,
                f"| {what} | {STEPS.get(what, 'a pose between every two')} | {row['scenes']} | {cells} |",
            )
        )
    lines += [text for _, text in sorted(rows, reverse=True)]
    off = np.array([pair[0] for pair in known["raster"].values()])
    usual = np.array([row["ms"] for key, row in known["drives"].items() if f"||{FIXED}" in key])
    levels, ms = max(pair[1] for pair in known["raster"].values()), mean_with_bounds(usual)
    lines += [
        "",
        f"Raster: float64 rounds at most {100 * off.max():.3f} % of a first frame's 8-bit values otherwise than float32, by {levels} level "
        f"at most, in {len(off)} scenes (at least {100 * LEAST_SHARE:g} % is taken).",
        f"A frame behind `{FIXED}` takes {ms[0]:.1f} ± {ms[1]:.1f} ms of processor time in these drives.",
    ]
    return "\n".join(lines)


def ratio_of(logs: np.ndarray) -> tuple[float, float]:
    """Return the geometric mean of ratios and the half of its interval."""
    mean, half = mean_with_bounds(logs)
    return float(np.exp(mean)), float(np.exp(mean) * np.sinh(half))


def main() -> None:
    """Drive, score again, or write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("drive", "rescore", "table"))
    parser.add_argument("files", nargs="+", help="As above.")
    given = parser.parse_args()
    if given.what == "drive":
        drive(Path(given.files[0]), given.files[1:] or scenes())
    elif given.what == "rescore":
        rescore(*map(Path, given.files))
    else:
        record, *kept = map(Path, given.files)
        page = DOCS / "experiments" / "error-budget.md"
        text = table(record, *(json.loads(path.read_text()) for path in kept))
        page.write_text(
            put(page.read_text(encoding="utf-8"), "error-budget", text), encoding="utf-8"
        )


if __name__ == "__main__":
    main()
