"""Measure over frozen test scenes whether the plan gap behind a renderer, on the recorded path, goes
with how far the policy drives from where it drove behind `clean`.

Usage: python docs/scripts/plan_gap_correlation.py SCENES OUT [--scenes N] [--seed N]
       [--policy P,P] [--renderer R,R] [--set KEY=VALUE]... [--json]

SCENES is a folder with the frozen splits (`simrun train scenes`). Scenes are taken in an order that is
drawn with the seed, so that any number of them is a random part of all; each scene has a file of its
own in OUT, and the same command continues where it stopped. ``--set`` changes every scene: with
``--set "cameras={rig: surround-6}"`` it has the cameras that `learned-three` needs.
"""

from __future__ import annotations

import argparse
import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pages import table

from alpasim_plugin.core.files import file_sha256, read_json_as
from alpasim_plugin.core.files.atomic import write_json
from alpasim_plugin.core.parts import PartSpec, RendererSpec, resolve, resolve_renderer
from alpasim_plugin.core.parts.source import package_digest
from alpasim_plugin.lab.bench.colour_video_vdp import load_metric
from alpasim_plugin.lab.bench.open_and_closed import TRUTH, correlation_rows, measure_scene
from alpasim_plugin.lab.bench.real import Judges
from alpasim_plugin.lab.training.frozen_scenes import check_scenes
from alpasim_plugin.lab.video_metrics.image_distance import load_distance
from alpasim_plugin.lab.video_metrics.perceptual_net import NAME
from alpasim_plugin.runs.renderer import make_renderer
from scenarios.load import load_scenario

RENDERERS = "3dgs,onefixer,onefixer[references=0]"
POLICIES = "learned,lane-camera"


def drawn_order(scenes: Path, seed: int) -> list[Path]:
    """Return the files of all frozen test scenes in an order drawn with a seed."""
    files = [
        scenes / split / f"{name}.yaml"
        for split, frozen in sorted(check_scenes(scenes).items())
        for name in sorted(frozen.scenes)
    ]
    order = np.random.default_rng(seed).permutation(len(files))
    return [files[number] for number in order]


def measured(
    file: Path, out: Path, settings: dict[str, Any], specs: dict[str, RendererSpec], judges: Judges
) -> list[dict[str, Any]]:
    """Return the rows of a scene, from its file in ``out`` where that was measured alike."""
    record = out / f"{file.parent.name}-{file.stem}.json"
    settings = {**settings, "scene": file_sha256(file), "program": package_digest()}
    if record.exists():
        stored: dict[str, Any] = read_json_as(dict[str, Any], record)
        if stored["settings"] != settings:
            raise SystemExit(
                f"{record}: measured with other settings, of another scene or by another program; name another folder"
            )
        rows: list[dict[str, Any]] = stored["rows"]
        return rows
    scenario = load_scenario(file, overrides=settings["set"])
    makers = {
        name: partial(make_renderer, spec, scenario, settings["seed"])
        for name, spec in specs.items()
    }
    policies: list[PartSpec] = [resolve("policy", name) for name in settings["policies"]]
    rows = measure_scene(scenario, makers, policies, judges, settings["seed"])
    write_json(record, {"settings": settings, "rows": rows})
    return rows


def main() -> None:
    """Measure scenes, and print the correlations over them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes_folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--policy", default=POLICIES)
    parser.add_argument("--renderer", default=RENDERERS)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    files = drawn_order(options.scenes_folder, options.seed)
    if not 1 <= options.scenes <= len(files):
        parser.error(f"--scenes {options.scenes}: there are {len(files)}; write 1 to {len(files)}")
    names = [TRUTH, *options.renderer.split(",")]
    vdp, why_not = load_metric()
    settings = {
        "seed": options.seed,
        "policies": options.policy.split(","),
        "renderers": names,
        "set": options.set,
        "has_jod": vdp is not None,
    }
    options.out.mkdir(parents=True, exist_ok=True)
    specs = {name: resolve_renderer(name) for name in names}
    judges = Judges(load_distance(NAME), vdp)
    units = []
    for number, file in enumerate(files[: options.scenes], start=1):
        units += measured(file, options.out, settings, specs, judges)
        if not options.json:
            print(f"{number}/{options.scenes} {file.parent.name}/{file.stem}", flush=True)
    rows = correlation_rows(units)
    if options.json:
        print(json.dumps({"units": units, "correlations": rows}, indent=1))
        return
    if why_not:
        print(why_not)
    head = list(rows[0])
    print(table(head, [[str(row[name]) for name in head] for row in rows]))


if __name__ == "__main__":
    main()
