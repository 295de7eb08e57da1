"""``simrun bench presets``: the same logs under several evaluator presets."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Annotated

import typer

from alpasim_plugin.lab.bench.preset_conversion import as_markdown, conversion_table, convert
from alpasim_plugin.log import read_asl
from alpasim_plugin.runs.score_logs import KnownScenes, find_logs
from evaluators.metrics.presets import preset as find_preset

EPILOG = """
Examples:

- `simrun bench presets DATA/alpasim-golden/rollouts --scene DATA/alpasim-golden/scenes`, DATA being the folder of third-party logs

- `simrun bench presets runs/smoke/rollouts/3dgs --scene suites/smoke`
"""


def presets(
    logs: Annotated[
        list[str], typer.Argument(help="Logs (.asl), folders of them, or patterns in quotes.")
    ],
    scene: Annotated[
        list[str],
        typer.Option("--scene", help="The logs' scene, or a folder of scenes. Repeatable."),
    ],
    names: Annotated[
        str,
        typer.Option("--presets", help="Presets, comma-separated; differences are from the first."),
    ] = "paper,alpasim,strict",
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document on stdout.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Score logs under several presets and print how each metric converts, as a Markdown table.

    Flags are counted ("k of n": n rollouts have a value), other metrics averaged (number of
    rollouts in brackets). "differs" counts the rollouts whose value is not that of the first
    preset: more than 0.001 away, or valid under one of the two only.
    """
    del debug
    chosen = [find_preset(name.strip()) for name in names.split(",")]
    scenes = KnownScenes(scene)
    found = []
    for log in find_logs(logs):
        rollout = read_asl(log)
        found.append(convert(log.parent.name, rollout, scenes.of(rollout.scene_id).scene, chosen))
    rows = conversion_table(found, [one.name for one in chosen])
    if as_json:
        print(
            json.dumps(
                {
                    "metrics": [asdict(row) for row in rows],
                    "rollouts": [asdict(one) for one in found],
                }
            )
        )
    else:
        print(as_markdown(rows, found))
