"""Write the tables of options, metrics, scenario keys, faults that suites catch, fields of file
formats and members of a run folder's files into docs/cli.md, docs/metrics.md,
docs/scenario-files.md, docs/scenarios.md, docs/formats.md and docs/runs.md, from the code.

    python docs/scripts/reference_tables.py [--check]

With ``--check`` nothing is written, and the exit code is 1 where a page is stale.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Collection, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from pages import DOCS, replaced, table, write
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from alpasim_plugin.cameras.transforms import RIG
from alpasim_plugin.cli.main import PANELS, load_verb
from alpasim_plugin.cli.options import METAVARS
from alpasim_plugin.control.can_codec import DBC
from alpasim_plugin.core.metric_types import MetricInfo
from alpasim_plugin.drives.colmap import COLMAP
from alpasim_plugin.drives.kitti import KITTI
from alpasim_plugin.drives.py123d import PY123D
from alpasim_plugin.drives.splat import TRAINED_FRAME
from alpasim_plugin.gaussians.files.packed import COMPRESSED, SPZ
from alpasim_plugin.gaussians.files.ply import PLY
from alpasim_plugin.gaussians.files.sog import SOG
from alpasim_plugin.gaussians.fit.photographs import TRANSFORMS
from alpasim_plugin.log.fields import ASL
from alpasim_plugin.log.run_folder.records import Manifest, RunInfo
from evaluators.metrics.score_table import BENCHMARKS
from evaluators.metrics.table import METRICS
from evaluators.results import Summary
from scenarios.argoverse import ARGOVERSE, CALIBRATION
from scenarios.commonroad_fields import COMMONROAD
from scenarios.ftheta import LENS
from scenarios.lanelet2 import LANELET2
from scenarios.load import catches_of
from scenarios.opendrive_fields import OPENDRIVE
from scenarios.osi_messages import OSI
from scenarios.schema import FAULTS, models
from scenarios.schema_parts import Part
from scenarios.suite import load_suite, suites
from scenarios.usdz_fields import USDZ

FORMATS = (
    *(PLY, COMPRESSED, SPZ, SOG, TRANSFORMS, RIG, TRAINED_FRAME, COLMAP, KITTI, PY123D),
    *(ARGOVERSE, CALIBRATION, USDZ, LENS, OPENDRIVE, LANELET2, COMMONROAD, OSI, DBC, ASL),
)
MAIN_VERB = "run"
KIND = " kind: "  # in the name of a section: of which kind of a list it is
EVERY_VERB = ("--json", "--debug", "--help")
TYPES = {float: "number", int: "integer", str: "text", bool: "boolean", Path: "path"}
SIGNS = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}


def commands(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yield a command, or the commands of a group, each with its whole name."""
    if not hasattr(command, "commands"):
        yield name, command
        return
    for word, inner in command.commands.items():
        yield from commands(inner, f"{name} {word}")


def verb_section(name: str, command: Any) -> str:
    """Return a verb's heading, what it does, and its options."""
    rows = []
    for option in command.params:
        names = [*option.opts, *option.secondary_opts]
        if option.param_type_name == "argument":
            names = [option.metavar or option.name.upper()]
        meaning = option.help or ""
        is_newest = meaning == "A run folder; default: the newest."  # said once, above
        if getattr(option, "hidden", False) or set(names) & set(EVERY_VERB) or is_newest:
            continue
        written_names = ", ".join(f"`{name}`" for name in names)
        again = "..." if meaning.endswith(" Repeatable.") else ""
        row = (written_names + again, option_value(option), option_default(option))
        rows.append((*row, meaning.removesuffix(" Repeatable.")))
    text = " ".join((command.help or "").partition("\n\n")[0].split())
    head = ("option", "value", "default", "meaning")
    options = "\n" + table(head, rows) if rows else ""
    return f"## {name}\n{text}\n{options}"


def option_value(option: Any) -> str:
    """Return what an option takes, with its bounds; empty for a switch and for an argument, whose
    name says it.
    """
    if option.param_type_name == "argument" or option.is_flag:
        return ""
    if option.metavar and option.metavar not in METAVARS.values():
        return f"`{option.metavar}`"
    kind = type_name(option.type_descriptor.annotation)
    if option.min is not None and option.max is not None:
        return f"{kind}, {option.min}..{option.max}"
    return kind if option.min is None else f"{kind}, >= {option.min}"


