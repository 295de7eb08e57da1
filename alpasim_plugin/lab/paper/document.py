"""The comparison as one markdown document: tables beside the paper's, the wrong map, quality by
frame, time, and the verdicts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from alpasim_plugin.lab.paper import wrong_map
from alpasim_plugin.lab.paper.appearance import appearance_section
from alpasim_plugin.lab.paper.bubbles import plot_bubbles
from alpasim_plugin.lab.paper.claims import MARGINS, OURS
from alpasim_plugin.lab.paper.closed_loop import Driven, closed_loop_section, plot_closed_loop
from alpasim_plugin.lab.paper.cost import Cost, cost_section, plot_cost
from alpasim_plugin.lab.paper.measured import Measured
from alpasim_plugin.lab.paper.page import ShownClip
from alpasim_plugin.lab.paper.position import (
    DRAWN,
    DRIFTING,
    by_position,
    distance_by_position,
    drift,
)
from alpasim_plugin.lab.paper.published import Published
from alpasim_plugin.lab.paper.regime import RegimeClip, plot_regime, regime_section
from alpasim_plugin.lab.paper.tables import (
    differences,
    markdown_table,
    paper_against_ours,
    verdicts,
    with_half,
)
from alpasim_plugin.lab.paper.training import WITHIN, TrainedArm, training_section
from alpasim_plugin.lab.paper.transfer import transfer_section
from alpasim_plugin.lab.paper.verdict import Evidence, Judged, in_both, judge_claims
from alpasim_plugin.lab.video_metrics.charts import plot_by_frame
from alpasim_plugin.lab.video_metrics.summary import summarise

WRONG_MAP, POSITION, DRIFT, COST = (
    "wrong-map.png",
    "by-position.png",
    "drift.png",
    "cost.png",
)  # figures beside the document
CLOSED_LOOP = "closed-loop.png"
REGIME = "regime.png"
BUBBLES = "bubbles.png"
PERIOD_MS = 100.0  # between frames of the pairs
TIMES = """Median over blocks of each clip, mean over clips, one thread; drawing of map and render is not included. The first frame of a
block waits for the frames that the block looks ahead to, 100 ms apart, and for the block's computation.
"""
JUDGED = """A claim is a sentence of the paper as comparisons over the same clips or scenes; a difference below the metric's margin does
not count. *Power* is the chance that an interval as wide as that of the weakest comparison decides for the claim where the truth is
the margin (for equality: no difference). `not trained`: an arm of a decided comparison has no better mean than the raw render that it
was given, the negative control. Where one arm trains its decoder, the other must have too (`V9, decoder trained`). A claim on histories
is judged only where the truth as history is worth the margin. Dropped: "distilled arms are close to OmniDreams at one step over 900
frames", which held here because a tenth of PSNR is 2.2 dB.
"""
BASELINE = "3dgs"
LEADS = (OURS, "onefixer")  # whose paired differences with all others are shown
PAIRED = (
    "psnr_db",
    "perceptual-syn",
    "fd_syn_clip",
    "fvmd_lk",
    "warp_l1",
    "lane_f1_syn",
    "cuboid_f1_syn",
)
HOW = """A claim is a paired difference over the same clips, 95 %: a t interval, or for metrics of whole sets (`fd_syn_clip`, `fvmd_lk`)
a test that swaps whole clips. Bold: shown. Absolute values do not compare with the paper's: other scenes, networks and resolution; our
metrics stand in the place of those that need networks of others. Every arm but `onefixer` has the same backbone here."""


TABLES = (  # protocol, table of the paper, heading
    ("cycle", "cycle", "Cycle renders"),
    ("under-trained", "under-trained", "Under-trained reconstructions"),
    ("cycle", "ablation", "Ablation"),
)
EQUAL_TIME = """Every arm has the same processor time instead of the paper's updates; clips, noise and judges are the same.
"""
TAKEN = """With the paper's updates these arms took this time already, within {:.0f} %, and their weights stand here too: {}.
"""
BOTH = """A claim holds if it holds under both budgets, and does not if it does not under one. What was measured under one alone counts for
both.
"""


@dataclass
class Findings:
    """What a comparison found, as far as it is done.

    Args:
        measured: PROTOCOL -> what was measured; one that was not run is not there. ``map-error``
            holds groups of configurations.
        rows: PROTOCOL -> rows of clips, for quality by frame.
        shown: Filmed clips.
        units: ARM -> ``frames``, ``lookahead_frames`` and ``calls_per_frame`` of what it makes at a
            time.
        shifted: ``map-error`` with an arm for each configuration, and how far each is off.
        memory: Table of the peak memory of a training sample; empty where it was not measured.
        cost: Quality against training time; None where it was not measured.
        training: How the arms were trained; empty where nothing is known of it.
        equal_time: The same arms trained with equal core-minutes; None where they were not
            measured.
        regime: Clips of the regime map.
        recorded: PROTOCOL -> what an earlier comparison left, by which claims are judged that
            nothing here judges.
    """

    measured: dict[str, Measured] = field(default_factory=dict)
    rows: dict[str, Sequence[Mapping[str, Any]]] = field(default_factory=dict)
    units: Mapping[str, Mapping[str, Any] | None] = field(default_factory=dict)
    shown: Sequence[ShownClip] = ()
    shifted: tuple[Measured, Mapping[str, wrong_map.Shift]] | None = None
    memory: str = ""
    cost: Cost | None = None
    training: Sequence[TrainedArm] = ()
    equal_time: EqualTime | None = None
    regime: Sequence[RegimeClip] = ()
    recorded: Mapping[str, Evidence] = field(default_factory=dict)

    @property
    def judged(self) -> tuple[Judged, ...]:
        """Verdicts by these measurements, or by the record where these leave a claim without
        one.
        """
        pairs = zip(judge_claims(self.measured), judge_claims(self.recorded), strict=True)
        return tuple(old if new.verdict == "not measured" else new for new, old in pairs)


@dataclass(frozen=True)
class EqualTime:
    """The arms trained with equal core-minutes instead of the paper's updates.

    Args:
        measured: PROTOCOL -> what was measured of them, beside the render and the shipped fixers.
        training: How they were trained.
        taken: Those of them whose training with the paper's updates took as long, so that its
            weights stand here too.
    """

    measured: Mapping[str, Measured]
    training: Sequence[TrainedArm]
    taken: Sequence[str] = ()


def document(published: Published, found: Findings, command: str) -> str:
    """Return the document.

    Args:
        published: The paper's numbers.
        found: What was measured.
        command: That makes it.
    """
    measured, rows = found.measured, found.rows
    parts = [f"```bash\n{command}\n```\n", HOW + "\n", *_tables(published, measured, TABLES)]
    sections = {
        "In closed loop": closed_loop_section(published, _drives(found), CLOSED_LOOP),
        "A wrong map": _map_errors(found),
        "Beyond driving": transfer_section(published, measured),
        "Night, fog and snow": appearance_section(published, measured),
        "By position": _positions(measured["under-trained"], rows["under-trained"])
        if "under-trained" in rows
        else "",
        "Drift": drift(measured["cycle"], rows["cycle"]) + f"\n![Quality by frame]({DRIFT})"
        if "cycle" in rows
        else "",
        "Time": _times(measured["cycle"], found.units) if "cycle" in measured else "",
        "Memory": found.memory,
        "Core-minutes to quality": "" if found.cost is None else cost_section(found.cost, COST),
        "Training": training_section(found.training),
        "Equal core-minutes": ""
        if found.equal_time is None
        else _equal_time(published, found.equal_time),
    }
    parts += [f"## {heading}\n\n{text or 'Not run.'}\n" for heading, text in sections.items()]
    return "\n".join(parts) + "\n" + claims_document(found)


def claims_document(found: Findings) -> str:
    """Return the sections on the paper's claims, their picture, and the regime map."""
    sections = {
        "The paper's claims": f"{JUDGED}\n{margins()}\n{_verdicts(found)}\n![Quality, consistency and latency]({BUBBLES})\n",
        "The regime map": regime_section(found.regime, REGIME),
    }
    return "\n".join(
        f"## {heading}\n\n{text or 'Not run.'}\n" for heading, text in sections.items()
    )


