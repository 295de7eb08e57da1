"""Reports from a run folder: HTML, Markdown, JUnit and the terminal table. A pure reader: no renderer, no policy, no scenario files."""

from evaluators.report.fixers import fixer_lines
from evaluators.report.html import write_report
from evaluators.report.junit import write_junit
from evaluators.report.summary import write_summary_md
from evaluators.report.terminal import render_table

__all__ = ["fixer_lines", "render_table", "write_junit", "write_report", "write_summary_md"]
