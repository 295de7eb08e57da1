"""The page: one HTML file without outside requests, or the shell that a server on this machine fills."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from alpasim_plugin.viewer.budget import as_json, fit, names
from alpasim_plugin.viewer.cells import WatchedCell
from alpasim_plugin.viewer.page_data import index_data
from alpasim_plugin.viewer.pictures import Fineness
from evaluators.opening import Run
from evaluators.report.html import asset
from evaluators.report.numbers import plural

MB = 1_000_000
DEFAULT_MB = 15.0  # megabytes, not mebibytes
SCRIPTS = ("theme.js", "timeline.js", "cameras.js", "birdseye.js", "curves.js", "moments.js", "player.js")
STYLES = ("theme.css", "viewer.css")


@dataclass(frozen=True)
class Options:
    """How a page is made.

    Attributes:
        max_bytes: Size of the file.
        fine: The finest camera frames that are kept.
        camera: Keep this camera alone.
    """

    max_bytes: int = int(DEFAULT_MB * MB)
    fine: Fineness = Fineness()
    camera: str | None = None


@dataclass(frozen=True)
class Page:
    """A page, and what is in it."""

    html: str
    cells: tuple[WatchedCell, ...]
    notes: tuple[str, ...]


def make_page(run: Run, cells: Sequence[WatchedCell], shown: Sequence[WatchedCell], options: Options, report: str = "") -> Page:
    """Return an offline page.

    Args:
        run: The run.
        cells: All that were asked for, the most telling first.
        shown: Those that the page holds as far as its size allows.
        options: Bounds.
        report: Address of the run's report, relative to the page.

    Raises:
        InputError: A rollout's files are damaged.
    """
    shell = len(render(as_json(index_data(run, cells, (), {"live": False, "notes": [], "report": report})), {}))
    fitted = fit(run, shown, options.max_bytes - shell, options.fine, options.camera)
    notes = _notes(cells, shown, fitted.too_many, fitted.fine)
    index = index_data(run, cells, fitted.cells, {"live": False, "notes": notes, "report": report})
    documents = dict(zip((cell.id for cell in fitted.cells), fitted.documents, strict=True))
    return Page(render(as_json(index), documents), fitted.cells, tuple(notes))


def render(index: str, documents: Mapping[str, str], live: bool = False) -> str:
    """Fill the template.

    Args:
        index: JSON of `index_data`.
        documents: Cell id -> JSON of `cell_data`.
        live: The page asks its own server for documents.
    """
    environment = _environment()
    script = "\n".join(asset(environment, name) for name in SCRIPTS)
    style = "\n".join(asset(environment, name) for name in STYLES)
    return environment.get_template("viewer.html.j2").render(
        style=Markup(style),
        style_hash=_sha256(style),
        script=Markup(script),
        script_hash=_sha256(script),
        index=Markup(index),
        documents={name: Markup(text) for name, text in documents.items()},
        live=live,
    )


@cache
def _environment() -> Environment:
    loader = ChoiceLoader([PackageLoader("alpasim_plugin.viewer"), PackageLoader("evaluators.report")])  # colours are the report's
    return Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)


def _sha256(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _notes(cells: Sequence[WatchedCell], shown: Sequence[WatchedCell], too_many: Sequence[WatchedCell], fine: Fineness) -> list[str]:
    """Say what the page does not hold, one sentence each."""
    ids = {cell.id for cell in shown}
    left = [cell for cell in cells if cell.id not in ids and cell.watchable]
    failed = [cell for cell in cells if not cell.watchable]
    notes = []
    if too_many:
        notes.append(f"No room for {plural(len(too_many), 'cell')}: {names(too_many)}. --max-mb makes room.")
    if left:
        what = "in which nothing happened" if all(cell.interest == "quiet" for cell in left) else "not chosen"
        how = "--scene, --policy and --seed choose, --cells sets how many."
        notes.append(f"{plural(len(left), 'cell')} {what} left out: {names(left)}. {how}")
    if failed:
        notes.append(f"Nothing to see of {plural(len(failed), 'cell')} in which every rollout failed: {names(failed)}.")
    if fine.stride > 1:
        notes.append(f"Every {ordinal(fine.stride)} camera frame is kept: --max-mb makes room. Poses, plans and metrics are whole.")
    return notes


def ordinal(number: int) -> str:
    """Name a small number in order.

    Example:
        >>> ordinal(2), ordinal(3), ordinal(4)
        ('second', 'third', '4th')
    """
    return {2: "second", 3: "third"}.get(number, f"{number}th")
