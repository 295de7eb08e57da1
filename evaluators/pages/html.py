"""Write ``report.html``: one file that opens from disk without a network."""

import base64
import hashlib
import json
import math
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import (
    ChoiceLoader,
    Environment,
    FileSystemBytecodeCache,
    PackageLoader,
    StrictUndefined,
)
from markupsafe import Markup, escape

from alpasim_plugin.core.files import parsing
from alpasim_plugin.core.files.atomic import write_text
from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.log.run_folder.reader import reporting
from alpasim_plugin.log.run_folder.records import Project, json_of
from alpasim_plugin.log.run_folder.rows import Series, series_by_rollout
from alpasim_plugin.log.run_folder.schema import AGAIN, WHY_NAME
from evaluators.metrics.outcomes import OUTCOMES, has_ended, outcomes_of
from evaluators.metrics.presets import described
from evaluators.pages import tables
from evaluators.pages.above import still_map
from evaluators.pages.boundary import boundary_section
from evaluators.pages.decision import decision_section
from evaluators.pages.fixers import pool_text, refused
from evaluators.pages.flips import colours_of, flip_bases, flip_rows
from evaluators.pages.gate import gate_section
from evaluators.pages.overview import CUT_NOTE, DISTANCE_NOTE, TONES, overview_of
from evaluators.pages.rollouts import OTHERS, SERIES, rollout_block
from evaluators.pages.worst import worst_change
from evaluators.statistics.numbers import DASH, fixed, listed_counts, percents, plural, short
from evaluators.statistics.opening import Run, read_run

MAX_SCENE_PLOTS = 24
OPEN_SCENE_PLOTS = 6
PLOT_BUDGET_BYTES = 1_500_000
FLIP_BUDGET_BYTES = 2_000_000
STYLES = ("theme.css", "report.css")
SCRIPTS = ("theme.js", "report.js", "above.js", "rollouts.js")


def write_report(run_dir: Path | str | Run) -> Path:
    """Write ``report.html`` into a run folder.

    Args:
        run_dir: A run folder (docs/architecture.md), or what was read of it. Nothing else is read.

    Returns:
        Path of the report.

    Raises:
        InputError: The run folder is not complete enough to be read.
    """
    run = read_run(run_dir)
    path = run.folder / "report.html"
    with reporting(run):
        text = render_report(run)
    write_text(path, text)
    return path


def render_report(run: Run) -> str:
    """Render the report as a string.

    Style sheets and scripts stand inside the page; the hash allows it to run this script and no
    other.
    """
    environment = environment_of("evaluators.pages")
    style = "\n".join(asset(environment, name) for name in STYLES)
    script = "\n".join(asset(environment, name) for name in SCRIPTS)
    return environment.get_template("report.html.j2").render(
        style=Markup(style),
        script=Markup(script),
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
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
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package) for package in packages]),
        bytecode_cache=compiled,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals.update(plural=plural, short=short, dash=DASH)
    environment.filters.update(
        beyond=lambda items, n: max(len(items) - n, 0),
        coded=coded,
        degrees=lambda radians: f"{math.degrees(radians):.1f}",
        listed_counts=listed_counts,
        percent=lambda share, places: f"{fixed(100 * share, places)} %",
        percents=percents,
        seconds=lambda t_us: f"{t_us / 1e6:.1f}",
        total=lambda counts: sum(counts.values()),
    )
    return environment


def coded(text: str) -> Markup:
    """Return a sentence with what stands between backticks as code.

    Example:
        >>> coded("into the car ahead (`lead`)")
        Markup('into the car ahead (<code>lead</code>)')
    """
    words = [escape(part) for part in text.split("`")]
    if len(words) % 2 == 0:
        return escape(text)
    words[1::2] = [Markup("<code>{}</code>").format(word) for word in words[1::2]]
    return Markup("").join(words)


def asset(environment: Environment, name: str) -> str:
    """Return the source of a style sheet or a script among the templates."""
    if environment.loader is None:
        raise RuntimeError("the template environment has no loader")
    return environment.loader.get_source(environment, name)[0]


