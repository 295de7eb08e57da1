"""The reports of a run folder, written together."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from alpasim_plugin.run_folder.schema import PAGES

Key = tuple[str, str, str, int]  # renderer, policy, scene, seed


def write_reports(root: Path, flips: bool = True, page: bool = True) -> Path | None:
    """Write ``summary.md``, ``junit.xml``, ``flips.html`` and ``report.html`` of a run folder and return the path of the last.

    Args:
        root: A run folder whose tables are written.
        flips: Find cells whose outcome differs from their baseline's first; not for scored logs of others.
        page: Write ``report.html`` and the flips that it shows and links to. Otherwise those of an earlier command are removed, and None is
            returned.
    """
    # Plotting libraries take a second to load, and a run needs them only now.
    from evaluators.report import write_junit, write_report, write_summary_md

    replays: Mapping[Key, str] = {}
    if flips and page:
        from alpasim_plugin.runtime.flips import write_flips
        from alpasim_plugin.viewer.write import write_flips_page

        write_flips(root)
        replays = write_flips_page(root)
    write_summary_md(root)
    write_junit(root)
    if page:
        return write_report(root, replays)
    for name in PAGES:
        (root / name).unlink(missing_ok=True)
    return None
