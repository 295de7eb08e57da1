"""``simrun preview``: a scenario in one picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.run_folder.schema import slug
from alpasim_plugin.runtime.preview import DOING, draw_preview
from scenarios.load import load_scenario

EPILOG = """
Examples:

- `simrun preview smoke/lead_car`

- `simrun preview my_scene.yaml --seed 3 --renderer 3dgs --out my_scene.html`
"""


def preview(
    scenario: Annotated[str, typer.Argument(help="Scenario YAML, a shipped name, or a recorded log.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="PNG or HTML; by default SCENE.png here.")] = None,
    seed: Annotated[int | None, typer.Option("--seed", min=0, help="Scene seed; by default the file's.")] = None,
    renderer: Annotated[str, typer.Option("--renderer", help="What renders the camera frames.")] = "clean",
    frames: Annotated[int, typer.Option("--frames", min=2, max=12, help="Moments shown.")] = 5,
    overrides: Annotated[list[str] | None, typer.Option("--set", help="Override a scenario key: key=value. Repeatable.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a picture that exists.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Draw a scenario before it is driven: map, road users over time, and the camera along the recorded drive."""
    del debug
    loaded = load_scenario(scenario, seed, tuple(overrides or ()))
    path = out or Path(f"{slug(loaded.scene_id)}.png")
    if path.exists() and not overwrite:
        raise InputError(DOING, str(path), "it exists already", "name another --out, or pass --overwrite")
    made = draw_preview(loaded, path, frames, renderer)
    if as_json:
        print(
            json.dumps({"preview": str(path), "scene": loaded.scene_id, "times_s": made.times_s, "actors": made.actors, "facts": made.text})
        )
        return
    for line in made.text:
        print(line)
    print(f"preview  {path}")
