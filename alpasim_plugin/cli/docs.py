"""``simrun docs``: the pages of the documentation, which travel with the program."""

from __future__ import annotations

import difflib
import json
import sys
from pathlib import Path
from typing import Annotated

from alpasim_plugin.cli.options import Json
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.flags import Positional

FOLDERS = (
    Path(__file__).resolve().parents[2] / "docs",
    Path(sys.prefix, "share", "simrun", "docs"),
)  # of a checkout, of the wheel
EPILOG = """
Examples:

- `simrun docs`: all pages, a line each

- `simrun docs policies`: how to put a policy in
"""


def docs(
    page: Annotated[
        str | None, Positional("A page, such as `policies` or `ci`; without it all are listed.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Read a page of the documentation in the terminal, or list all."""
    folder = next((one for one in FOLDERS if (one / "index.md").is_file()), None)
    if folder is None:
        raise InputError(
            f"{FOLDERS[1]}: this installation has no pages",
            "install the wheel with pip, or use a checkout",
        )
    pages = {path.stem: path for path in sorted(folder.glob("*.md"))}
    if page is None:
        titles = {
            name: path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
            for name, path in pages.items()
        }
        print(
            json.dumps(titles)
            if as_json
            else "\n".join(f"{name:<24}{title}" for name, title in titles.items())
        )
        return
    name = Path(page).stem
    if name not in pages:
        near = difflib.get_close_matches(name, pages, 1) or ["index"]
        raise InputError(
            f"{page}: no such page among {len(pages)}",
            f"did you mean {near[0]!r}? simrun docs lists all",
        )
    text = pages[name].read_text(encoding="utf-8")
    if as_json:
        print(json.dumps({"page": name, "path": str(pages[name]), "text": text}))
    elif sys.stdout.isatty():
        from rich.console import Console
        from rich.markdown import Markdown

        console = Console()
        with console.pager(styles=True):
            console.print(Markdown(text))
    else:
        print(text, end="")
