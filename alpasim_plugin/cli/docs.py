"""``simrun docs``: the pages of the documentation, which travel with the program."""

import difflib
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from rich.console import Console
from rich.markdown import Markdown

from alpasim_plugin.cli.options import Json
from alpasim_plugin.cli.output import show
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import read_text
from alpasim_plugin.core.flags import Positional

# of a checkout, of the wheel
FOLDERS = (
    Path(__file__).resolve().parents[2] / "docs",
    Path(sys.prefix, "share", "simrun", "docs"),
)
EPILOG = """
Examples:

- `simrun docs`: all pages, a line each

- `simrun docs policies`: how to put a policy in

- `simrun docs experiments/speed`: a page of a folder
"""


def docs(
    page: Annotated[str | None, Positional("A page, such as `policies`; none: all.")] = None,
    as_json: Json = False,
) -> None:
    """Read a page of the documentation, or list all."""
    folder = next((path for path in FOLDERS if os.path.isfile(path / "index.md")), None)
    if folder is None:
        raise InputError(
            f"{FOLDERS[1]}: this installation has no pages",
            "Install the wheel with pip, or use a checkout.",
        )
    texts = {}
    for path in sorted(folder.rglob("*.md"), key=lambda path: (len(path.parts), path)):
        texts[path.relative_to(folder).with_suffix("").as_posix()] = read_text(path)
    titles = {name: text.partition("\n")[0].removeprefix("# ") for name, text in texts.items()}
    if page is None:
        show(as_json, titles, *(f"{name:<32}{title}" for name, title in titles.items()))
        return
    name = _name_of(page, list(texts))
    if name not in texts:
        near = difflib.get_close_matches(name, texts, 1)
        near = near or [page for page, title in titles.items() if name.lower() in title.lower()]
        guess = f"did you mean {' or '.join(map(repr, near[:3]))}? " if near else ""
        raise InputError(
            f"{page}: no such page among {len(texts)}", f"{guess}simrun docs lists all"
        )
    facts = {"page": name, "path": str(folder / f"{name}.md"), "text": texts[name]}
    if as_json or not sys.stdout.isatty():
        show(as_json, facts, *texts[name].rstrip("\n").split("\n"))
        return
    console = Console()
    with console.pager(styles=True):
        console.print(Markdown(texts[name]))


def _name_of(page: str, names: Sequence[str]) -> str:
    """Return the name of the page that a word stands for: whole, as a file, or the last part of one
    page's name alone.
    """
    name = page.removeprefix("docs/").removesuffix(".md")
    same_end = [candidate for candidate in names if Path(candidate).name == Path(name).name]
    return name if name in names or len(same_end) != 1 else same_end[0]
