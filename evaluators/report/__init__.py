"""Reports from a run folder: HTML, Markdown, JUnit and the terminal table. A pure reader: no renderer, no policy, no scenario files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from alpasim_plugin.core.lazy import lazy_names

if TYPE_CHECKING:
    from evaluators.report.ci import write_junit as write_junit
    from evaluators.report.ci import write_summary_md as write_summary_md
    from evaluators.report.fixers import fixer_lines as fixer_lines
    from evaluators.report.headline import plan_warnings as plan_warnings
    from evaluators.report.html import write_report as write_report
    from evaluators.report.terminal import ending_lines as ending_lines
    from evaluators.report.terminal import next_line as next_line
    from evaluators.report.terminal import render_table as render_table

__all__ = ["ending_lines", "fixer_lines", "next_line", "plan_warnings", "render_table", "write_junit", "write_report", "write_summary_md"]

__getattr__ = lazy_names(
    __name__,
    {
        "ending_lines": ".terminal",
        "fixer_lines": ".fixers",
        "next_line": ".terminal",
        "plan_warnings": ".headline",
        "render_table": ".terminal",
        "write_junit": ".ci",
        "write_report": ".html",
        "write_summary_md": ".ci",
    },
)
