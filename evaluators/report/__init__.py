"""Reports from a run folder: HTML, Markdown, JUnit and the terminal table. A pure reader: no
renderer, no policy, no scenario files.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from alpasim_plugin.core.lazy import lazy_names

if TYPE_CHECKING:
    from evaluators.report.ci import write_junit, write_summary_md
    from evaluators.report.html import write_report
    from evaluators.report.overview import overview_of
    from evaluators.report.terminal import (
        metric_lines,
        next_line,
        overview_lines,
        render_presets,
    )

__all__ = [
    "metric_lines",
    "next_line",
    "overview_lines",
    "overview_of",
    "render_presets",
    "write_junit",
    "write_report",
    "write_summary_md",
]

_HOMES = {
    ".ci": ("write_junit", "write_summary_md"),
    ".overview": ("overview_of",),
    ".html": ("write_report",),
    ".terminal": ("next_line", "overview_lines", "render_presets", "metric_lines"),
}
__getattr__ = lazy_names(__name__, {name: home for home, names in _HOMES.items() for name in names})
