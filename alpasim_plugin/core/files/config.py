"""Configuration files: YAML in which every key keeps its file, line and column, ``extends``, dotted
overrides, and validation by pydantic.

libyaml reads the text in linear time and limits its nesting. Scalars follow the YAML 1.2 core
schema (``no`` is a word, ``1e-3`` a number, ``12:30`` a string), with ``_`` allowed inside
integers. Duplicate keys, merge keys, tags, recursive aliases and numbers that are not finite are
refused.
"""

import copy
import difflib
import json
import math
import os
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.escape import shorten
from alpasim_plugin.core.files import read_text, real
from alpasim_plugin.core.files.limits import YAML_BYTES, YAML_VALUES
from alpasim_plugin.core.files.reading import wanted_of
from alpasim_plugin.core.json_types import JsonObject

MOST_FILES = 64  # of one document, through extends
MOST_LEVELS = 40
MOST_PROBLEMS = 200  # of one file that are put in order
SHOWN_PROBLEMS = 4
SHOWN = 80  # characters of a value in a message
TAG = "tag:yaml.org,2002:"

Key = tuple[str | int, ...]
M = TypeVar("M", bound=BaseModel)


@dataclass(frozen=True, order=True)
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

    def mark(self, loc: Sequence[str | int]) -> Mark:
        """Return the position of the deepest existing key on the way to ``loc``."""
        for n in range(len(loc), -1, -1):
            if tuple(loc[:n]) in self.marks:
                return self.marks[tuple(loc[:n])]
        return Mark(self.path, 1, 1)

    def error(self, loc: Sequence[str | int], message: str, hint: str) -> InputError:
        """Return an error at a key path."""
        return InputError(f"{self.mark(loc)}: {message}", hint)

    def folder_of(self, loc: Sequence[str | int]) -> Path:
        """Return the folder against which a relative path written at ``loc`` is resolved."""
        mark = self.mark(loc)
        return real(Path(mark.file)).parent if mark.line else Path.cwd()


