"""Reports from a run folder: HTML, Markdown, JUnit and the terminal table. A pure reader: no
renderer, no policy, no scenario files.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from alpasim_plugin.core.lazy import lazy_names

if TYPE_CHECKING:
    from evaluators.report.ci import write_junit, write_summary_md
    from evaluators.report.fixers import fixer_lines
    from evaluators.report.html import write_report
    from evaluators.report.terminal import ending_lines, next_line, render_presets, render_table

__all__ = [
    "ending_lines",
    "fixer_lines",
    "next_line",
    "render_presets",
    "render_table",
    "write_junit",
    "write_report",
    "write_summary_md",
]

_HOMES = {
    ".ci": ("write_junit", "write_summary_md"),
    ".fixers": ("fixer_lines",),
    ".html": ("write_report",),
    ".terminal": ("ending_lines", "next_line", "render_presets", "render_table"),
}
__getattr__ = lazy_names(__name__, {name: home for home, names in _HOMES.items() for name in names})