def option_default(option: Any) -> str:
    """Return what holds where an option is left out; empty where that is nothing, or where the
    meaning says it.
    """
    if option.required:
        return "required"
    if option.secondary_opts:  # a switch with a name for each side
        (name,) = option.opts if option.default else option.secondary_opts
        return f"`{name}`"
    is_nothing = option.default is None or option.default is False or option.default in ([], "")
    return "" if is_nothing else f"`{option.default}`"


def cli_tables() -> str:
    """Return a section for each verb of this package: the main job, then the others in the order of
    the help page.
    """
    sections = []
    in_order = [verb for panel in PANELS.values() for verb in panel]
    for verb in sorted(in_order, key=lambda verb: verb != MAIN_VERB):
        sections += [verb_section(*one) for one in commands(load_verb(verb), f"simrun {verb}")]
    return "\n".join(sections)


def metric_table() -> str:
    """Return one row for each metric, in the order of reports; metrics that differ in their names
    alone share a row.
    """
    names: dict[tuple[str, ...], list[str]] = {}
    for name in METRICS.ordered(METRICS):
        metric = METRICS[name]
        if name in BENCHMARKS or metric.formula.endswith("`alpasim` only"):
            continue
        row = (
            metric.formula or metric.help,
            metric.reference.removesuffix(", plan view").replace("box centre", ""),
            metric.unit,
            {"none": "neither"}.get(metric.direction, metric.direction),
            metric.aggregation,
            f"{metric.accepted:g}" if metric.accepted else "",
            metric.invalid,
        )
        names.setdefault(row, []).append(f"`{name}`")
    head = ("metric", "per step", "measured at", "unit", "better", "over a rollout", "accepted")
    return table((*head, "invalid"), ((", ".join(some), *row) for row, some in names.items()))


def type_name(annotation: Any) -> str:
    """Return the words for a key's type."""
    origin, options = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return ", ".join(f"`{option}`" for option in options)
    if hasattr(annotation, "__metadata__"):
        return type_name(options[0])
    if origin is dict:
        return "keys"
    names = [type_name(option) for option in options if option not in (type(None), Ellipsis)]
    if origin is tuple:
        return f"list of {min(names)}" if Ellipsis in options else f"{len(options)} x {min(names)}"
    if names:
        return " or ".join(dict.fromkeys(names))
    if isinstance(annotation, type) and issubclass(annotation, Part):
        return "section"
    return TYPES.get(annotation, "any value")


def key_row(name: str, field: FieldInfo) -> tuple[str, str, str, str]:
    """Return a key's name, type with bounds, default and meaning."""
    bounds = {sign: getattr(item, sign) for item in field.metadata for sign in SIGNS
              if getattr(item, sign, None) is not None}  # fmt: skip
    limits = [f"{SIGNS[sign]} {end}" for sign, end in bounds.items()]
    if {"ge", "le"} <= bounds.keys():
        limits = [f"{bounds['ge']}..{bounds['le']}"]
    kind = type_name(field.annotation)
    if limits:  # a range is one of numbers, where nothing else is said
        kind = ", ".join([kind, *limits]).removeprefix("number, ")
    value = field.default
    default = f"`{str(value).lower() if isinstance(value, bool) else value}`"
    if value is PydanticUndefined or value is None or isinstance(value, Part) or value in ("", {}):
        default = "required" if value is PydanticUndefined else ""
    elif isinstance(value, tuple):
        default = f"`[{', '.join(map(str, value))}]`"
    return f"`{field.alias or name}`", kind, default, field.description or ""


def key_tables() -> str:
    """Return one table for each section of the schema. Keys that all kinds of a list have alike stand
    in a table of their own, before those of the kinds.
    """
    rows_of = {
        section: [
            key_row(name, field)
            for name, field in model.model_fields.items()
            if not (KIND in section and name == "kind")
        ]
        for section, model in models().items()
    }
    shared: dict[str, list[tuple[str, str, str, str]]] = {}
    for section, rows in rows_of.items():
        owner, is_kind, _ = section.partition(KIND)
        if is_kind:
            shared[owner] = [row for row in shared.get(owner, rows) if row in rows]
    sections = []
    begun = set()
    for section, model in models().items():
        owner, is_kind, _ = section.partition(KIND)
        if is_kind and owner not in begun and shared[owner]:
            text = f"Each has `kind`, and beside the keys of its kind these.\n\n{key_table(shared[owner])}"
            sections.append(f"## `{owner}` of every kind\n{text}")
        begun.add(owner)
        own = [row for row in rows_of[section] if row not in shared.get(owner, [])]
        summary = " ".join((model.__doc__ or "").partition("\n\n")[0].split())
        keys = f"\n{key_table(own)}" if own else ""
        sections.append(f"## {f'`{section}`' if section else 'Top level'}\n{summary}\n{keys}")
    return "\n".join(sections)


