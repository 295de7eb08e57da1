"""The reports of a run folder, written together."""

from __future__ import annotations

from pathlib import Path


def write_reports(root: Path, flips: bool = True, page: bool = True) -> Path | None:
    """Write ``summary.md``, ``junit.xml`` and ``report.html`` of a run folder and return the path of the last.

    Args:
        root: A run folder whose tables are written.
        flips: Find cells whose outcome differs from their baseline's first; not for scored logs of others.
        page: Write ``report.html`` and the flips that it shows. Otherwise one of an earlier command is removed, and None is returned.
    """
    # Plotting libraries take a second to load, and a run needs them only now.
    from evaluators.report import write_junit, write_report, write_summary_md

    if flips and page:
        from alpasim_plugin.runtime.flips import write_flips

        write_flips(root)
    write_summary_md(root)
    write_junit(root)
    if page:
        return write_report(root)
    (root / "report.html").unlink(missing_ok=True)
    return None
