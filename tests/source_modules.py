"""The modules of the project as syntax trees."""

import ast
import gc
from dataclasses import dataclass
from functools import cache
from pathlib import Path

REPO = Path(__file__).resolve().parents[1]
PACKAGES = ("alpasim_plugin", "evaluators", "policies", "scenarios", "configs", "simrun")


@dataclass(frozen=True)
class Module:
    """One source file, read and parsed once for all rules."""

    path: Path
    name: str
    lines: int
    nodes: tuple[ast.AST, ...]
    top: tuple[ast.stmt, ...]


def name_of(path):
    parts = list(path.relative_to(REPO).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def modules():
    found = []
    gc.disable()  # collections while a million nodes are made take as long as making them
    for path in (
        p
        for package in PACKAGES
        for p in sorted((REPO / package).rglob("*.py"))
        if not p.name.endswith("_pb2.py")
    ):
        text = path.read_text()
        tree = ast.parse(text)
        found.append(
            Module(
                path, name_of(path), len(text.splitlines()), tuple(ast.walk(tree)), tuple(tree.body)
            )
        )
    gc.enable()
    return tuple(found)


def dotted(node):
    """Return ``a.b.c`` of nested attributes; empty where the innermost is no name."""
    if isinstance(node, ast.Attribute):
        inner = dotted(node.value)
        return f"{inner}.{node.attr}" if inner else ""
    return node.id if isinstance(node, ast.Name) else ""


def foreign_names(module):
    """Return the names that a module imports from other distributions: name -> what it stands
    for.
    """
    found: dict[str, str] = {}
    for node in module.nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                first = alias.name.split(".")[0]
                found[alias.asname or first] = alias.name if alias.asname else first
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            for alias in node.names:
                found[alias.asname or alias.name] = f"{node.module}.{alias.name}"
    return {name: what for name, what in found.items() if what.split(".")[0] not in PACKAGES}
