"""Data flows one way (docs/architecture.md): a stage imports what comes before it, never what comes after."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from functools import cache
from pathlib import Path

REPO = Path(__file__).resolve().parents[1]

# Stage -> what it may import besides itself and the shared modules directly in alpasim_plugin.
# Third-party imports are free, except torch in evaluators.
MAY_IMPORT: dict[str, set[str]] = {
    "alpasim_plugin.world": set(),
    "alpasim_plugin.gaussians": set(),
    "scenarios": {"alpasim_plugin.world"},
    "alpasim_plugin.renderers": {"alpasim_plugin.gaussians", "alpasim_plugin.world"},
    "alpasim_plugin.nets": set(),
    "alpasim_plugin.semantic_map": {"alpasim_plugin.gaussians"},
    "alpasim_plugin.fixers": {"alpasim_plugin.gaussians", "alpasim_plugin.nets", "alpasim_plugin.semantic_map", "alpasim_plugin.world"},
    "alpasim_plugin.lab.training": {
        "alpasim_plugin.fixers",
        "alpasim_plugin.gaussians",
        "alpasim_plugin.log",
        "alpasim_plugin.nets",
        "alpasim_plugin.renderers",
        "alpasim_plugin.semantic_map",
        "alpasim_plugin.world",
        "policies",
        "scenarios",
    },
    "alpasim_plugin.control": set(),
    "policies": set(),
    "alpasim_plugin.alpasim": set(),
    "alpasim_plugin.alpasim.client": {
        "alpasim_plugin.alpasim",
        "alpasim_plugin.control",  # a remote vehicle checks plans as every controller does
        "alpasim_plugin.log",
        "alpasim_plugin.world",  # road users behind a service stand in for the scenario's
    },
    "alpasim_plugin.alpasim.server": {
        "alpasim_plugin.alpasim",
        "alpasim_plugin.fixers",
        "alpasim_plugin.log",
        "alpasim_plugin.runtime",
        "alpasim_plugin.semantic_map",
        "scenarios",
    },
    "alpasim_plugin.log": {"alpasim_plugin.alpasim"},
    "evaluators": set(),
    "alpasim_plugin.viewer": {"alpasim_plugin.log", "evaluators"},
    "alpasim_plugin.recordings": {"alpasim_plugin.log", "alpasim_plugin.viewer", "evaluators"},
    "alpasim_plugin.runtime": {
        "alpasim_plugin.alpasim",  # the messages of logs that it exports
        "alpasim_plugin.alpasim.client",  # road users behind a service
        "alpasim_plugin.fixers",
        "alpasim_plugin.world",
        "alpasim_plugin.renderers",
        "alpasim_plugin.control",
        "alpasim_plugin.log",
        "alpasim_plugin.viewer",
        "evaluators",
        "policies",
        "scenarios",
    },
}
# What stands outside the stages: it may import everything, and nothing imports it.
OUTSIDE = ("alpasim_plugin.cli", "alpasim_plugin.lab.bench", "alpasim_plugin.gym", "alpasim_plugin.notebook")
PACKAGES = ("alpasim_plugin", "evaluators", "policies", "scenarios", "configs")


@dataclass(frozen=True)
class Module:
    """One source file, read and parsed once for all rules."""

    path: Path
    name: str
    lines: int
    nodes: tuple[ast.AST, ...]
    top: tuple[ast.stmt, ...]


def name_of(path: Path) -> str:
    parts = list(path.relative_to(REPO).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def modules() -> tuple[Module, ...]:
    found = []
    for path in (p for package in PACKAGES for p in sorted((REPO / package).rglob("*.py")) if not p.name.endswith("_pb2.py")):
        text = path.read_text()
        tree = ast.parse(text)
        found.append(Module(path, name_of(path), len(text.splitlines()), tuple(ast.walk(tree)), tuple(tree.body)))
    return tuple(found)


def stage_of(module: str) -> str | None:
    """Return the longest stage name that a module lies in; None for the shared modules and the package face."""
    inside = [stage for stage in MAY_IMPORT if module == stage or module.startswith(stage + ".")]
    return max(inside, key=len) if inside else None


def imported(nodes: tuple[ast.AST, ...]) -> set[str]:
    found: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def imports_against_the_stream(module: Module) -> list[str]:
    """Return a line for every import of this module that its stage may not make."""
    if module.name.startswith(OUTSIDE) or module.name == "alpasim_plugin":
        return []
    stage = stage_of(module.name)
    wrong = []
    for name in sorted(n for n in imported(module.nodes) if n.split(".")[0] in PACKAGES):
        target = stage_of(name)
        if name.startswith(OUTSIDE):
            wrong.append(f"{module.name} imports what stands outside the stages: {name}")
        elif target is None or target == stage:
            continue
        elif stage is None:
            wrong.append(f"shared module {module.name} imports stage {target}")
        elif target not in MAY_IMPORT[stage]:
            wrong.append(f"{module.name} ({stage}) imports {name} ({target})")
    return wrong


def test_the_rules_see_the_packages() -> None:
    seen = {module.name for module in modules()}
    assert {"alpasim_plugin", "alpasim_plugin.runtime.rollout", "evaluators", "policies.base", "scenarios", "configs"} <= seen


def test_modules_import_only_what_lies_upstream() -> None:
    assert [line for module in modules() for line in imports_against_the_stream(module)] == []


def test_evaluators_do_not_load_torch() -> None:
    own = [module for module in modules() if module.name.startswith("evaluators")]
    assert [m.name for m in own if any(name.split(".")[0] == "torch" for name in imported(m.top))] == []


def test_modules_stay_readable_in_one_sitting() -> None:
    assert {module.name: module.lines for module in modules() if module.lines > 400} == {}


def test_no_global_random_generator_is_used() -> None:
    wrong = []
    for module in modules():
        for node in module.nodes:
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Attribute) and node.value.attr == "random":
                if node.attr not in {"Generator", "Philox", "SeedSequence"}:
                    wrong.append(f"{module.path}:{node.lineno}: np.random.{node.attr}")
            elif isinstance(node, ast.Import) and any(alias.name == "random" for alias in node.names):
                wrong.append(f"{module.path}:{node.lineno}: import random")
    assert wrong == []
