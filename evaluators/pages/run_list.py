"""Write ``runs/index.html``: every run of a folder on one page that opens from disk without a
network.
"""

import base64
import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from markupsafe import Markup

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import read_text
from alpasim_plugin.core.files.atomic import write_text
from alpasim_plugin.core.printing import warn
from alpasim_plugin.log.run_folder.schema import GATE_FILES, PAGES, cell_name
from evaluators.pages.gate import gate_badge
from evaluators.pages.html import asset, environment_of
from evaluators.pages.overview import TONES
from evaluators.pages.runs import NO_INFO, RunEntry, first_scenario
from evaluators.results import Change
from evaluators.statistics.numbers import DASH, plural

NAME = "index.html"
MARK = (
    '<meta name="generator" content="simrun list of runs">'  # a page without it is somebody's own
)
MOST_ROWS = 1000
STYLES = ("theme.css", "report.css")
SCRIPTS = ("theme.js", "run_list.js")


@dataclass(frozen=True)
class VariantLine:
    """One variant of a run in the list.

    Attributes:
        name: Renderer and policy.
        endings: How many of its rollouts ended in which way, the best first.
        change: Since the run before with the same scenes and variant; empty where there is none.
        tone: Colour of the change.
        earlier: Link to that run; empty where there is none.
    """

    name: str
    endings: dict[str, int]
    change: str
    tone: str
    earlier: str


@dataclass(frozen=True)
class RunLine:
    """One run in the list.

    Attributes:
        name: Its folder, from the folder of the list.
        link: To its report, or to its folder where it has none.
        began: Date and time in UTC.
        suite: What the command named first, and how many more.
        size: Scenes and seeds.
        state: What is to be said of a run that is not finished, or damaged; else empty.
        gate: Verdict of the last gate and its colour; None where no gate was asked.
        variants: Empty where the run is not finished.
    """

    name: str
    link: str
    began: str
    suite: str
    size: str
    preset: str
    state: str
    gate: tuple[str, str] | None
    variants: tuple[VariantLine, ...]


def write_run_list(
    root: Path, entries: Sequence[RunEntry], changes: Sequence[Mapping[str, Change]]
) -> Path | None:
    """Write the list of the runs below a folder into it and return its path; None, with a warning,
    where a page of somebody else has its name.

    Args:
        root: A folder of run folders, such as ``runs``.
        entries: The runs below it, the newest first.
        changes: Of each run, RENDERER/POLICY -> how it changed since an earlier one
            (`evaluators.statistics.history`).

    Raises:
        InfrastructureError: The disk refused.
    """
    path = root / NAME
    if os.path.lexists(path) and not _is_ours(path):
        warn(f"{path}: is not a list that simrun wrote, and is left as it is")
        return None
    environment = environment_of("evaluators.pages")
    style = "\n".join(asset(environment, name) for name in STYLES)
    script = "\n".join(asset(environment, name) for name in SCRIPTS)
    text = environment.get_template("run_list.html.j2").render(
        mark=Markup(MARK),
        style=Markup(style),
        script=Markup(script),
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        lines=run_lines(entries, changes, root)[:MOST_ROWS],
        n_runs=len(entries),
        n_left_out=len(entries[MOST_ROWS:]),
        ending_tones=TONES,
    )
    write_text(path, text)
    return path


def _is_ours(path: Path) -> bool:
    try:
        return MARK in read_text(path)
    except InputError:
        return False


def run_lines(
    entries: Sequence[RunEntry], changes: Sequence[Mapping[str, Change]], root: Path
) -> list[RunLine]:
    """Lay out runs; see `write_run_list`."""
    links = [_link(entry, root) for entry in entries]
    return [
        _run_line(entry, variant_lines(entry, of_run, links), link, root)
        for entry, of_run, link in zip(entries, changes, links, strict=True)
    ]


def _run_line(entry: RunEntry, variants: Sequence[VariantLine], link: str, root: Path) -> RunLine:
    info = entry.info or NO_INFO
    state = "" if entry.state == "finished" else entry.state
    return RunLine(
        name=os.path.relpath(entry.folder, root),
        link=link,
        began=(info.started_at or DASH)[:16].replace("T", " "),
        suite=first_scenario(info) or DASH,
        size=f"{plural(len(info.scenes), 'scene')} \u00d7 {plural(len(info.seeds), 'seed')}",
        preset=info.preset or DASH,
        state=f"{state}: {entry.problem}" if entry.problem else state,
        gate=gate_badge(entry.folder) if os.path.isfile(entry.folder / GATE_FILES[0]) else None,
        variants=tuple(variants),
    )


def variant_lines(
    entry: RunEntry, changes: Mapping[str, Change], links: Sequence[str]
) -> list[VariantLine]:
    """Lay out the variants of a run with their changes; none where it is not finished.

    Args:
        entry: The run.
        changes: RENDERER/POLICY -> how it changed since an earlier run.
        links: To each run of the list.
    """
    lines = []
    for renderer, policy in entry.variants:
        variant = cell_name(renderer, policy)
        endings = None if entry.summary is None else entry.summary.outcomes.get(variant)
        if endings is None:
            continue
        change = changes.get(variant)
        text, tone = ("", "") if change is None else change_text(change)
        earlier = "" if change is None else links[change.run]
        lines.append(VariantLine(f"{renderer} / {policy}", endings.endings, text, tone, earlier))
    return lines


def change_text(change: Change) -> tuple[str, str]:
    """Say how many more or fewer rollouts failed than in the run before, and its colour.

    Example:
        >>> change_text(Change(run=1, earlier_failed=1, later_failed=3, more_failed=2))
        ('2 more failed', 'worse')
    """
    number = abs(change.more_failed)
    if number == 0:
        return "as many failed", "unclear"
    if change.more_failed > 0:
        return f"{number} more failed", "worse"
    return f"{number} fewer failed", "better"


def _link(entry: RunEntry, root: Path) -> str:
    page = entry.folder / PAGES[0]
    place = os.path.relpath(page if os.path.isfile(page) else entry.folder, root)
    return quote(Path(place).as_posix()) + ("" if os.path.isfile(page) else "/")