class CoreLoader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]  # a base chosen at run time
    """Safe loader with YAML 1.2 core scalars; compiled where PyYAML comes with libyaml."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012  # not those of YAML 1.1


for _kind, _pattern, _first in (
    ("bool", r"^(?:true|True|TRUE|false|False|FALSE)$", "tTfF"),
    ("null", r"^(?:~|null|Null|NULL|)$", ["~", "n", "N", ""]),
    ("int", r"^(?:[-+]?[0-9][0-9_]*|0o[0-7]+|0x[0-9a-fA-F]+)$", "-+0123456789"),
    (
        "float",
        r"^(?:[-+]?(?:\.[0-9]+|[0-9][0-9_]*(?:\.[0-9_]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$",
        "-+0123456789.",
    ),
):
    CoreLoader.add_implicit_resolver(f"{TAG}{_kind}", re.compile(_pattern), list(_first))


def load_yaml(path: str | Path) -> Document:
    """Read a YAML file and everything that its ``extends:`` list names.

    ``extends`` (a list of paths relative to the file, or one path) is merged first to last, then
    the file itself on top: mappings key by key, everything else replaced as a whole.

    Raises:
        InputError: Missing or unreadable file, YAML syntax (with line and column), duplicate or
            non-text key, a bound exceeded, or a cycle of ``extends``.
    """
    return _load(Path(path), [])


def _load(path: Path, read: list[Path]) -> Document:
    """Read a file and its bases; ``read`` collects every reading, since files that name each other
    twice double at each step.
    """
    read.append(real(path))
    if len(read) > MOST_FILES:
        raise InputError(
            f"{path}: more than {MOST_FILES} files through extends, {len(set(read))} different ones",
            "name each base once, and no file that extends itself",
        )
    document = parse(read_text(path, YAML_BYTES), str(path))
    if not isinstance(document.data, dict) or "extends" not in document.data:
        return document
    names = document.data.pop("extends")
    names = [names] if isinstance(names, str) else names
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise document.error(
            ("extends",), f"extends: {names!r}", "give a list of paths, relative to this file"
        )
    merged: Any = {}
    marks: dict[Key, Mark] = {}
    for name in names:
        base_path = real(path).parent / name
        if not os.path.isfile(base_path):
            raise document.error(
                ("extends",),
                f"extends {name!r}, but {base_path} does not exist",
                "correct the path",
            )
        base = _load(base_path, read)
        merged = _merge(merged, base.data)
        marks.update(base.marks)
    return Document(_merge(merged, document.data), {**marks, **document.marks}, str(path))


def _merge(a: Any, b: Any) -> Any:
    """Merge b over a: mappings key by key, all else replaced."""
    if not (isinstance(a, dict) and isinstance(b, dict)):
        return b
    return a | {key: _merge(a[key], value) if key in a else value for key, value in b.items()}


def parse(text: str, file: str) -> Document:
    """Parse YAML text; ``file`` is its name for positions and messages.

    Raises:
        InputError: Not valid YAML, or outside the bounds.
    """
    try:
        node = yaml.compose(text, Loader=CoreLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = file if mark is None else f"{file}:{mark.line + 1}:{mark.column + 1}"
        if "nesting depth" in str(error.problem):
            raise _too_deep(place) from error
        problem = " ".join(part for part in (error.context, error.problem) if part)
        hint = "correct the syntax (indentation, colon, quote or bracket)"
        if mark is not None and "\t" in "".join(text.splitlines()[mark.line : mark.line + 1]):
            hint = "indent with spaces: the line has a tab"
        raise InputError(f"{place}: not valid YAML: {problem}", hint) from error
    except RecursionError as error:  # of the loader that is not compiled
        raise _too_deep(file) from error
    except yaml.YAMLError as error:
        raise InputError(
            f"{file}: not valid YAML: {error}", "save the file as plain UTF-8 text"
        ) from error
    builder = _Builder(file)
    data = None if node is None else builder.build(node, (), ())
    return Document(data, builder.marks, file)


def _too_deep(place: object) -> InputError:
    return InputError(f"{place}: nested deeper than {MOST_LEVELS} levels", "flatten the file")


class _Builder:
    """Turns a node tree into plain data and positions, within bounds."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.marks: dict[Key, Mark] = {}
        self.n_values = 0

    def position(self, node: yaml.Node) -> Mark:
        return Mark(self.file, node.start_mark.line + 1, node.start_mark.column + 1)

    def error(self, node: yaml.Node, message: str, hint: str) -> InputError:
        return InputError(f"{self.position(node)}: {message}", hint)

    def build(self, node: yaml.Node, loc: Key, parents: tuple[yaml.Node, ...]) -> Any:
        """Return the data of a node at a path, below the nodes that hold it."""
        self.n_values += 1
        if not YAML_VALUES.holds(self.n_values):
            raise self.error(
                node,
                f"more than {YAML_VALUES.high:.0f} values once aliases are expanded",
                "remove nested aliases, split the file, or use a data file",
            )
        if node in parents:
            raise self.error(node, "an alias that contains itself", "remove the recursive alias")
        if len(parents) > MOST_LEVELS:
            raise _too_deep(self.position(node))
        self.marks.setdefault(loc, self.position(node))
        below = (*parents, node)
        if node.tag == f"{TAG}seq":
            return [self.build(child, (*loc, i), below) for i, child in enumerate(node.value)]
        if node.tag != f"{TAG}map":
            return self.scalar(node)
        data: dict[str, Any] = {}
        for key_node, value_node in node.value:
            name = self.key(key_node)
            if name in data:
                raise self.error(
                    key_node,
                    f"duplicate key {name!r}, first at line {self.marks[(*loc, name)].line}",
                    "keep one of the two",
                )
            self.marks[(*loc, name)] = self.position(key_node)
            data[name] = self.build(value_node, (*loc, name), below)
        return data

    def key(self, node: yaml.Node) -> str:
        if node.value == "<<":
            raise self.error(node, "the merge key '<<'", "use extends: or write the keys out")
        if node.tag not in (f"{TAG}str", f"{TAG}int"):
            raise self.error(node, "a key that is not text", "write keys as plain words")
        return str(self.scalar(node))

    def scalar(self, node: yaml.Node) -> Any:
        text = str(node.value)
        try:
            match node.tag.removeprefix(TAG):
                case "str":
                    return text
                case "null":
                    return None
                case "bool":
                    return text.lower() == "true"
                case "int":
                    return int(text, 0) if text.startswith(("0x", "0o")) else int(text)
                case "float":
                    number = float(
                        text.replace("_", "").lower().replace(".inf", "inf").replace(".nan", "nan")
                    )
                    if math.isfinite(number):
                        return number
        except ValueError as error:
            number_text = repr(shorten(text, SHOWN))
            raise self.error(
                node, f"{number_text} is not a number", "correct the number"
            ) from error
        if node.tag == f"{TAG}float":
            raise self.error(node, f"the number {text}", "give a finite number")
        raise self.error(node, f"the tag {node.tag!r}", "use plain YAML values without tags")