def _tables(
    published: Published,
    measured: Mapping[str, Measured],
    tables: Sequence[tuple[str, str, str]],
    level: str = "##",
) -> list[str]:
    parts = []
    for name, table, heading in tables:
        parts.append(f"{level} {heading}\n")
        if name not in measured:
            parts.append("Not run.\n")
            continue
        mine = measured[name]
        parts.append(
            paper_against_ours(published, table, _of_table(mine, published.tables[table].rows))
        )
        for lead in (arm for arm in LEADS if table != "ablation" and arm in mine.arms):
            has = [metric for metric in PAIRED if mine.has(lead, metric)]
            parts.append(
                "\n" + differences(mine, lead, [arm for arm in mine.arms if arm != lead], has)
            )
        parts.append(f"\n{_counts(mine)}\n")
    return parts


def _equal_time(published: Published, found: EqualTime) -> str:
    tables = [table for table in TABLES if table[0] in found.measured]
    taken = (
        TAKEN.format(100 * WITHIN, ", ".join(f"`{arm}`" for arm in found.taken))
        if found.taken
        else ""
    )
    return "\n".join(
        (
            EQUAL_TIME + taken,
            training_section(found.training),
            *_tables(published, found.measured, tables, "###"),
        )
    )


def _verdicts(found: Findings) -> str:
    """Return the verdicts, and below them those that both budgets give; a protocol that only one
    was measured under counts for both.
    """
    judged = found.judged
    if found.equal_time is None:
        return verdicts(judged)
    again = judge_claims({**found.measured, **found.equal_time.measured})
    pairs = enumerate(zip(judged, again, strict=True), start=1)
    rows = [
        [str(i), a.verdict, b.verdict, f"**{in_both(a.verdict, b.verdict)}**"]
        for i, (a, b) in pairs
    ]
    table = markdown_table(
        ["claim", "updates as in the paper", "equal core-minutes", "in both"], rows
    )
    return f"{verdicts(judged)}\n### Under both budgets\n\n{BOTH}\n{table}"


