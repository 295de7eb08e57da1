"""``simrun new``: write a part or a scenario that works, with its test, to begin from."""

import keyword
import os
import re
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from string import Template
from typing import Annotated, Literal

from alpasim_plugin.cli.options import Json
from alpasim_plugin.cli.output import show
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.atomic import write_text
from alpasim_plugin.core.flags import Positional

Kind = Literal["policy", "scenario", "renderer", "fixer", "metric"]
TRY: dict[Kind, str] = {
    "policy": "simrun check policy {file}:{cls}",
    "scenario": "simrun view {file}",
    "renderer": "simrun --renderer clean,{file}:{cls} --policy lane-camera smoke/curve",
    "fixer": "simrun --renderer 3dgs,{file}:{cls}+3dgs --policy lane-camera smoke/curve",
    "metric": "simrun --renderer clean --policy lane-camera --evaluator {file}:{cls} smoke/curve",
}

EPILOG = """
Examples:

- `simrun new policy my_policy`: my_policy.py with the class MyPolicy, and test_my_policy.py

- `simrun new scenario my_scene`
"""


def new(
    kind: Annotated[Kind, Positional("What to write.")],
    name: Annotated[str, Positional("Its name: lower case, digits and underscores.")],
    as_json: Json = False,
) -> None:
    """Write a working policy, scenario, renderer, fixer or metric into the working folder, with a
    test.
    """
    if not re.fullmatch("[a-z][a-z0-9_]*", name) or keyword.iskeyword(name):
        raise InputError(
            f"name {name!r}: not a name of a Python file",
            "use lower case, digits and underscores: my_policy",
        )
    words = {
        "name": name,
        "file": f"{name}.yaml" if kind == "scenario" else f"{name}.py",
        "test": f"test_{name}.py",
        "Class": "".join(part.capitalize() for part in name.split("_")),
    }
    targets = {Path(words["file"]): f"{kind}.txt", Path(words["test"]): f"{kind}_test.txt"}
    for path in targets:
        if os.path.exists(path):
            raise InputError(f"{path}: it exists already", "choose another name, or remove it")
    templates = files("alpasim_plugin.cli") / "templates"
    texts = {
        path: (templates / template).read_text(encoding="utf-8")
        for path, template in targets.items()
    }
    imported = find_spec(name) if kind != "scenario" else None
    imports = rf"^(from|import) .*(?<![$\w]){words['Class']}\b"
    in_use = any(re.search(imports, text, re.MULTILINE) for text in texts.values())
    if in_use or (imported and imported.origin):
        raise InputError(
            f"name {name!r}: it would hide a class or a module that the written file imports",
            f"choose another name: my_{name}",
        )
    for path, text in texts.items():
        write_text(path, Template(text).substitute(words))
    command = TRY[kind].format(file=words["file"], cls=words["Class"])
    test = f"python -m pytest {words['test']}"
    if not find_spec("pytest"):
        test += "   # after: pip install pytest"
    lines = [f"wrote    {path}" for path in targets]
    facts = {"files": [str(path) for path in targets], "try": command}
    show(as_json, facts, *lines, f"test     {test}", f"next     {command}")
