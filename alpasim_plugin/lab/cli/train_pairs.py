"""``simrun train reconstructions | pairs | pairs-sheet | import-pairs``: training data of a
fixer.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from alpasim_plugin.core.cache import cache_root
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.cli.image_sizes import parse_size
from alpasim_plugin.lab.cli.training_options import AsJson, Debug, scene_files
from alpasim_plugin.lab.training.pair_import import PairSources, import_sequence
from alpasim_plugin.lab.training.pair_sheet import (
    contact_sheet,
    measure_sequence,
    sheet,
    write_sheet,
)
from alpasim_plugin.lab.training.pair_store import PairDataset
from alpasim_plugin.lab.training.pairs import PairRecipe, make_sequence
from alpasim_plugin.lab.training.scenes import SPLITS
from alpasim_plugin.renderers.reconstruction import KIND, ensure
from alpasim_plugin.renderers.reconstruction_key import recipe_of, reconstruction_key
from alpasim_plugin.runs.executors.local import map_jobs
from scenarios.load import load_scenario
from scenarios.suite import ScenarioRef, expand

Jobs = Annotated[int, typer.Option("--jobs", min=1, help="Processes, one thread each.")]
RECONSTRUCTIONS_EPILOG = "Example: `simrun train reconstructions suites/urban --jobs 2`"
PAIRS_EPILOG = (
    "Example: `simrun train pairs data/scenes --out data/pairs --split val,train --jobs 2`"
)
SHEET_EPILOG = "Example: `simrun train pairs-sheet data/pairs --out sheet`"
IMPORT_EPILOG = (
    "Example: `simrun train import-pairs data/pairs --name drive1 --rgb-input render.mp4 --rgb-gt log/ --opacity alpha.mp4 --sdmap map.mp4 "
    "--poses poses.json`"
)


def reconstructions(
    scenarios: Annotated[
        list[str],
        typer.Argument(metavar="SCENARIO...", help="Scenarios, suites or folders of them."),
    ],
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", help="Override a scenario key: key=value. Repeatable."),
    ] = None,
    jobs: Jobs = 1,
    again: Annotated[bool, typer.Option("--again", help="Fit existing ones again.")] = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Fit and cache the reconstructions of scenarios for the renderer 3dgs before runs."""
    del debug
    refs = [ref for item in scenarios for ref in expand(item, overrides or ())]
    console, rows = Console(stderr=True), []
    for number, (ref, row) in enumerate(map_jobs(_Fitted(again), refs, jobs), start=1):
        rows.append({"path": ref.path, **row})
        console.print(
            f"[{number}/{len(refs)}] {row['scene_id']}: {row['what']}",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
    if as_json:
        print(json.dumps(rows))


@dataclass(frozen=True)
class _Fitted:
    again: bool

    def __call__(self, ref: ScenarioRef) -> dict[str, object]:
        scenario = load_scenario(ref.path, ref.seed, ref.overrides)
        kind = scenario.degradation.kind
        if kind not in ("reconstruction", "cycle"):
            return {
                "scene_id": scenario.scene_id,
                "what": f"kind {kind} has nothing to fit",
                "folder": None,
                "seconds": 0.0,
            }
        recipe, began = recipe_of(scenario), time.perf_counter()
        folder = cache_root() / KIND / reconstruction_key(scenario, recipe)
        there = folder.exists() and not self.again
        model, _ = ensure(scenario, recipe, None, again=self.again)
        what = f"{len(model):,} Gaussians {'in' if there else 'fitted to'} {folder}"
        return {
            "scene_id": scenario.scene_id,
            "what": what,
            "folder": str(folder),
            "seconds": round(time.perf_counter() - began, 2),
        }


def pairs(
    scenes: Annotated[
        Path,
        typer.Argument(help="Folder that 'simrun train scenes' wrote: SPLIT/FAMILY_NUMBER.yaml."),
    ],
    out: Annotated[
        Path, typer.Option("--out", help="Folder to write to; the same command resumes.")
    ],
    split: Annotated[
        str, typer.Option("--split", help="Splits, comma-separated, in this order.")
    ] = "val,train",
    source: Annotated[
        str, typer.Option("--source", help="Renderer of the degraded frames.")
    ] = "3dgs",
    max_offset_m: Annotated[
        float,
        typer.Option(
            "--max-offset-m", min=0.0, help="Largest lateral offset from the log, metres."
        ),
    ] = 2.5,
    offset_m: Annotated[
        float | None,
        typer.Option(
            "--offset-m",
            help="One lateral offset from the log for all frames, metres, left positive.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the lateral offset.")] = 0,
    count: Annotated[
        int | None, typer.Option("--count", min=1, help="Only the first N scenes of each split.")
    ] = None,
    jobs: Jobs = 1,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Render pairs of degraded and clean frames with opacity, semantic map and poses; complete
    sequences are kept.
    """
    del debug
    work: list[_Scene] = []
    for name in (s.strip() for s in split.split(",")):
        work += [_Scene(path, name) for path in scene_files(scenes, name)[:count]]
    if not work:
        raise InputError(
            f"{scenes}: no scenario in {split}",
            "make some with 'simrun train scenes'",
        )
    console, began = Console(stderr=True), time.perf_counter()
    maker = _Maker(
        out, PairRecipe(source=source, max_offset_m=max_offset_m, offset_m=offset_m), seed
    )
    rows = []
    for number, (scene, made) in enumerate(map_jobs(maker, work, jobs), start=1):
        rows.append(
            {
                "split": scene.split,
                "sequence": scene.path.stem,
                "folder": str(maker.folder(scene)),
                "made": made,
            }
        )
        note = "" if made else " (exists)"
        line = f"[{number}/{len(work)}] {scene.split}/{scene.path.stem}{note}, {time.perf_counter() - began:.0f} s"
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    if as_json:
        print(
            json.dumps(
                {
                    "sequences": len(rows),
                    "made": sum(bool(row["made"]) for row in rows),
                    "rows": rows,
                }
            )
        )


@dataclass(frozen=True)
class _Scene:
    path: Path
    split: str


@dataclass(frozen=True)
class _Maker:
    out: Path
    recipe: PairRecipe
    seed: int

    def folder(self, scene: _Scene) -> Path:
        return self.out / scene.split / scene.path.stem

    def __call__(self, scene: _Scene) -> bool:
        family = scene.path.stem.rsplit("_", 1)[0]
        return make_sequence(
            load_scenario(scene.path),
            self.folder(scene),
            self.recipe,
            self.seed,
            split=scene.split,
            family=family,
        )


def pairs_sheet(
    data: Annotated[Path, typer.Argument(help="Folder of pairs: SPLIT/SEQUENCE.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", help="Folder for sheet.md and sheet.jpg; by default neither is written."
        ),
    ] = None,
    split: Annotated[
        str | None, typer.Option("--split", help="Splits, comma-separated; by default all.")
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Measure pairs: counts, PSNR, SSIM, holes, luminance and map; prints one JSON document (--json
    has no effect).
    """
    del as_json, debug
    names = (
        [s.strip() for s in split.split(",")]
        if split
        else sorted(p.name for p in data.glob("*") if any(p.glob("*/sequence.json")))
    )
    if not names:
        raise InputError(
            f"{data}: no finished sequence",
            "make some with 'simrun train pairs'",
        )
    datasets = {name: PairDataset(data, name) for name in names}
    todo = [
        (name, sequence) for name, dataset in datasets.items() for sequence in dataset.sequences
    ]
    console, facts = Console(stderr=True), []
    for number, (name, sequence) in enumerate(todo, start=1):
        facts.append(measure_sequence(sequence, name))
        console.print(
            f"[{number}/{len(todo)}] {name}/{sequence.name}",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
    document = sheet(facts)
    if out is not None:
        write_sheet(out, document, contact_sheet([sequence for _, sequence in todo]))
    print(json.dumps(document, indent=1))


def import_pairs(
    out: Annotated[Path, typer.Argument(help="Folder of pairs to add to.")],
    rgb_input: Annotated[
        Path,
        typer.Option("--rgb-input", help="Degraded renders: video, folder of images, or .npy."),
    ],
    rgb_gt: Annotated[Path, typer.Option("--rgb-gt", help="Clean frames, likewise.")],
    opacity: Annotated[
        Path,
        typer.Option("--opacity", help="Opacity with the sky filled, white is opaque, likewise."),
    ],
    sdmap: Annotated[Path, typer.Option("--sdmap", help="Semantic map, likewise.")],
    poses: Annotated[
        Path,
        typer.Option(
            "--poses", help="T_world_camera of every frame, OpenCV axes: .npy (T, 4, 4) or JSON."
        ),
    ],
    name: Annotated[str, typer.Option("--name", help="Name of the sequence.")],
    split: Annotated[str, typer.Option("--split", help="train, val, or a test split.")] = "train",
    fps: Annotated[
        float, typer.Option("--fps", help="Frames per second, for poses without times.")
    ] = 10.0,
    size: Annotated[
        str | None,
        typer.Option("--size", metavar="WIDTHxHEIGHT", help="Scale all images to this size."),
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Import renders of your own reconstruction as a sequence of pairs, as long as its shortest
    channel.
    """
    del debug
    if split not in SPLITS or not name or Path(name).name != name or name.startswith("."):
        known = ", ".join(SPLITS)
        raise InputError(
            f"--split {split} --name {name}: not a valid split and name",
            f"give one of {known}, and a plain name",
        )
    sources = PairSources(rgb_input, rgb_gt, opacity, sdmap, poses)
    folder = out / split / name
    frames = import_sequence(
        sources, folder, fps=fps, size=parse_size(size) if size else None, facts={"split": split}
    )
    Console(stderr=True).print(
        f"{folder}: {frames} frames", highlight=False, markup=False, soft_wrap=True
    )
    if as_json:
        print(json.dumps({"folder": str(folder), "split": split, "frames": frames}))
