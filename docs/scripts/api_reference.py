"""Write docs/api.md, the reference of what ``import simrun`` gives, from signatures, docstrings and
the comments of fields.

    python docs/scripts/api_reference.py [--check]

With ``--check`` nothing is written, and the exit code is 1 where the page is stale.
"""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

from pages import DOCS, replaced, table, write

import simrun

# Heading -> names, in the order of the page; every public name stands once.
GROUPS = {
    "Drive and score": (
        "load_scenario",
        "make_renderer",
        "make_policy",
        "run_rollout",
        "score",
        "rollout_values",
        "reduce_rollout",
        "aggregate",
        "paired",
        "resolve_evaluators",
    ),
    "Write a policy": (
        "SensorSpec",
        "Observation",
        "EgoState",
        "Frame",
        "Route",
        "Plan",
        "plan_times",
        "check_policy",
        "serve_policy",
    ),
    "Write a renderer or a fixer": ("RenderRequest", "CameraSpec", "Trajectory", "U8"),
    "Write a metric": ("RolloutLog", "Scene", "MetricInfo", "MetricSeries", "series"),
    "Scenario and errors": ("Scenario", "SimrunError", "InputError"),
}
PLAIN = {"U8": "An array of unsigned bytes: `numpy.typing.NDArray[numpy.uint8]`."}
SECTION = re.compile(r"^(Args|Returns|Raises|Attributes|Example|Source|Yields):$", re.MULTILINE)


def page() -> str:
    """Return the content of the page's block."""
    listed = [name for names in GROUPS.values() for name in names]
    missing = {*simrun.__all__} - {"__version__"} ^ {*listed}
    assert not missing, (
        f"public names that stand in no group, or groups of unknown names: {missing}"
    )
    return "".join(
        f"## {heading}\n" + "".join(entry(name) for name in names)
        for heading, names in GROUPS.items()
    )


def entry(name: str) -> str:
    """Return the heading, signature and text of a public name."""
    value = getattr(simrun, name)
    if name in PLAIN:
        return f"### {name}\n{PLAIN[name]}\n\n"
    text = f"### {name}\n"
    if inspect.isfunction(value):
        text += f"```text\n{name}{signature(value)}\n```\n"
    text += documented(inspect.getdoc(value) or "")
    if is_dataclass(value) and inspect.isclass(value):
        fields = list(members(value))
        if fields and not re.search(r"^Attributes:$", inspect.getdoc(value) or "", re.MULTILINE):
            text += table(["member", "type", "default", "meaning"], fields) + "\n"
    return text


def signature(function: Any) -> str:
    """Return the parameters of a function as its source has them, a line each where they are many."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
    assert isinstance(tree, ast.FunctionDef)
    parameters = ast.unparse(WithValues(function).visit(tree.args))
    result = f" -> {ast.unparse(tree.returns)}" if tree.returns is not None else ""
    if len(parameters) > 60:
        parameters = "\n    " + ",\n    ".join(_parted(parameters)) + ",\n"
    return f"({parameters}){result}"


class WithValues(ast.NodeTransformer):
    """Put the value of a constant of the function's module in place of its name, where it is a
    number or a text; a reader of the page cannot look the name up.
    """

    def __init__(self, function: Any) -> None:
        self.constants = {
            name: value
            for name, value in vars(inspect.getmodule(function)).items()
            if name.isupper() and isinstance(value, str | int | float)
        }

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """Return the value of a constant, or the name as it is."""
        is_known = node.id in self.constants
        return ast.Constant(self.constants[node.id]) if is_known else node


def _parted(parameters: str) -> list[str]:
    """Return parameters one by one: commas inside of brackets part nothing."""
    parts = [""]
    depth = 0
    for letter in parameters:
        depth += (letter in "[(") - (letter in "])")
        if letter == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return [part.strip() for part in parts]


def documented(docstring: str) -> str:
    """Return a docstring as Markdown: its sections as lists."""
    parts = SECTION.split(docstring)
    text = f"{_paragraphs(parts[0])}\n\n"
    for heading, body in zip(parts[1::2], parts[2::2], strict=True):
        inner = textwrap.dedent(body.strip("\n")).rstrip()
        if heading == "Example":
            text += f"```pycon\n{inner.replace('  # doctest: +SKIP', '')}\n```\n\n"
        elif heading in ("Args", "Raises", "Attributes"):
            text += f"*{heading}*\n\n{_list(inner)}\n\n"
        else:
            text += f"*{heading}*: {_paragraphs(inner)}\n\n"
    return text


def _paragraphs(text: str) -> str:
    """Return text with a line for each paragraph, and Markdown's single quotes for code."""
    paragraphs = re.split(r"\n\s*\n", text.strip())
    return "\n\n".join(" ".join(part.split()) for part in paragraphs).replace("``", "`")


def _list(text: str) -> str:
    """Return ``name: meaning`` entries as a list."""
    entries = re.split(r"\n(?=\S)", text)
    lines = []
    for part in entries:
        name, colon, meaning = _paragraphs(part).replace("\n\n", " ").partition(": ")
        lines.append(f"- `{name}`: {meaning}" if colon else f"- {name}")
    return "\n".join(lines)


def members(record: type) -> Iterator[tuple[str, str, str, str]]:
    """Yield name, type, default and meaning of each member of a dataclass; its meaning is the
    comment above it or behind it in the source.
    """
    source = inspect.getsource(record).splitlines()
    tree = ast.parse(textwrap.dedent("\n".join(source))).body[0]
    assert isinstance(tree, ast.ClassDef)
    for node in tree.body:
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        if node.target.id.startswith("_"):
            continue
        default = "" if node.value is None else _default(ast.unparse(node.value))
        kind = f"`{ast.unparse(node.annotation)}`"
        yield f"`{node.target.id}`", kind, default, _comment(source, node.lineno, node.end_lineno)


def _default(code: str) -> str:
    """Return the default of a member, as a reader needs it."""
    if code.startswith("cast("):  # brought from a device when it is first read
        return ""
    made = re.fullmatch(r"field\(default_factory=(.*)\)", code)
    if made is not None:
        return {"dict": "`{}`"}.get(made[1], "empty")
    return f"`{code}`"


def _comment(source: list[str], first: int, last: int | None) -> str:
    """Return the comment behind the lines of a statement, else the one directly above them."""
    behind = re.search(r"\s#\s(.*)$", source[(last or first) - 1])
    if behind is not None:
        return behind[1]
    above: list[str] = []
    for line in reversed(source[: first - 1]):
        if not line.strip().startswith("# "):
            break
        above.insert(0, line.strip().removeprefix("# "))
    return " ".join(above)


def written() -> dict[Path, str]:
    """Return the text of the page."""
    path = DOCS / "api.md"
    return {path: replaced(path.read_text(encoding="utf-8"), "names", page())}


if __name__ == "__main__":
    write(written())
