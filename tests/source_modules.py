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