def context(run: Run) -> dict[str, Any]:
    """Collect everything that the template prints."""
    interesting = by_interest(run)
    variant_of = colours_of(run)
    looked_at = interesting[: 2 * MAX_SCENE_PLOTS]
    series = series_by_rollout(run.steps(SERIES, looked_at)) if looked_at else {}
    views, no_view = scene_views(run, series, looked_at, variant_of)
    by_policy = len(run.renderers) == 1 and len(run.policies) > 1
    return {
        "run": run,
        "title": ", ".join(run.renderers) or "empty run",
        "when": (run.info.started_at or "")[:16].replace("T", " "),
        "overview": overview_of(run),
        "ending_tones": TONES,
        "distance_note": DISTANCE_NOTE,
        "cut_note": CUT_NOTE,
        "preset_words": described().get(run.summary.preset, ""),
        "shots": worst_change(run),
        "decision": decision_section(run),
        "boundary": boundary_section(run.summary.boundary),
        "gate": gate_section(run),
        "columns": tables.columns(run),
        "variant_colour": column_colours(run, variant_of),
        **flip_section(run),
        "whys": why_pages(run),
        "n_invalid": sum(len(ledger.invalid) for ledger in run.summary.censoring.values()),
        "metric_rows": tables.metric_rows(run.summary, run.invalid_reasons, run.table),
        "pair_rows": tables.pair_rows(run.summary.differences, run.table),
        "coloured": run.policies if by_policy else run.renderers,
        "dashed": len(run.policies) > 1 and not by_policy,
        "policies": run.policies,
        "views": views,
        "marked": marked_events(views),
        "open_views": OPEN_SCENE_PLOTS,
        "views_left_out": no_view,
        "refused": refused,
        "pool": pool_text(run.summary.pool),
        "stages": list(
            dict.fromkeys(name for speed in run.summary.speed.values() for name in speed.stages)
        ),
        "every_rollout": rollout_block(run),
        "failed": [rollout for rollout in run.rollouts if not rollout.ok],
        "hints": {cell.path: cell.error.hint for cell in run.summary.failures.cells},
        "command": command_of(run),
        "commit": _commit(run.info.project),
        "options": json_of(run.info.config),
    }


def column_colours(
    run: Run, variant_of: Mapping[tuple[str, str], tuple[int, int]]
) -> dict[str, int]:
    """Return the colour of every column: its renderer's, or its policy's where there is one
    renderer.
    """
    colours = {}
    for i, variant in enumerate(run.variants):
        first = next(iter(run.rollouts_of(variant)), None)
        colours[variant] = i if first is None else variant_of[first.renderer, first.policy][0]
    return colours


def flip_section(run: Run) -> dict[str, Any]:
    """Return what the template prints of changed outcomes: as many as fit, and how many there are."""
    flips, more_flips, flip_pairs = flip_rows(run, FLIP_BUDGET_BYTES)
    return {
        "flips": flips,
        "more_flips": more_flips,
        "n_flips": len(flips) + more_flips,
        "flip_pairs": flip_pairs,
        "baseline": " or ".join(base.name for base in flip_bases(run)),
    }


def why_pages(run: Run) -> dict[str, str]:
    """Return the address of the page that says why, of each rollout that has an outcome and a
    page.
    """
    pages = {
        rollout.path: run.href(rollout, WHY_NAME)
        for rollout in run.rollouts
        if rollout.ok and outcomes_of(rollout)
    }
    return {path: page for path, page in pages.items() if page}


def _commit(project: Project | None) -> str:
    """Return the commit of the user's project, and whether files differ from it."""
    if project is None:
        return ""
    return (project.commit or "") + (", files changed" if project.dirty else "")


def command_of(run: Run) -> str:
    """Return the command that made a run."""
    return shlex.join(run.info.command)


def by_interest(run: Run) -> list[str]:
    """Sort scenes by how much there is to see: events and failures first, then the largest distance
    from the logged path.
    """

    def interest(scene: str) -> tuple[int, float]:
        rollouts = run.by_scene[scene]
        events = sum(len(outcomes_of(rollout)) if has_ended(rollout) else 1 for rollout in rollouts)
        distances_m = [rollout.metrics.get("lateral_distance_m") for rollout in rollouts]
        return events, max((d_m for d_m in distances_m if d_m is not None), default=0.0)

    return sorted(run.by_scene, key=interest, reverse=True)


def marked_events(views: Sequence[JsonView]) -> list[str]:
    """Name the events that maps mark, in the order of the outcomes: collisions with a round sign,
    others with a square one.
    """
    kinds = {mark["kind"] for view in views for mark in view["marks"]}
    words = {"collision": "collision"} | {name: OUTCOMES[name].words for name in OTHERS}
    return [words[kind] for kind in words if kind in kinds]


def scene_views(
    run: Run,
    series: Series,
    interesting: list[str],
    variant_of: Mapping[tuple[str, str], tuple[int, int]],
) -> tuple[list[JsonObject], list[str]]:
    """Lay out the most telling scenes within the limits of count and size.

    Returns:
        The maps (in the order of the run where all are shown at once, else the most telling
        first), and the scenes not drawn.
    """
    views: dict[str, JsonObject] = {}
    spent = 0
    for scene in interesting:
        content = run.scene_data(scene)
        if content is None or len(content["ego_log"]["x_m"]) < 2:
            continue
        if len(views) >= MAX_SCENE_PLOTS or spent > PLOT_BUDGET_BYTES:
            break
        with parsing(run.scene_path(scene) or scene, AGAIN, "no scene that can be drawn"):
            views[scene] = still_map(scene, content, run.by_scene[scene], series, variant_of)
        spent += len(json.dumps(views[scene]))
    order = run.scenes if len(views) <= OPEN_SCENE_PLOTS else interesting
    return [views[s] for s in order if s in views], [s for s in run.scenes if s not in views]
