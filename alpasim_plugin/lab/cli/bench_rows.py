"""Rows of a benchmark as a table in the terminal, or as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from alpasim_plugin.core.printing import say_document

WIDEST = 10_000  # characters of a table


def print_rows(rows: Sequence[Mapping[str, Any]], as_json: bool) -> None:
    """Print rows of equal keys; numbers with three digits, a dash for None.

    A word that is the same in all of several rows stands once, above the table. A table that is wider than the
    terminal is never cut: its lines go on in the next.
    """
    if as_json:
        say_document(rows)
        return
    common = _common(rows) if len(rows) > 1 else {}
    table = Table(box=None, header_style="bold")
    columns = [name for name in rows[0] if name not in common]
    for name in columns:
        table.add_column(name.replace("_", " "), justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*(_text(row[name]) for name in columns))
    terminal = Console()
    needed = Console(width=WIDEST).measure(table).maximum
    if common:
        head = ", ".join(f"{name.replace('_', ' ')} {_text(common[name])}" for name in common)
        terminal.print(f"{head}:", highlight=False, soft_wrap=True)
    Console(width=max(terminal.width, needed)).print(table)


def _common(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the columns of words that have the same in all rows; never all columns."""
    common = {
        name: word
        for name, word in rows[0].items()
        if isinstance(word, str) and all(row[name] == word for row in rows)
    }
    return common if len(common) < len(rows[0]) else {}


def _text(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
