"""The tables of the scenario pages and of the limits in docs/, made from the schema and the bounds.

``python -m scenarios.schema_docs docs`` rewrites them.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from alpasim_plugin.core import limits as bounds
from alpasim_plugin.core.limits import Bound, number
from scenarios import budget
from scenarios.schema import models
from scenarios.schema_parts import Part

BEGIN, END = (
    "<!-- made by python -m scenarios.schema_docs docs -->\n",
    "<!-- end of what is made -->\n",
)
# page -> the sections of the schema whose tables it holds, by the first part of their path; the
# last page holds the rest
PAGES = {
    "scenario-road-keys.md": ("road", "environment"),
    "scenario-actor-keys.md": ("ego", "actors"),
    "scenario-keys.md": (),
}
LIMITS_PAGE = "limits.md"
WORDS = {float: "number", int: "integer", str: "text", bool: "`true`, `false`"}
HEAD = "| key | type | default | meaning |\n|---|---|---|---|"
SIGNS = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}


def page_of(where: str) -> str:
    """Return the page that documents the section at a dotted path, such as ``road.segments[] kind:
    arc``.
    """
    first = re.split(r"[^a-z]", where)[0]
    return next((page for page, sections in PAGES.items() if first in sections), list(PAGES)[-1])


def key_tables(page: str) -> str:
    """Return one Markdown table per section of a page; what all kinds of a list have alike stands
    in a table before theirs.
    """
    sections = {
        where: _rows(where, model) for where, model in models().items() if page_of(where) == page
    }
    out = []
    for where, rows in sections.items():
        owner, _, kind = where.partition(" kind: ")
        kinds = [
            set(sections[name]) for name in sections if kind and name.startswith(f"{owner} kind: ")
        ]
        in_most = {row for row in rows if sum(row in of_kind for of_kind in kinds) > len(kinds) / 2}
        names = (
            set.intersection(*({_key(row) for row in of_kind} for of_kind in kinds))
            if kinds
            else set()
        )
        alike = [row for row in rows if row in in_most and _key(row) in names]
        if alike and f"### `{owner}`\n" not in out:
            out += [
                f"### `{owner}`\n",
                "Keys of every kind; a kind's own table says what differs.\n",
                HEAD,
                *alike,
                "",
            ]
        summary = (models()[where].__doc__ or "").strip().split("\n")[0]
        out += [
            f"### {f'`{where}`' if where else 'Top level'}\n",
            f"{summary}\n",
            HEAD,
            *(row for row in rows if row not in alike),
            "",
        ]
    return "\n".join(out) + "\n"


def _rows(where: str, model: type[BaseModel]) -> list[str]:
    discriminator = "kind" if " kind: " in where else ""  # the heading says it
    fields = ((name, field) for name, field in model.model_fields.items() if name != discriminator)
    return [
        f"| `{name}` | {_kind(field)} | {_default(field)} | {field.description} |"
        for name, field in fields
    ]


def _key(row: str) -> str:
    return row.split(" | ", maxsplit=1)[0]


def limit_tables() -> str:
    """Return the tables of limits: what one scenario may cost, and the range of every quantity."""
    single = [value for value in vars(bounds).values() if isinstance(value, Bound)]
    return f"\n## What one scenario may hold\n\n{_limits(budget.BUDGETS)}\n## Ranges\n\n{_limits(single)}\n"


def _limits(rows: Sequence[Bound]) -> str:
    lines = ["| quantity | least | most |", "|---|---:|---:|"]
    lines += [
        f"| {row.name}{f' ({row.unit})' if row.unit else ''} | {number(row.low)} | {number(row.high)} |"
        for row in rows
    ]
    return "\n".join(lines) + "\n"


def _kind(field: FieldInfo) -> str:
    bound = {
        name: getattr(item, name)
        for item in field.metadata
        for name in SIGNS
        if getattr(item, name, None) is not None
    }
    if {"ge", "le"} <= bound.keys():
        return f"{_name(field.annotation)}, {bound['ge']}..{bound['le']}"
    return ", ".join(
        [_name(field.annotation), *(f"{SIGNS[name]} {value}" for name, value in bound.items())]
    )


def _name(annotation: Any) -> str:
    origin, options = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return ", ".join(f"`{a}`" for a in options)
    if hasattr(annotation, "__metadata__"):
        return _name(options[0])
    if origin is dict:
        return "keys"
    names = [_name(a) for a in options if a not in (type(None), Ellipsis)]
    if origin is tuple:
        return f"list of {min(names)}" if Ellipsis in options else f"{len(options)} x {min(names)}"
    if names:
        return " or ".join(dict.fromkeys(names))
    if isinstance(annotation, type) and issubclass(annotation, Part):
        return "section"
    return WORDS.get(annotation, "any value")


def _default(field: FieldInfo) -> str:
    value = field.default
    if value is PydanticUndefined:
        return "required"
    if value is None:
        return "none"
    if isinstance(value, Part):
        return "see below"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, tuple):
        return f"`[{', '.join(map(str, value))}]`"
    return f"`{value}`" if value not in ("", {}) else "empty"


def main(folder: Path) -> None:
    """Rewrite the tables between the marks of every page in a folder."""
    made = {page: key_tables(page) for page in PAGES} | {LIMITS_PAGE: limit_tables()}
    for page, tables in made.items():
        head, rest = (folder / page).read_text(encoding="utf-8").split(BEGIN)
        (folder / page).write_text(
            head + BEGIN + tables + END + rest.split(END)[1], encoding="utf-8"
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
