"""Write ``report.html``: one file that opens from disk without a network."""

from __future__ import annotations

import base64
import hashlib
import marshal
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from importlib.util import MAGIC_NUMBER
from pathlib import Path
from typing import Any

import cv2
from jinja2 import BytecodeCache, ChoiceLoader, Environment, PackageLoader, StrictUndefined
from jinja2 import __version__ as jinja_version
from jinja2.bccache import Bucket
from markupsafe import Markup

from alpasim_plugin.core.atomic import write_bytes, write_text
from alpasim_plugin.core.errors import InfrastructureError, InputError
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
from evaluators.report.charts import forest, speed_against_error
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
from evaluators.report.rollouts import drift_charts, read_series, rollout_block
from evaluators.report.tables import SCENE_METRICS, scene_rows
from evaluators.report.verdict import find

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
    """Render the report as a string; ``replays`` as in `write_report`."""
    return render_page(
        "report.html.j2",
        ("theme", "report"),
        ("theme", "report", "rollouts"),
        dash=DASH,
        replays=replays,
        **context(run),
    )


class CompiledBeside(BytecodeCache):
    """Keeps compiled templates in a ``__pycache__``, as Python does with modules, and where Python
    does.

    A file that is not whole, or of other versions, is made again; where none can be written, every
    process compiles.
    """

    folder = Path(__file__).with_name("__pycache__")
    head = MAGIC_NUMBER + f"{jinja_version}\n".encode()

    def load_bytecode(self, bucket: Bucket) -> None:
        """Take the code of a template of this source."""
        with suppress(OSError):
            found = (self.folder / f"{bucket.key}.template").read_bytes()
            code = found[len(self.head) + 32 :]
            if found == self._whole(bucket, code):
                bucket.code = marshal.loads(code)

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Keep the code of a template."""
        if not sys.dont_write_bytecode:
            with suppress(OSError, InfrastructureError):
                write_bytes(
                    self.folder / f"{bucket.key}.template",
                    self._whole(bucket, marshal.dumps(bucket.code)),
                )

    def _whole(self, bucket: Bucket, code: bytes) -> bytes:
        return self.head + hashlib.sha256(bucket.checksum.encode() + code).digest() + code


@cache
def environment_of(*packages: str) -> Environment:
    """Return the templates of packages, the first that has a name; a process reads each template
    once.
    """
    loader = ChoiceLoader([PackageLoader(package) for package in packages])
    return Environment(
        loader=loader,
        bytecode_cache=CompiledBeside(),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def render_page(template: str, styles: Sequence[str], scripts: Sequence[str], **values: Any) -> str:
    """Render a template with style sheets and scripts inside the page; the hash allows the page to
    run this script and no other.
    """
    environment = environment_of("evaluators.report")
    style = "\n".join(asset(environment, f"{name}.css") for name in styles)
    script = "\n".join(asset(environment, f"{name}.js") for name in scripts)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    page = {
        "style": Markup(style),
        "script": Markup(script),
        "script_hash": digest,
        "plural": plural,
    }
    return environment.get_template(template).render(page | values)


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
    by_scene, more_scene_rows = scene_rows(run, interesting)
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
        "when": _when(run.info.get("started_at")),
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
        "scene_rows": by_scene,
        "more_scene_rows": more_scene_rows,
        "scene_metrics": SCENE_METRICS,
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


def asset(environment: Environment, name: str) -> str:
    """Return the source of a style sheet or a script among the templates."""
    if environment.loader is None:
        raise RuntimeError("the template environment has no loader")
    return environment.loader.get_source(environment, name)[0]


def _when(text: Any) -> str:
    try:
        return datetime.fromisoformat(str(text)).strftime("%Y-%m-%d %H:%M %Z").strip()
    except ValueError:
        return str(text or "")


def _facts(run: Run) -> list[tuple[str, str]]:
    done = sum(r.ok for r in run.rollouts)
    wall = (run.summary.get("pool") or {}).get("wall_s")
    facts = [
        ("rollouts", f"{done} of {len(run.rollouts)} completed"),
        ("scenes", str(len(run.scenes))),
        ("seeds", str(len({r.seed for r in run.rollouts}))),
        ("renderers", ", ".join(run.renderers) or DASH),
        ("policy" if len(run.policies) == 1 else "policies", ", ".join(run.policies) or DASH),
        ("preset", str(run.summary.get("preset") or run.info.get("preset") or DASH)),
    ]
    return (
        [*facts, ("wall time", duration(float(wall)))] if isinstance(wall, int | float) else facts
    )


@dataclass(frozen=True)
class Shot:
    """One picture at the head of the report.

    Attributes:
        said: How the drive ended, and when.
        src: data: address.
        link: Where the drive is shown.
    """

    arm: str
    scene: str
    said: str
    src: str
    link: str | None


def shots(run: Run, interesting: Sequence[str]) -> list[Shot]:
    """Pick at most three pictures: of drives that failed, one an arm first; else of the arms in the
    most telling scene.

    Args:
        run: The run.
        interesting: Its scenes, the most telling first.
    """
    rank = {scene: i for i, scene in enumerate(interesting)}
    order = list(OUTCOMES)
    done = [one for one in run.rollouts if one.ok]
    failed = sorted(
        (one for one in done if outcomes_of(one)),
        key=lambda r: (min(order.index(o) for o in outcomes_of(r)), rank[r.scene]),
    )
    firsts = {one.variant: one for one in reversed(failed)}.values()
    rest = [one for one in done if interesting and one.scene == interesting[0]]
    found: list[Shot] = []
    for rollout in dict.fromkeys(
        one.cell for one in [*list(firsts)[::-1], *failed, *(rest if not failed else [])]
    ):
        shot = (
            _shot(run, next(one for one in done if one.cell == rollout))
            if len(found) < SHOTS
            else None
        )
        found += [shot] if shot else []
    return found


def _shot(run: Run, rollout: Rollout) -> Shot | None:
    path = run.file_of(rollout, STRIP_NAME)
    manifest = run.manifest(rollout)
    times = [int(t) for t in manifest.get("strip_t_us") or ()]
    if path is None or not times:
        return None
    first = first_failure(manifest)
    k = min(USUAL_FRAME, len(times) - 1)
    if (
        first is not None
    ):  # what led to it: after a contact the camera may be inside the other vehicle
        k = max((i for i, t_us in enumerate(times) if t_us <= int(first["t_us"])), default=0)
    try:
        strip = decode_image(read_bytes(path, SOURCE_BYTES), path)
    except InputError:
        return None  # the report says elsewhere that the picture is absent
    width = strip.shape[1] // len(times)
    picture = strip[:, k * width : (k + 1) * width]
    picture = cv2.resize(
        picture,
        (SHOT_WIDTH_PX, round(picture.shape[0] * SHOT_WIDTH_PX / width)),
        interpolation=cv2.INTER_AREA,
    )
    done, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 80])
    said = in_words(outcomes_of(rollout)) + (
        f" at {fixed(float(first['t_s']), 1)}\u00a0s" if first is not None else ""
    )
    arm = (
        rollout.policy
        if len(run.renderers) == 1
        else rollout.renderer
        if len(run.policies) == 1
        else rollout.variant
    )
    link = run.href(rollout, WHY_NAME) or run.href(rollout)
    return (
        Shot(
            arm,
            rollout.scene,
            said,
            "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode(),
            link,
        )
        if done
        else None
    )
