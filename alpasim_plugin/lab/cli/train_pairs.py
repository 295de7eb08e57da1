"""``simrun train pairs``: degraded and clean frames, of drawn scenes or of recorded videos."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from alpasim_plugin.core.devices import require_device
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.printing import say_document
from alpasim_plugin.lab.cli.image_sizes import parse_size
from alpasim_plugin.lab.cli.training_options import AsJson, Debug, Device, scene_files
from alpasim_plugin.lab.jobs import map_jobs
from alpasim_plugin.lab.training.pair_pack import write_pack
from alpasim_plugin.lab.training.pairs import PairRecipe, make_sequence
from alpasim_plugin.lab.training.video_pairs import VideoRecipe, make_video_pairs
from scenarios.load import load_scenario

EPILOG = """
Examples:

- `simrun train pairs data/scenes --out data/pairs --split val,train --jobs 2`

- `simrun train pairs drive.mp4 --out data/video --size 256x144 --size 512x288`
"""


Sources = Annotated[
    list[Path],
    typer.Argument(
        metavar="SCENES|VIDEO...",
        help="Folder that 'simrun train scenes' wrote; or driving videos whose licence lets you train on them.",
    ),
]
Out = Annotated[Path, typer.Option("--out", help="Folder to write to; the same command resumes.")]
Split = Annotated[
    str, typer.Option("--split", help="Splits of the scenes, comma-separated, in this order.")
]
Source = Annotated[str, typer.Option("--source", help="Renderer of the degraded frames.")]
MaxOffsetM = Annotated[
    float,
    typer.Option("--max-offset-m", min=0.0, help="Largest lateral offset from the log, metres."),
]
OffsetM = Annotated[
    float | None,
    typer.Option("--offset-m", help="One lateral offset for all frames, metres, left positive."),
]
Count = Annotated[
    int | None, typer.Option("--count", min=1, help="Only the first N scenes of each split.")
]
Size = Annotated[
    list[str] | None,
    typer.Option(
        "--size", metavar="WIDTHxHEIGHT", help="Of videos; repeatable, by default 256x144."
    ),
]
Variants = Annotated[
    int, typer.Option("--variants", min=1, help="Differently damaged sequences of a video.")
]
Pack = Annotated[
    Path | None,
    typer.Option(
        "--pack",
        help="Also write the sequences into this file of at most 40 MB, images as video: it stands for a folder of pairs in training.",
    ),
]


def pairs(
    sources: Sources,
    out: Out,
    split: Split = "val,train",
    source: Source = "3dgs",
    max_offset_m: MaxOffsetM = 2.5,
    offset_m: OffsetM = None,
    count: Count = None,
    size: Size = None,
    variants: Variants = 2,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of offsets and damage.")] = 0,
    jobs: Annotated[int, typer.Option("--jobs", min=1, help="Processes, one thread each.")] = 1,
    pack: Pack = None,
    device: Device = "cpu",
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Write pairs of degraded and clean frames with opacity, semantic map and poses; complete
    sequences are kept.

    Scenes are rendered. Videos are cut into a part to train on and a held-out one, and damaged as
    an under-trained reconstruction would be.
    """
    del debug
    began = time.perf_counter()
    console = Console(stderr=True)
    rows = []
    made: Iterable[tuple[Path, bool]]  # folder of a sequence, and whether it is new
    if len(sources) == 1 and sources[0].is_dir():
        scenes = scenes_of(sources[0], split, count)
        maker = _Maker(
            out,
            PairRecipe(source, max_offset_m=max_offset_m, offset_m=offset_m),
            seed,
            require_device(device),
        )
        made = (result for _, result in map_jobs(maker, scenes, jobs))
    else:
        sizes = [parse_size(text) for text in size or ["256x144"]]
        made = (
            pair
            for path in sources
            for pixels in sizes
            for pair in make_video_pairs(path, out, VideoRecipe(pixels, variants, seed=seed))
        )
    for folder, is_new in made:
        rows.append({"folder": str(folder), "made": is_new})
        note = "" if is_new else " (exists)"
        line = f"{folder}{note}, {time.perf_counter() - began:.0f} s"
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    packed = None
    if pack is not None:
        packed = asdict(write_pack([Path(str(row["folder"])) for row in rows], pack))
        console.print(f"{pack}: {packed}", highlight=False, markup=False, soft_wrap=True)
    if as_json:
        new = sum(bool(row["made"]) for row in rows)
        say_document({"sequences": len(rows), "made": new, "rows": rows, "pack": packed})


@dataclass(frozen=True)
class _Scene:
    path: Path
    split: str


@dataclass(frozen=True)
class _Maker:
    out: Path
    recipe: PairRecipe
    seed: int
    device: str

    def __call__(self, scene: _Scene) -> tuple[Path, bool]:
        family = scene.path.stem.rsplit("_", 1)[0]
        folder = self.out / scene.split / scene.path.stem
        scenario = load_scenario(scene.path)
        is_new = make_sequence(
            scenario,
            folder,
            self.recipe,
            self.seed,
            split=scene.split,
            family=family,
            device=self.device,
        )
        return folder, is_new


def scenes_of(folder: Path, split: str, count: int | None) -> list[_Scene]:
    """Return the scenes of comma-separated splits, at most ``count`` of each.

    Raises:
        InputError: There are none.
    """
    scenes = []
    for name in split.split(","):
        files = scene_files(folder, name.strip())[:count]
        scenes += [_Scene(path, name.strip()) for path in files]
    if not scenes:
        raise InputError(
            f"{folder}: no scenario in {split}", "Make some with 'simrun train scenes'."
        )
    return scenes