def apply_overrides(
    document: Document, overrides: Sequence[str], origin: str = "--set"
) -> Document:
    """Set dotted keys: ``road.lane_width_m=3.2``, ``actors.lead.speed_mps=8`` (list items by index
    or by their ``id``).

    Raises:
        InputError: An override without ``=`` or whose value is not valid YAML, a path through a
            scalar, or a list item that does not exist.
    """
    data = copy.deepcopy(document.data)
    marks = dict(document.marks)
    for text in overrides:
        location = f"{origin} {text}"
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise InputError(
                f"{location}: no KEY=VALUE", "write for example --set road.lane_width_m=3.2"
            )
        loc = _assign(data, key.strip().split("."), value_of(value, location), location)
        marks = _marked(marks, loc, location)
    return Document(data, marks, document.path)


def apply_values(document: Document, located: Sequence[tuple[Key, Any]]) -> Document:
    """Set values at key paths, as `override_locations` gives them."""
    data = copy.deepcopy(document.data)
    marks = dict(document.marks)
    for loc, value in located:
        location = f"--set {dotted(loc)}={json.dumps(value)}"
        marks = _marked(marks, _assign(data, loc, copy.deepcopy(value), location), location)
    return Document(data, marks, document.path)


def _marked(marks: Mapping[Key, Mark], loc: Key, location: str) -> dict[Key, Mark]:
    """Return marks in which a key, and those above it that have none, are where a value was set."""
    changed = {other: mark for other, mark in marks.items() if other[: len(loc)] != loc}
    for n in range(1, len(loc)):
        changed.setdefault(loc[:n], Mark(location, 0, 0))
    changed[loc] = Mark(location, 0, 0)
    return changed


def value_of(text: str, location: str) -> Any:
    """Return the plain data of a value on the command line: YAML, in which ``#`` begins no comment.

    Raises:
        InputError: It is not valid YAML.
    """
    if re.search(r"(^|\s)#", text) and not re.search(r"[\"'\[\]{}\n]", text):
        return text.strip()
    return parse(text, location).data


def override_locations(document: Document, overrides: Sequence[str]) -> list[tuple[Key, Any]]:
    """Return the key path and the value of each override, however it names its key: list items go
    by their index.

    Raises:
        InputError: As `apply_overrides`.
    """
    data = copy.deepcopy(document.data)
    assignments = []
    for text in overrides:
        location = f"--set {text}"
        key, _, value = text.partition("=")
        plain = value_of(value, location)
        assignments.append((_assign(data, key.strip().split("."), plain, location), plain))
    return assignments


def _assign(data: Any, keys: Sequence[str | int], value: Any, location: str) -> Key:
    """Set a key in place; return its path. Of a list, text names an item by its id, or by its index
    where no item has that id, and a number is the index.
    """
    loc: Key = ()
    node = data
    for n, key in enumerate(keys, 1):
        step: Any = key
        if isinstance(node, list) and not isinstance(key, int):
            ids = [item.get("id") if isinstance(item, dict) else None for item in node]
            if key in ids:
                step = ids.index(key)
            elif re.fullmatch("[0-9]{1,9}", key) and int(key) < len(node):
                step = int(key)
            else:
                choices = ", ".join(str(name) for name in ids if name) or f"0..{len(node) - 1}"
                raise InputError(f"{location}: no list item {key!r}", f"use one of: {choices}")
        elif not isinstance(node, dict | list):
            raise InputError(
                f"{location}: {dotted(loc)} holds a value, not keys", "shorten the path"
            )
        elif isinstance(node, dict) and n < len(keys):
            node.setdefault(key, {})
        loc = (*loc, step)
        if n < len(keys):
            node = node[step]
    node[step] = value
    return loc


