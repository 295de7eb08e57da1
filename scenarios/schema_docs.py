"""The key tables of docs/scenarios.md, made from the schema. ``python -m scenarios.schema_docs docs/scenarios.md`` rewrites them."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from scenarios.schema import models
from scenarios.schema_base import Part

BEGIN, END = "<!-- keys: begin -->\n", "<!-- keys: end -->"


def key_tables() -> str:
    """Return one Markdown table per section."""
    out = []
    for where, model in models().items():
        title = f"`{where}`" if where else "Top level"
        summary = (model.__doc__ or "").strip().split("\n")[0]
        told = "kind" if " kind: " in where else ""  # the heading says it where a union is told apart by it
        rows = [f"| `{name}` | {_kind(f)} | {_default(f)} | {f.description} |" for name, f in model.model_fields.items() if name != told]
        out.append("\n".join([f"### {title}", "", summary, "", "| key | type | default | meaning |", "|---|---|---|---|", *rows, "", ""]))
    return "".join(out)


def _kind(field: FieldInfo) -> str:
    text = _name(field.annotation)
    bounds = []
    for item in field.metadata:
        for sign, attribute in ((">", "gt"), (">=", "ge"), ("<", "lt"), ("<=", "le")):
            value = getattr(item, attribute, None)
            if value is not None:
                bounds.append(f"{sign} {value}")
    return ", ".join([text, *bounds])


def _name(annotation: Any) -> str:
    origin = get_origin(annotation)
    if origin is Literal:
        return " \\| ".join(f"`{a}`" for a in get_args(annotation))
    if hasattr(annotation, "__metadata__"):
        return _name(get_args(annotation)[0])
    if origin is tuple:
        parts = [a for a in get_args(annotation) if a is not Ellipsis]
        inner = sorted({_name(a) for a in parts})
        return f"list of {inner[0]}" if Ellipsis in get_args(annotation) else f"{len(parts)} x {inner[0]}"
    if origin is dict:
        return "keys"
    options = get_args(annotation)
    if options:
        names = [_name(a) for a in options if a is not type(None)]
        if all(n == "section" for n in names):
            return "section"
        return " or ".join(dict.fromkeys(names))
    if isinstance(annotation, type) and issubclass(annotation, Part):
        return "section"
    return {float: "number", int: "whole number", str: "text", bool: "true or false"}.get(annotation, "any value")


def _default(field: FieldInfo) -> str:
    if field.default is PydanticUndefined:
        return "required"
    value = field.default
    if value is None:
        return "none"
    if isinstance(value, Part):
        return "see below"
    if isinstance(value, tuple):
        return f"`[{', '.join(map(str, value))}]`"
    return f"`{value}`" if value not in ("", {}) else "empty"


def main(path: Path) -> None:
    """Rewrite the tables between the marks in a file."""
    text = path.read_text(encoding="utf-8")
    head, rest = text.split(BEGIN)
    path.write_text(head + BEGIN + key_tables() + END + rest.split(END)[1], encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
