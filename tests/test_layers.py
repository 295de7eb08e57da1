"""Data flows one way (docs/architecture.md): a stage imports what comes before it, never what comes after."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

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
    "alpasim_plugin.training": {
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
    "alpasim_plugin.log": {"alpasim_plugin.alpasim"},
    "evaluators": set(),
    "alpasim_plugin.runtime": {
        "alpasim_plugin.fixers",
        "alpasim_plugin.world",
        "alpasim_plugin.renderers",
        "alpasim_plugin.control",
        "alpasim_plugin.log",
        "evaluators",
        "policies",
        "scenarios",
    },
}
PACKAGES = ("alpasim_plugin", "evaluators", "policies", "scenarios", "configs")


def modules() -> list[Path]:
    return [p for package in PACKAGES for p in sorted((REPO / package).rglob("*.py")) if not p.name.endswith("_pb2.py")]


def name_of(path: Path) -> str:
    parts = list(path.relative_to(REPO).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def stage_of(module: str) -> str | None:
    """Return the longest stage name that a module lies in; None for the shared modules and the package face."""
    inside = [stage for stage in MAY_IMPORT if module == stage or module.startswith(stage + ".")]
    return max(inside, key=len) if inside else None


def imports_of(path: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


@pytest.mark.parametrize("path", modules(), ids=name_of)
def test_module_imports_only_what_lies_upstream(path: Path) -> None:
    module = name_of(path)
    if module.startswith(("alpasim_plugin.cli", "alpasim_plugin.bench")) or module == "alpasim_plugin":
        return  # the command line, the benches and the package's face may import everything
    stage = stage_of(module)
    for name in sorted(imports_of(path)):
        if name.split(".")[0] not in PACKAGES:
            continue
        assert not name.startswith(("alpasim_plugin.cli", "alpasim_plugin.bench")), f"{module} imports the command line or a bench"
        target = stage_of(name)
        if target is None or target == stage:
            continue
        assert stage is not None, f"shared module {module} imports stage {target}"
        assert target in MAY_IMPORT[stage], f"{module} ({stage}) imports {name} ({target})"


@pytest.mark.parametrize("path", [p for p in modules() if name_of(p).startswith("evaluators")], ids=name_of)
def test_evaluators_do_not_load_torch(path: Path) -> None:
    tree = ast.parse(path.read_text())
    top = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {a.name for n in top if isinstance(n, ast.Import) for a in n.names} | {n.module for n in top if isinstance(n, ast.ImportFrom)}
    assert not any(name and name.split(".")[0] == "torch" for name in names)


@pytest.mark.parametrize("path", modules(), ids=name_of)
def test_modules_stay_readable_in_one_sitting(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 400


@pytest.mark.parametrize("path", modules(), ids=name_of)
def test_no_global_random_generator_is_used(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Attribute) and node.value.attr == "random":
            assert node.attr in {"Generator", "Philox", "SeedSequence"}, f"{path}:{node.lineno}: np.random.{node.attr}"
        if isinstance(node, ast.Import):
            assert all(alias.name != "random" for alias in node.names), f"{path}:{node.lineno}"