def dotted(loc: Sequence[str | int]) -> str:
    """Write a key path as ``actors[0].speed_mps``."""
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in loc)
    return text.removeprefix(".") or "the file"


def validate(model: type[M], document: Document) -> M:
    """Validate a document strictly (no text for a number, no unknown key).

    Raises:
        InputError: The first problem in file order, with its position and a hint; the others are
            listed after it.
    """
    try:
        # JSON mode is strict about types and still lets a list fill a tuple.
        return model.model_validate_json(json.dumps(document.data), strict=True)
    except ValidationError as error:
        problems = error.errors(include_url=False)
    # Wrong items make a list too short, and a misspelt key leaves the right one missing.
    problems = [problem for problem in problems if problem["type"] != "too_short"] or problems
    placed: list[tuple[bool, Mark, int, Key, Any]] = []
    for problem in problems[:MOST_PROBLEMS]:
        # The tag of a union of forms is in brackets and leads to no model.
        problem["loc"] = tuple(part for part in problem["loc"] if not str(part).startswith("("))
        # Without the parts of pydantic's location that are union tags or missing keys.
        data = document.data
        loc: Key = ()
        for part in problem["loc"]:
            is_key = isinstance(data, dict) and part in data
            if is_key or (isinstance(data, list) and isinstance(part, int) and part < len(data)):
                data = data[part]
                loc = (*loc, part)
        is_missing = problem["type"] == "missing"
        placed.append((is_missing, document.mark(loc), len(placed), loc, problem))
    placed.sort(key=lambda place: place[:3])
    explanations = [
        (mark, *_explain(model, problem, loc))
        for _, mark, _, loc, problem in placed[:SHOWN_PROBLEMS]
    ]
    mark, message, hint = explanations[0]
    if len(problems) > 1:
        further_text = "; ".join(f"{mark}: {message}" for mark, message, _ in explanations[1:])
        message = f"{shorten(message, 180)} (and {len(problems) - 1} more: {further_text})"
    raise InputError(f"{mark}: {message}", hint)


def _explain(model: type[BaseModel], problem: Any, loc: Key) -> tuple[str, str]:
    """Return message and hint of a problem at a path of the document."""
    kind = problem["type"]
    context = problem.get("ctx", {})
    name = dotted(loc)
    last = str(problem["loc"][-1]) if problem["loc"] else ""
    if kind == "extra_forbidden":
        hint = _hint_for_unknown_key(model, last, sorted(_fields_at(model, problem["loc"][:-1])))
        return f"unknown key {last!r} in {dotted(loc[:-1])}", hint
    if kind == "missing":
        field = _fields_at(model, problem["loc"][:-1]).get(last, {})
        wanted = str(field.get("description") or "see the schema")
        return f"{name} has no {last!r}", f"add {last}: {wanted.partition('. ')[0].rstrip('.')}"
    if kind in ("union_tag_invalid", "literal_error"):
        value = str(context.get("tag", problem["input"]))
        expected = str(context.get("expected_tags") or context["expected"])
        choices = [choice.strip("' ") for choice in re.split(", | or ", expected)]
        key = f"{name}.kind" if "tag" in context else name
        return f"{key} is {value!r}", _nearest(value, choices)
    if kind == "union_tag_not_found":
        kinds = sorted({tag for form in _forms_at(model, problem["loc"]) for tag in _tags(form)})
        return f"{name} has no 'kind'", f"add kind: {' | '.join(kinds)}"
    if kind == "value_error":
        message, _, hint = str(context["error"]).partition(" | ")
        return f"{name}: {message}", hint or "correct the value"
    value = problem["input"]
    content = "is empty" if value is None else f"= {shorten(repr(value), 80)}"
    return f"{name} {content}", f"Give {wanted_of(problem)}."


