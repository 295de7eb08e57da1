"""What these scripts share: Markdown tables, and blocks of pages between two comments."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1]


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; bars inside of cells are escaped."""
    lines = [head, ["---"] * len(head), *rows]
    cells = [[cell.replace("|", r"\|") for cell in line] for line in lines]
    return "\n".join(f"|{'|'.join(line)}|" for line in cells) + "\n"


def replaced(text: str, block: str, content: str) -> str:
    """Replace what stands between a block's two comments."""
    pattern = rf"(<!-- begin {block}\b[^\n]*-->\n).*?(<!-- end {block} -->)"
    text, count = re.subn(pattern, lambda match: match[1] + content + match[2], text, flags=re.S)
    assert count == 1, f"the page has {count} blocks called {block}"
    return text


def write(pages: Mapping[Path, str]) -> None:
    """Write the pages that are stale; with ``--check`` on the command line exit with 1 instead."""
    stale = [path for path, text in pages.items() if path.read_text(encoding="utf-8") != text]
    if "--check" in sys.argv:
        sys.exit(f"stale: {', '.join(map(str, stale))}" if stale else 0)
    for path in stale:
        path.write_text(pages[path], encoding="utf-8")
