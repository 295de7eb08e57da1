"""``simrun preview``: a scenario in one picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

from alpasim_plugin.cli.options import Json, Overrides, Overwrite, refuse_existing
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.run_folder.schema import slug
from alpasim_plugin.runtime.preview import DOING, draw_preview
from scenarios.load import load_scenario

EPILOG = """
Examples:

- `simrun preview smoke/lead_car`

- `simrun preview my_scene.yaml --seed 3 --renderer 3dgs --out my_scene.html`
"""


def preview(
    scenario: Annotated[str, Positional("Scenario YAML, a shipped name, or a recorded log.")],
    out: Annotated[Path | None, Flag("PNG or HTML; by default SCENE.png here.", also="-o")] = None,
    seed: Annotated[int | None, Flag("Scene seed; by default the file's.", min=0)] = None,
    renderer: Annotated[str, Flag("What renders the camera frames.")] = "clean",
    frames: Annotated[int, Flag("Moments shown.", min=2, max=12)] = 5,
    overrides: Overrides = (),
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Draw a scenario before it is driven: map, road users over time, and the camera along the recorded drive."""
    loaded = load_scenario(scenario, seed, overrides)
    path = out or Path(f"{slug(loaded.scene_id)}.png")
    refuse_existing(path, overwrite, DOING, "")
    made = draw_preview(loaded, path, frames, renderer)
    if as_json:
        print(
            json.dumps({"preview": str(path), "scene": loaded.scene_id, "times_s": made.times_s, "actors": made.actors, "facts": made.text})
        )
        return
    for line in made.text:
        print(line)
    print(f"preview  {path}")