def _hint_for_unknown_key(model: type[BaseModel], key: str, valid_keys: Sequence[str]) -> str:
    """Name the valid key that is most like an unknown one, be it in another section."""
    sections = {section: _fields_at(model, (section,)) for section in _fields_at(model, ())}
    elsewhere = {
        field: f"{section}.{field}" for section, fields in sections.items() for field in fields
    }
    likeness = _like(key, [*valid_keys, *elsewhere])
    if likeness is not None and likeness not in valid_keys:
        return f"did you mean {elsewhere[likeness]!r}? valid here: {', '.join(valid_keys)}"
    return _nearest(key, valid_keys)


def _nearest(name: str, choices: Sequence[str]) -> str:
    """Return a hint that names the nearest of the valid choices, and all of them."""
    return f"{guess(name, choices)}valid: {', '.join(choices)}"


def shipped_names(library: Path) -> list[str]:
    """Return the names of the YAML files that ship in a folder."""
    return sorted(path.stem for path in library.glob("*.yaml"))


def own_or_shipped(path_or_name: str | Path, library: Path, kind: str, option: str = "") -> Path:
    """Return a user's own YAML file, or the shipped one of that name.

    Args:
        path_or_name: The file or the name.
        library: The folder of those that ship.
        kind: What they are, for the hint: ``gate``.
        option: The option that names it, for the message: ``--settings``.

    Raises:
        InputError: Neither is there.
    """
    path = Path(path_or_name)
    if os.path.isfile(path):
        return path
    names = shipped_names(library)
    name = str(path_or_name)
    if name in names:
        return library / f"{name}.yaml"
    problem = "a folder, not a file" if os.path.isdir(path) else "no such file"
    raise InputError(
        f"{option} {name}: {problem}".strip(),
        f"{guess(name, names)}name a YAML file, or a shipped {kind}: {', '.join(names)}",
    )


def guess(name: str, choices: Collection[str]) -> str:
    """Return the beginning of a hint that names the choice nearest to a name; empty where none is
    near.
    """
    near = _like(name, choices)
    return "" if near is None else f"did you mean {near!r}? "


def _like(name: str, choices: Collection[str]) -> str | None:
    """Return the choice that is nearest to a name: one that has all its words, or else the same
    letters.
    """
    words = set(name.split("_"))
    whole = [choice for choice in choices if words <= set(choice.split("_"))]
    near = difflib.get_close_matches(name, whole or choices, n=1, cutoff=0.0 if whole else 0.65)
    return near[0] if near else None


def _fields_at(model: type[BaseModel], loc: Key) -> JsonObject:
    """Return the JSON schemas of the keys that may stand at a pydantic location."""
    fields: JsonObject = {}
    for form in _forms_at(model, loc):
        fields |= form.get("properties", {})
    return fields


def _forms_at(model: type[BaseModel], loc: Key) -> list[JsonObject]:
    """Return the JSON schemas of what may stand at a pydantic location: several where a union is
    not decided by a tag.
    """
    whole = model.model_json_schema()
    forms = [whole]
    for part in loc:
        below = []
        for form in forms:
            fields = form.get("properties", {})
            if isinstance(part, int):
                below.append(form.get("items"))
            elif part in _tags(form):
                below.append(form)
            else:
                below.append(fields.get(part, form.get("additionalProperties")))
        forms = [
            form for schema in below if isinstance(schema, dict) for form in _plain(schema, whole)
        ]
    return forms


def _plain(form: JsonObject, whole: JsonObject) -> list[JsonObject]:
    """Return the forms that a JSON schema allows, without references and unions."""
    if "$ref" in form:
        return _plain(whole["$defs"][form["$ref"].rpartition("/")[2]], whole)
    options = form.get("anyOf") or form.get("oneOf")
    if options is None:
        return [form]
    return [form for option in options for form in _plain(option, whole)]


def _tags(form: JsonObject) -> list[str]:
    kind = form.get("properties", {}).get("kind", {})
    return [kind["const"]] if "const" in kind else kind.get("enum", [])
