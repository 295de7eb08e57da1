"""The size of the project by room, and how a change moves it: ``python -m tests.budget [--against REV] [--json]``.

Lines and syntax nodes count what a reader has to hold; modules and the share of import lines count the journeys between. The numbers stand
in docs/architecture.md, whose first row is the project before it had rooms.
"""

from __future__ import annotations

import argparse
import ast
import json
import statistics
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

REPO = Path(__file__).resolve().parents[1]
PACKAGES = ("alpasim_plugin", "evaluators", "policies", "scenarios")
PLUG_INS = ("alpasim_plugin/block_fixers", "alpasim_plugin/lab")


@dataclass
class Size:
    """What a room holds. Syntax nodes leave out load and store contexts, which no reader sees."""

    modules: int = 0
    lines: int = 0
    imports: int = 0
    nodes: int = 0
    statements: int = 0
    functions: list[int] = field(default_factory=list)  # lines of each

    def add(self, text: str) -> None:
        """Count a module."""
        nodes = [node for node in ast.walk(ast.parse(text)) if not isinstance(node, ast.expr_context)]
        self.modules += 1
        self.lines += len(text.splitlines())
        self.imports += sum(isinstance(node, ast.Import | ast.ImportFrom) for node in nodes)
        self.nodes += len(nodes)
        self.statements += sum(isinstance(node, ast.stmt) for node in nodes)
        for node in nodes:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                self.functions.append((node.end_lineno or node.lineno) - node.lineno + 1)

    def row(self) -> dict[str, float]:
        """Return the numbers of the table."""
        return {
            "modules": self.modules,
            "lines": self.lines,
            "nodes": self.nodes,
            "nodes_per_statement": round(self.nodes / max(self.statements, 1), 1),
            "import_share": round(self.imports / max(self.lines, 1), 3),
            "median_function": statistics.median(self.functions) if self.functions else 0,
        }


def room_of(path: str) -> str:
    """Return the room of a module: the folder below the package, or the package."""
    parts = path.split("/")
    return "/".join(parts[:2]) if parts[0] == "alpasim_plugin" and len(parts) > 2 else parts[0]


def sources(rev: str | None) -> Iterator[tuple[str, str]]:
    """Yield path and text of every module: of the working tree, or of a commit."""
    if rev is None:
        for package in PACKAGES:
            for path in sorted((REPO / package).rglob("*.py")):
                yield path.relative_to(REPO).as_posix(), path.read_text()
        return
    listed = git("ls-tree", "-r", "--name-only", rev, "--", *PACKAGES)
    for name in listed.splitlines():
        if name.endswith(".py"):
            yield name, git("show", f"{rev}:{name}")


def git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=REPO, check=True, capture_output=True, text=True).stdout


def sizes(rev: str | None = None) -> dict[str, Size]:
    """Return the size of each room, and the sums ``core`` (without the plug-in rooms) and ``all``."""
    found: dict[str, Size] = defaultdict(Size)
    for path, text in sources(rev):
        if path.endswith("_pb2.py"):
            continue
        room = room_of(path)
        for name in (room, "all", *(() if room in PLUG_INS else ("core",))):
            found[name].add(text)
    return dict(found)


def options_of_the_core() -> tuple[int, int]:
    """Return how many verbs and options the core's command line has."""
    from tests.cli.test_verbs import CORE, options_of

    return len(CORE), sum(len(options_of(command)) for command in CORE.values())


def main() -> None:
    """Print the table, and the change against a commit."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--against", help="Commit to compare with.")
    parser.add_argument("--json", action="store_true", help="Print one JSON document.")
    given = parser.parse_args()
    now = {room: size.row() for room, size in sorted(sizes().items())}
    before = {room: size.row() for room, size in sizes(given.against).items()} if given.against else {}
    verbs, options = options_of_the_core()
    if given.json:
        json.dump({"rooms": now, "before": before, "verbs": verbs, "options": options}, sys.stdout, indent=1)
        return
    last = f"  lines against {given.against}" if before else ""
    print(f"{'room':28}{'modules':>9}{'lines':>8}{'nodes':>9}{'/stmt':>7}{'imports':>9}{'median':>8}{last}")
    for room, row in now.items():
        change = f"{row['lines'] - before.get(room, {'lines': 0})['lines']:+16.0f}" if before else ""
        print(
            f"{room:28}{row['modules']:9.0f}{row['lines']:8.0f}{row['nodes']:9.0f}{row['nodes_per_statement']:7.1f}"
            f"{row['import_share']:9.1%}{row['median_function']:8.0f}{change}"
        )
    print(f"core command line: {verbs} verbs, {options} options")


if __name__ == "__main__":
    main()