def key_table(rows: Collection[tuple[str, str, str, str]]) -> str:
    """Return the table of a section's keys."""
    return table(("key", "type", "default", "meaning"), rows)


def fault_table() -> str:
    """Return one row for each fault of a policy: how many scenes of each suite name it."""
    named = {name: [catches_of(ref) for ref in load_suite(name)] for name in suites()}
    head = [f"`{name.removeprefix('suites/')}`" for name in named]
    totals = ("scenes", "", *(str(len(scenes)) for scenes in named.values()))
    rows = [
        (
            f"`{fault}`",
            meaning,
            *(str(sum(fault in faults for faults in scenes)) for scenes in named.values()),
        )
        for fault, meaning in FAULTS.items()
    ]
    return table(("fault", "the policy", *head), [*rows, totals])


def field_table() -> str:
    """Return the table of the fields that readers know."""
    head = ("form", "read", "left out without a change", "refused")
    return table(head, [fields.row() for fields in FORMATS])


def documented(record: type[Any]) -> dict[str, str]:
    """Return the meaning of each member of a record, from its docstring.

    Raises:
        ValueError: A member has none.
    """
    _, _, section = (inspect.getdoc(record) or "").partition("Attributes:\n")
    entries = re.findall(r"^    (\w[\w, ]*): (.*(?:\n {8}.*)*)", section, re.M)
    meanings = {
        name: " ".join(text.split()) for names, text in entries for name in names.split(", ")
    }
    undocumented = [field.name for field in fields(record) if field.name not in meanings]
    if undocumented:
        raise ValueError(f"{record.__name__}: no docstring of {', '.join(undocumented)}")
    return {field.name: meanings[field.name] for field in fields(record)}


def records_in(record: type[Any]) -> Iterator[type[Any]]:
    """Yield the records that the members of a record hold, in their order."""
    hints = list(get_type_hints(record).values())
    while hints:
        hint = hints.pop(0)
        if is_dataclass(hint) and isinstance(hint, type):
            yield hint
        hints = [*get_args(hint), *hints]


def record_tables(record: type[Any], left_out: Collection[type[Any]]) -> str:
    """Return a table for a file's record and one for each record inside of it, but for those that
    have a table elsewhere.
    """
    todo = [record]
    tables: dict[type[Any], str] = {}
    while todo:
        current = todo.pop(0)
        if current in tables or current in left_out:
            continue
        meanings = documented(current)
        rows = [(f"`{name}`", code_words(text)) for name, text in meanings.items()]
        title = " ".join((inspect.getdoc(current) or "").partition("\n\n")[0].split())
        heading = "" if current is record else f"`{current.__name__}`: {code_words(title)}\n\n"
        tables[current] = heading + table(("member", "meaning"), rows)
        todo += records_in(current)
    return "\n".join(tables.values())


def code_words(text: str) -> str:
    """Return a docstring's sentence with its code as Markdown has it, and None as JSON has it."""
    return re.sub(r"\bNone\b", "null", re.sub(r"`+([^`]+)`+", r"`\1`", text))


def run_page() -> str:
    """Return docs/runs.md with the members of the JSON files of a run folder."""
    text = (DOCS / "runs.md").read_text(encoding="utf-8")
    text = replaced(text, "run.json", record_tables(RunInfo, [MetricInfo]))
    text = replaced(text, "manifest.json", record_tables(Manifest, [*records_in(RunInfo)]))
    return replaced(
        text, "summary.json", record_tables(Summary, [*records_in(RunInfo), *records_in(Manifest)])
    )


def written() -> dict[Path, str]:
    """Return the pages as they should be."""
    tables = {"cli": ("options", cli_tables()), "metrics": ("metrics", metric_table()),
              "scenario-files": ("keys", key_tables()), "scenarios": ("faults", fault_table()),
              "formats": ("fields", field_table())}  # fmt: skip
    pages = {
        (page := DOCS / f"{name}.md"): replaced(page.read_text(encoding="utf-8"), block, content)
        for name, (block, content) in tables.items()
    }
    return pages | {DOCS / "runs.md": run_page()}


if __name__ == "__main__":
    write(written())