def margins() -> str:
    """Return the margins of all metrics in one line."""
    return f"Margins: {', '.join(f'`{name}` {value:g}' for name, value in MARGINS.items())}.\n"


def _drives(found: Findings) -> list[Driven]:
    return [one for one in found.measured.values() if isinstance(one, Driven)]


def draw_figures(found: Findings, folder: Path) -> None:
    """Write the document's figures beside it: those of the protocols that were run."""
    if drives := _drives(found):
        plot_closed_loop(drives, folder / CLOSED_LOOP)
    if found.regime:
        plot_regime(found.regime, folder / REGIME)
    if (cycle := found.measured.get("cycle") or found.recorded.get("cycle")) is not None:
        plot_bubbles(cycle, folder / BUBBLES)
    if found.shifted is not None:
        wrong_map.plot(*found.shifted, folder / WRONG_MAP)
    if found.cost is not None:
        plot_cost(found.cost, folder / COST)
    for name, protocol, arms in ((POSITION, "under-trained", DRAWN), (DRIFT, "cycle", DRIFTING)):
        shown = [row for row in found.rows.get(protocol, ()) if row["arm"] in arms]
        if shown:
            plot_by_frame(summarise(shown, BASELINE), folder / name)


def _of_table(measured: Measured, rows: Mapping[str, Any]) -> Measured:
    """Leave variants of the ablation out of Table 1 and other arms out of the ablation; the raw
    render and our arms stay in both.
    """
    ablation = "V1" in rows
    always = {measured.reference, "3dgs", "onefixer", "onefixer-dit-tiny"}
    is_variant = {arm: arm.startswith("V") for arm in measured.values}
    kept = [
        arm
        for arm in measured.values
        if arm in rows or arm in always or is_variant[arm] == ablation
    ]
    return measured.only(kept)


def _counts(measured: Measured) -> str:
    most = max((len(clips) for clips in measured.values.values()), default=0)
    return f"{most} clips, {len(measured.arms)} arms."


def _map_errors(found: Findings) -> str:
    if "map-error" not in found.measured:
        return ""
    text = wrong_map.means(found.measured["map-error"])
    return (
        text
        if found.shifted is None
        else f"{text}\n{wrong_map.ranges(*found.shifted)}\n![Boxes over configurations]({WRONG_MAP})"
    )


def _positions(measured: Measured, rows: Sequence[Mapping[str, Any]]) -> str:
    """Return PSNR, perceptual distance and Frechet distance by position."""
    frames = min((int(row["frames"]) for row in rows), default=0)
    return (
        by_position(rows)
        + "\n"
        + distance_by_position(measured, frames)
        + f"\n![Quality by frame]({POSITION})"
    )


def _times(measured: Measured, units: Mapping[str, Mapping[str, Any] | None]) -> str:
    """Return time and latency: a frame waits for the frames that its block looks ahead to, and for
    the whole block's computation.
    """
    rows = []
    for arm in measured.arms:
        unit = units.get(arm)
        if not measured.has(arm, "ms_per_frame") or unit is None:
            continue
        found = measured.mean(arm, "ms_per_frame")
        first = unit["lookahead_frames"] * PERIOD_MS + unit["frames"] * found.centre
        calls = f"{unit['calls_per_frame']:.3g}"
        rows.append(
            [arm, with_half(found, 1), calls, str(unit["lookahead_frames"]), f"{first:.0f}"]
        )
    head = [
        "arm",
        "ms a frame",
        "network calls a frame",
        "look-ahead, frames",
        "first frame of a block, ms",
    ]
    return TIMES + "\n" + markdown_table(head, rows)
