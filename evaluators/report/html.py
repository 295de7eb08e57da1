"""Write ``report.html``: one file that opens from disk without a network."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import cv2
from jinja2 import (
    ChoiceLoader,
    Environment,
    FileSystemBytecodeCache,
    PackageLoader,
    StrictUndefined,
)
from markupsafe import Markup

from alpasim_plugin.core.atomic import write_text
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.limits import SOURCE_BYTES
from alpasim_plugin.core.reading import parsing, read_bytes
from alpasim_plugin.core.reading.images import decode_image
from alpasim_plugin.log.run_folder.reader import reporting
from alpasim_plugin.log.run_folder.rows import Rollout, Series
from alpasim_plugin.log.run_folder.schema import AGAIN, STRIP_NAME, WHY_NAME
from evaluators.metrics.outcomes import OUTCOMES, first_failure, has_ended, in_words, outcomes_of
from evaluators.opening import Run, read_run
from evaluators.report import tables
from evaluators.report.birdseye import SceneView, scene_view
from evaluators.report.charts import drift_charts, forest, speed_against_error
from evaluators.report.decision import decision_section
from evaluators.report.fixers import COLUMNS, fixer_rows, speed
from evaluators.report.flips import FlipKey, colours_of, comparisons, flip_bases, flip_rows
from evaluators.report.gate import gate_section
from evaluators.report.numbers import DASH, duration, fixed, plural
from evaluators.report.provenance import (
    LEDGER_COLUMNS,
    failure_rows,
    invalid_rows,
    ledger,
    provenance,
)
from evaluators.report.rollouts import read_series, rollout_block
from evaluators.report.verdict import find, variant_name

MAX_SCENE_PLOTS = 24
OPEN_SCENE_PLOTS = 6
MAX_STRIP_SCENES = 8
SERIES_ROLLOUTS = 4000  # whose steps are read at once
LEDGER_RATES = ("collision_at_fault", "offroad")
PLOT_BUDGET_BYTES = 1_500_000
STRIP_BUDGET_BYTES = 1_500_000
FLIP_BUDGET_BYTES = 2_000_000
SHOTS = 3
USUAL_FRAME = 2  # of a strip, where nothing happened
SHOT_WIDTH_PX = 420
NO_REPLAYS: Mapping[FlipKey, str] = {}
STYLES = ("theme.css", "report.css")
SCRIPTS = ("theme.js", "report.js", "rollouts.js")


def write_report(run_dir: Path | str | Run, replays: Mapping[FlipKey, str] = NO_REPLAYS) -> Path:
    """Write ``report.html`` into a run folder.

    Args:
        run_dir: A run folder (docs/architecture.md), or what was read of it. Nothing else is read.
        replays: Key of a changed outcome -> where it is replayed, relative to the run folder.

    Returns:
        Path of the report.

    Raises:
        InputError: The run folder is not complete enough to be read.
    """
    run = read_run(run_dir)
    path = run.folder / "report.html"
    with reporting(run):
        text = render_report(run, replays)
    write_text(path, text)
    return path


def render_report(run: Run, replays: Mapping[FlipKey, str] = NO_REPLAYS) -> str:
    """Render the report as a string; ``replays`` as in `write_report`.

    Style sheets and scripts stand inside the page; the hash allows it to run this script and no
    other.
    """
    environment = environment_of("evaluators.report")
    style = "\n".join(asset(environment, name) for name in STYLES)
    script = "\n".join(asset(environment, name) for name in SCRIPTS)
    return environment.get_template("report.html.j2").render(
        style=Markup(style),
        script=Markup(script),
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        plural=plural,
        dash=DASH,
        replays=replays,
        **context(run),
    )


@cache
def environment_of(*packages: str) -> Environment:
    """Return the templates of packages, the first that has a name. Compiled templates are kept in
    the system's folder for temporary files, where it can be written.
    """
    compiled = None
    with suppress(OSError, RuntimeError):
        compiled = FileSystemBytecodeCache()
    return Environment(
        loader=ChoiceLoader([PackageLoader(package) for package in packages]),
        bytecode_cache=compiled,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def asset(environment: Environment, name: str) -> str:
    """Return the source of a style sheet or a script among the templates."""
    if environment.loader is None:
        raise RuntimeError("the template environment has no loader")
    return environment.loader.get_source(environment, name)[0]


def context(run: Run) -> dict[str, Any]:
    """Collect everything that the template prints."""
    sample = sampled_scenes(run)
    series = read_series(run, sample)
    interesting = by_interest(run)
    variant_of = colours_of(run)
    looked_at = None if sample is None else interesting[: 2 * MAX_SCENE_PLOTS]
    views, no_view = scene_views(
        run,
        series if looked_at is None else read_series(run, looked_at),
        looked_at or interesting,
        variant_of,
    )
    strips, no_strip = comparisons(run, interesting, MAX_STRIP_SCENES, STRIP_BUDGET_BYTES)
    rows = tables.metric_rows(run.summary, run.invalid_reasons, run.table)
    pairs = tables.pair_rows(run.summary, run.table)
    failures, more_failures = failure_rows(run)
    headline = [row for row in rows if row.is_headline] or rows
    # every column has the colour of its renderer, or of its policy where there is one renderer
    colours = {}
    for i, variant in enumerate(run.variants):
        first = next(iter(run.rollouts_of(variant)), None)
        colours[variant] = i if first is None else variant_of[first.renderer, first.policy][0]
    by_policy = len(run.renderers) == 1 and len(run.policies) > 1
    flips, more_flips, flip_pairs = flip_rows(run, FLIP_BUDGET_BYTES)
    of_sample = (
        ""
        if sample is None
        else f"From {plural(len(sample), 'scene')} of {len(run.scenes)}, evenly chosen from their list."
    )
    return {
        "run": run,
        "title": ", ".join(run.renderers) or "empty run",
        "when": str(run.info.get("started_at") or "")[:16].replace("T", " "),
        "finding": find(run),
        "shots": shots(run, interesting),
        "decision": decision_section(run),
        "gate": gate_section(run),
        "facts": _facts(run),
        "columns": tables.columns(run),
        "variant_colour": colours,
        "forest": forest(run, colours),
        "flips": flips,
        "whys": {
            one.path: page
            for one in run.rollouts
            if one.ok and outcomes_of(one) and (page := run.href(one, WHY_NAME))
        },
        "more_flips": more_flips,
        "flip_pairs": flip_pairs,
        "baseline": " or ".join(base.name for base in flip_bases(run)),
        "baselines": [base.name for base in flip_bases(run)],
        "speed_charts": speed_against_error(run, colours),
        "invalid": invalid_rows(run),
        "headline_rows": headline,
        "other_rows": [row for row in rows if row not in headline],
        "headline_pairs": [p for p in pairs if p.metric in {row.name for row in headline}] or pairs,
        "other_pairs": [
            p for p in pairs if headline and p.metric not in {row.name for row in headline}
        ],
        "coloured": run.policies if by_policy else run.renderers,
        "dashed": len(run.policies) > 1 and not by_policy,
        "policies": run.policies,
        "charts": drift_charts(run.rollouts, series, variant_of),
        "views": views,
        "open_views": OPEN_SCENE_PLOTS,
        "views_left_out": no_view,
        "strips": strips,
        "strips_left_out": no_strip,
        "fixers": fixer_rows(run.summary),
        "fixer_columns": COLUMNS,
        "speed": speed(run),
        "every_rollout": rollout_block(run),
        "of_sample": of_sample,
        "failures": failures,
        "more_failures": more_failures,
        "ledger": ledger(run, LEDGER_RATES),
        "ledger_columns": LEDGER_COLUMNS,
        "ledger_rates": LEDGER_RATES,
        "provenance": provenance(run),
    }


def sampled_scenes(run: Run) -> list[str] | None:
    """Return the scenes whose steps are read for charts of the whole run; None where all are:
    `SERIES_ROLLOUTS` fit into memory.
    """
    if len(run.rollouts) <= SERIES_ROLLOUTS:
        return None
    scenes, wanted = run.scenes, max(1, SERIES_ROLLOUTS * len(run.scenes) // len(run.rollouts))
    return [scenes[i * len(scenes) // wanted] for i in range(wanted)]


def by_interest(run: Run) -> list[str]:
    """Sort scenes by how much there is to see: events and failures first, then the largest distance
    from the logged path.
    """

    def interest(scene: str) -> tuple[int, float]:
        rollouts = run.by_scene.get(scene, ())
        events = sum(len(outcomes_of(r)) if has_ended(r) else 1 for r in rollouts)
        far = [v for r in rollouts if (v := r.metrics.get("lateral_distance_m")) is not None]
        return events, max(far, default=0.0)

    return sorted(run.scenes, key=interest, reverse=True)


def scene_views(
    run: Run,
    series: Series,
    interesting: list[str],
    variant_of: Mapping[tuple[str, str], tuple[int, int]],
) -> tuple[list[SceneView], list[str]]:
    """Lay out the most telling scenes within the limits of count and size.

    Returns:
        The drawings (in the order of the run where all are shown at once, else the most telling
        first), and the scenes not drawn.
    """
    drawn: dict[str, SceneView] = {}
    spent = 0
    for scene in interesting:
        rollouts = run.by_scene.get(scene, ())
        if not rollouts or len(drawn) >= MAX_SCENE_PLOTS or spent > PLOT_BUDGET_BYTES:
            continue
        content = run.scene_data(scene)
        if content is None:
            continue
        with parsing(run.scene_path(scene) or scene, AGAIN, "no scene that can be drawn"):
            view = scene_view(scene, content, rollouts, series, variant_of)
        if view is not None:
            drawn[scene] = view
            spent += (
                len(view.lanes)
                + len(view.lines)
                + len(view.edges)
                + sum(len(t.d) for t in view.tracks)
            )
    order = run.scenes if len(drawn) <= OPEN_SCENE_PLOTS else interesting
    return [drawn[s] for s in order if s in drawn], [s for s in run.scenes if s not in drawn]


def _facts(run: Run) -> list[tuple[str, str]]:
    done = sum(rollout.ok for rollout in run.rollouts)
    wall_s = (run.summary.get("pool") or {}).get("wall_s")
    facts = [
        ("rollouts", f"{done} of {len(run.rollouts)} completed"),
        ("scenes", str(len(run.scenes))),
        ("seeds", str(len({rollout.seed for rollout in run.rollouts}))),
        ("renderers", ", ".join(run.renderers) or DASH),
        ("policy" if len(run.policies) == 1 else "policies", ", ".join(run.policies) or DASH),
        ("preset", str(run.summary.get("preset") or run.info.get("preset") or DASH)),
    ]
    if isinstance(wall_s, int | float):
        facts.append(("wall time", duration(wall_s)))
    return facts


def shots(run: Run, interesting: Sequence[str]) -> list[dict[str, Any]]:
    """Pick at most three images: of rollouts that failed, one a variant first; else of the variants
    in the most telling scene.

    Args:
        run: The run.
        interesting: Its scenes, the most telling first.
    """
    gravity, rank = list(OUTCOMES), {scene: i for i, scene in enumerate(interesting)}
    done = [rollout for rollout in run.rollouts if rollout.ok]
    failed = sorted(
        (rollout for rollout in done if outcomes_of(rollout)),
        key=lambda r: (min(map(gravity.index, outcomes_of(r))), rank[r.scene]),
    )
    firsts = {rollout.variant: rollout for rollout in reversed(failed)}
    chosen = [*reversed(firsts.values()), *failed]
    chosen = chosen or [rollout for rollout in done if rollout.scene in interesting[:1]]
    found: list[dict[str, Any]] = []
    for rollout in {rollout.cell: rollout for rollout in chosen}.values():
        shot = _shot(run, rollout) if len(found) < SHOTS else None
        if shot is not None:
            found.append(shot)
    return found


def _shot(run: Run, rollout: Rollout) -> dict[str, Any] | None:
    """Return one image of a rollout: ``variant``, ``scene``, ``outcome`` and when, ``src`` (a data:
    address), and ``link`` to where the rollout is shown.
    """
    path = run.file_of(rollout, STRIP_NAME)
    manifest = run.manifest(rollout)
    times_us = [int(t_us) for t_us in manifest.get("strip_t_us") or ()]
    if path is None or not times_us:
        return None
    outcome = in_words(outcomes_of(rollout))
    frame = min(USUAL_FRAME, len(times_us) - 1)
    first = first_failure(manifest)
    if first is not None:
        # what led to it: after a contact the camera may be inside the other vehicle
        before = [i for i, t_us in enumerate(times_us) if t_us <= int(first["t_us"])]
        frame = max(before, default=0)
        outcome += f" at {fixed(float(first['t_s']), 1)}\u00a0s"
    try:
        strip = decode_image(read_bytes(path, SOURCE_BYTES), path)
    except InputError:
        return None  # the report says elsewhere that the image is absent
    width = strip.shape[1] // len(times_us)
    size = (SHOT_WIDTH_PX, round(strip.shape[0] * SHOT_WIDTH_PX / width))
    image = cv2.resize(strip[:, frame * width :][:, :width], size, interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 80])
    return {
        "variant": variant_name(run, rollout.variant),
        "scene": rollout.scene,
        "outcome": outcome,
        "src": "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode(),
        "link": run.href(rollout, WHY_NAME) or run.href(rollout),
    }
