"""The size of the project by room: ``python -m tests.budget [--against REV] [--json]``.

Syntax nodes and statements count what a reader has to hold; lines do not, since they depend on the
format. The numbers are printed and nothing is judged by them.
"""

import argparse
import ast
import json
import re
import statistics
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

REPO = Path(__file__).resolve().parents[1]
PACKAGES = ("alpasim_plugin", "evaluators", "policies", "scenarios", "configs", "simrun", "tests")
LABORATORY = "alpasim_plugin/lab"
TESTS = "tests"


@dataclass
class Size:
    """What a room holds. Syntax nodes leave out load and store contexts, which no reader sees."""

    modules: int = 0
    lines: int = 0
    nodes: int = 0
    statements: int = 0
    function_lines: list[int] = field(default_factory=list)
    private_functions: set[str] = field(default_factory=set)
    names: Counter[str] = field(default_factory=Counter)

    def add(self, text: str) -> None:
        """Count a module."""
        tree = ast.walk(ast.parse(text))
        nodes = [node for node in tree if not isinstance(node, ast.expr_context)]
        self.modules += 1
        self.lines += len(text.splitlines())
        self.nodes += len(nodes)
        self.statements += sum(isinstance(node, ast.stmt) for node in nodes)
        for node in nodes:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                self.function_lines.append((node.end_lineno or node.lineno) - node.lineno + 1)
                if re.match(r"_[a-z]", node.name):
                    self.private_functions.add(node.name)
            elif isinstance(node, ast.Name):
                self.names[node.id] += 1
            elif isinstance(node, ast.Attribute):
                self.names[node.attr] += 1

    def row(self) -> dict[str, float]:
        """Return the numbers of the table."""
        return {
            "modules": self.modules,
            "lines": self.lines,
            "nodes": self.nodes,
            "statements": self.statements,
            "nodes_per_statement": round(self.nodes / max(self.statements, 1), 1),
            "median_function": statistics.median(self.function_lines or [0]),
            "private_functions_used_once": sum(
                self.names[name] == 1 for name in self.private_functions
            ),
        }


def room_of(path: str) -> str:
    """Return the room of a module: the folder below alpasim_plugin, or the package."""
    parts = path.split("/")
    return "/".join(parts[:2]) if parts[0] == "alpasim_plugin" and len(parts) > 2 else parts[0]


def sources(rev: str | None) -> Iterator[tuple[str, str]]:
    """Yield path and text of every module: of the working tree, or of a commit."""
    if rev is None:
        for package in PACKAGES:
            for path in sorted((REPO / package).rglob("*.py")):
                yield path.relative_to(REPO).as_posix(), path.read_text()
        return
    for name in git("ls-tree", "-r", "--name-only", rev, "--", *PACKAGES).splitlines():
        if name.endswith(".py"):
            yield name, git("show", f"{rev}:{name}")


def git(*arguments: str) -> str:
    """Return what a git command prints."""
    done = subprocess.run(["git", *arguments], cwd=REPO, check=True, capture_output=True, text=True)
    return done.stdout


def sizes(rev: str | None = None) -> dict[str, Size]:
    """Return the size of each room and of ``core``: everything but the laboratory and the tests."""
    rooms: dict[str, Size] = defaultdict(Size)
    for path, text in sources(rev):
        if path.endswith("_pb2.py"):
            continue
        room = room_of(path)
        rooms[room].add(text)
        if room not in (LABORATORY, TESTS):
            rooms["core"].add(text)
    return dict(rooms)


def command_line_of_the_core() -> tuple[int, int]:
    """Return how many verbs and options the core's command line has."""
    from tests.cli.verb_options import CORE, options_of

    verbs = {path[0] for path in CORE}
    return len(verbs), sum(len(options_of(command)) for command in CORE.values())


def summary(rooms: dict[str, Size]) -> dict[str, int]:
    """Return the numbers of the whole project."""
    verbs, options = command_line_of_the_core()
    laboratory = rooms.get(LABORATORY, Size())
    return {
        "core_nodes": rooms["core"].nodes,
        "core_statements": rooms["core"].statements,
        "laboratory_nodes": laboratory.nodes,
        "tests_nodes": rooms[TESTS].nodes,
        "verbs": verbs,
        "options": options,
    }


def main() -> None:
    """Print the table, and the change against a commit."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--against", help="Commit to compare with.")
    parser.add_argument("--json", action="store_true", help="Print one JSON document.")
    arguments = parser.parse_args()
    rooms = sizes()
    rows = {room: size.row() for room, size in sorted(rooms.items())}
    before = {}
    if arguments.against:
        before = {room: size.row() for room, size in sizes(arguments.against).items()}
    now = summary(rooms)
    if arguments.json:
        json.dump({"rooms": rows, "before": before, "summary": now}, sys.stdout, indent=1)
        return
    print(
        f"{'room':28}{'modules':>9}{'lines':>8}{'nodes':>9}{'statements':>12}{'/stmt':>7}"
        f"{'median':>8}{'used once':>11}"
        + (f"  nodes against {arguments.against}" if before else "")
    )
    for room, row in rows.items():
        print(
            f"{room:28}{row['modules']:9.0f}{row['lines']:8.0f}{row['nodes']:9.0f}"
            f"{row['statements']:12.0f}{row['nodes_per_statement']:7.1f}"
            f"{row['median_function']:8.0f}{row['private_functions_used_once']:11.0f}"
            + (f"{row['nodes'] - before.get(room, {'nodes': 0})['nodes']:+16.0f}" if before else "")
        )
    print(f"command line of the core: {now['verbs']} verbs, {now['options']} options")


if __name__ == "__main__":
    main()
