"""YAML text to plain data in which every key remembers its file, line and column.

The compiled parser reads the text, in linear time; its events are counted before a node is built,
so that a small hostile file can fill neither the memory nor the stack. Scalars follow the YAML 1.2
core schema (``no`` is a word, ``1e-3`` a number, ``12:30`` a string), with ``_`` allowed inside
integers. Duplicate keys, merge keys and recursive aliases are refused; depth and the number of
nodes after alias expansion are bounded.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.limits import YAML_VALUES

MAX_NODES = int(YAML_VALUES.high)
MAX_DEPTH = 40
_TOO_DEEP = f"nested deeper than {MAX_DEPTH} levels"

Key = tuple[str | int, ...]


@dataclass(frozen=True)
class Mark:
    """Where a key was written. Line and column count from 1; line 0 stands for a command-line
    override.
    """

    file: str
    line: int
    column: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}" if self.line else self.file


@dataclass(frozen=True)
class Document:
    """Plain data (dict, list, str, int, float, bool, None) with the position of every key path."""

    data: Any
    marks: Mapping[Key, Mark]
    path: str
    sources: tuple[
        tuple[str, str], ...
    ] = ()  # (path, sha256) of every file that was merged, in order
    overrides: tuple[str, ...] = ()

    def mark(self, loc: Sequence[str | int]) -> Mark:
        """Return the position of the deepest existing key on the way to ``loc``."""
        for n in range(len(loc), -1, -1):
            found = self.marks.get(tuple(loc[:n]))
            if found is not None:
                return found
        return Mark(self.path, 1, 1)

    def error(self, loc: Sequence[str | int], found: str, do_this: str) -> InputError:
        """Return an error at a key path."""
        return InputError(f"{self.mark(loc)}: {found}", do_this)

    def folder_of(self, loc: Sequence[str | int]) -> Path:
        """Return the folder against which a relative path written at ``loc`` is resolved."""
        mark = self.mark(loc)
        return Path(mark.file).resolve().parent if mark.line else Path.cwd()


class _CoreLoader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]  # a base chosen at run time
    """Safe loader with YAML 1.2 core scalars; compiled where PyYAML comes with it, as its wheels
    do.
    """


_CoreLoader.yaml_implicit_resolvers = {}
for _tag, _pattern, _first in (
    ("bool", r"^(?:true|True|TRUE|false|False|FALSE)$", "tTfF"),
    ("null", r"^(?:~|null|Null|NULL|)$", ["~", "n", "N", ""]),
    ("int", r"^(?:[-+]?[0-9][0-9_]*|0o[0-7]+|0x[0-9a-fA-F]+)$", "-+0123456789"),
    (
        "float",
        r"^(?:[-+]?(?:\.[0-9]+|[0-9][0-9_]*(?:\.[0-9_]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$",
        "-+0123456789.",
    ),
):
    _CoreLoader.add_implicit_resolver(
        f"tag:yaml.org,2002:{_tag}", re.compile(_pattern), list(_first)
    )


def parse(text: str, file: str, *, override: bool = False) -> tuple[Any, dict[Key, Mark]]:
    """Return plain data and the position of every key path.

    Args:
        text: YAML.
        file: Name for positions and messages.
        override: The text is a command-line value: positions inside it mean nothing.

    Raises:
        InputError: Not valid YAML, or outside the bounds.
    """
    try:
        _check_events(text, file)
        loader = _CoreLoader(text)
        node = loader.get_single_node()
        builder = _Builder(file)
        data = builder.build(node, (), 0) if node is not None else None
    except yaml.MarkedYAMLError as e:
        mark = e.problem_mark or e.context_mark
        at = file if mark is None or override else f"{file}:{mark.line + 1}:{mark.column + 1}"
        if "nesting depth" in str(
            e.problem
        ):  # libyaml 0.2.6 looks ahead of the events counted here and has a bound of its own
            raise InputError(f"{at}: {_TOO_DEEP}", "flatten the file") from e
        found = " ".join(str(part) for part in (e.context, e.problem) if part)
        raise InputError(
            f"{at}: not valid YAML: {found}",
            "correct the syntax (indentation, colon, quote or bracket)",
        ) from e
    except yaml.reader.ReaderError as e:
        line = text.count("\n", 0, e.position) + 1
        at = (
            file if override else f"{file}:{line}:{e.position - text.rfind(chr(10), 0, e.position)}"
        )
        raise InputError(
            f"{at}: not valid YAML: the control character {e.character!r}",
            "save the file as plain UTF-8 text",
        ) from e
    return data, builder.marks


def _check_events(text: str, file: str) -> None:
    """Refuse too many or too deeply nested values before nodes are built, which takes stack and
    memory.
    """
    values = depth = 0
    for event in yaml.parse(text, Loader=_CoreLoader):
        if isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
            continue
        values += isinstance(event, yaml.NodeEvent)
        depth += isinstance(event, yaml.CollectionStartEvent)
        if depth > MAX_DEPTH + 1 or values > 2 * MAX_NODES:  # keys are events too
            found = _TOO_DEEP if depth > MAX_DEPTH + 1 else f"more than {MAX_NODES} values"
            mark = event.start_mark
            at = f"{file}:{mark.line + 1}:{mark.column + 1}" if mark is not None else file
            raise InputError(
                f"{at}: {found}",
                "flatten the file"
                if depth > MAX_DEPTH + 1
                else "split the file or use a data file",
            )


class _Builder:
    """Turns a node tree into plain data and positions, within bounds."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.marks: dict[Key, Mark] = {}
        self.n_nodes = 0
        self.open: set[int] = set()

    def fail(self, node: yaml.Node, found: str, do_this: str) -> InputError:
        return InputError(f"{self.position(node)}: {found}", do_this)

    def position(self, node: yaml.Node) -> Mark:
        return Mark(self.file, node.start_mark.line + 1, node.start_mark.column + 1)

    def build(self, node: yaml.Node, loc: Key, depth: int) -> Any:
        self.n_nodes += 1
        if self.n_nodes > MAX_NODES:
            raise self.fail(
                node,
                f"more than {MAX_NODES} values once aliases are expanded",
                "remove nested aliases",
            )
        if depth > MAX_DEPTH:
            raise self.fail(node, _TOO_DEEP, "flatten the file")
        if id(node) in self.open:
            raise self.fail(node, "an alias that contains itself", "remove the recursive alias")
        self.marks.setdefault(loc, self.position(node))
        if isinstance(node, yaml.ScalarNode):
            return self.scalar(node)
        if not node.tag.endswith((":seq", ":map")):
            raise self.fail(node, f"the tag {node.tag!r}", "use plain YAML values without tags")
        self.open.add(id(node))
        if isinstance(node, yaml.SequenceNode):
            out: Any = [
                self.build(child, (*loc, i), depth + 1) for i, child in enumerate(node.value)
            ]
        else:
            out = self.mapping(node, loc, depth)
        self.open.discard(id(node))
        return out

    def mapping(self, node: yaml.Node, loc: Key, depth: int) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for key_node, value_node in node.value:
            key = self.scalar(key_node) if isinstance(key_node, yaml.ScalarNode) else None
            if key == "<<":
                raise self.fail(
                    key_node, "the merge key '<<'", "use extends: or write the keys out"
                )
            if isinstance(key, bool) or not isinstance(key, str | int):
                raise self.fail(key_node, "a key that is not text", "write keys as plain words")
            name = str(key)
            if name in out:
                first = self.marks[(*loc, name)]
                raise self.fail(
                    key_node,
                    f"duplicate key {name!r}, first at line {first.line}",
                    "keep one of the two",
                )
            self.marks[(*loc, name)] = self.position(key_node)
            out[name] = self.build(value_node, (*loc, name), depth + 1)
        return out

    def scalar(self, node: yaml.ScalarNode) -> Any:
        kind = node.tag.rsplit(":", 1)[-1]
        if not node.tag.startswith("tag:yaml.org,2002:") or kind not in (
            "str",
            "int",
            "float",
            "bool",
            "null",
        ):
            raise self.fail(node, f"the tag {node.tag!r}", "use plain YAML values without tags")
        if kind == "str":
            return str(node.value)
        if kind == "null":
            return None
        try:
            if kind == "bool":
                return str(node.value).lower() == "true"
            if kind == "int":
                text = str(node.value)
                return int(text, 0) if text.startswith(("0x", "0o")) else int(text)
            return _float(str(node.value))
        except ValueError as e:
            raise self.fail(node, f"{node.value!r} is not a number", "correct the number") from e


def _float(text: str) -> float:
    word = text.replace("_", "").lower()
    return float(word.replace(".inf", "inf").replace(".nan", "nan"))
