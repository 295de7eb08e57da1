"""Write the scenarios of the three splits: train, val and test, apart by seed, and test apart by family as well."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import yaml

from alpasim_plugin.atomic import write_text
from alpasim_plugin.errors import InputError, SimrunError
from alpasim_plugin.training.scene_families import TEST_FAMILIES, TRAIN_FAMILIES, draw_spec
from scenarios.load import load_scenario

Split = Literal["train", "val", "test"]
SPLITS: dict[Split, tuple[str, ...]] = {"train": TRAIN_FAMILIES, "val": TRAIN_FAMILIES, "test": TEST_FAMILIES}
DEFAULT_COUNTS: dict[Split, int] = {"train": 120, "val": 20, "test": 60}
FIRST_SEED: dict[Split, int] = {"train": 1_000_000, "val": 2_000_000, "test": 3_000_000}
DRAWS = 8  # a draw in which the expert cannot drive is replaced by the next


def write_scenes(folder: Path, split: Split, count: int, duration_s: float) -> Iterator[Path]:
    """Write ``count`` scenario files of a split, families in turn, and yield their paths; files that exist stay as they are.

    A scene is kept only if it loads: the expert must find a way through it.

    Raises:
        InputError: None of the draws of a scene can be driven.
    """
    families = SPLITS[split]
    (folder / split).mkdir(parents=True, exist_ok=True)
    for i in range(count):
        family = families[i % len(families)]
        path = folder / split / f"{family}_{i:03d}.yaml"
        if not path.exists():
            _write_drivable(path, family, f"{split}-{family}-{i:03d}", FIRST_SEED[split] + i * DRAWS, duration_s)
        yield path


def _write_drivable(path: Path, family: str, scene_id: str, first_seed: int, duration_s: float) -> None:
    last: SimrunError | None = None
    for draw in range(DRAWS):
        spec = draw_spec(family, scene_id, first_seed + draw, duration_s)
        text = yaml.safe_dump(spec, sort_keys=False)
        with tempfile.TemporaryDirectory() as scratch:
            candidate = Path(scratch) / path.name
            candidate.write_text(text, encoding="utf-8")
            try:
                load_scenario(candidate)
            except InputError as error:
                last = error
                continue
        write_text(path, text)
        return
    raise InputError(
        "drawing a training scene", f"{scene_id}, seeds {first_seed} to {first_seed + DRAWS - 1}",
        f"no draw can be driven; the last: {last}",
        f"change the family {family!r} in training/scene_families.py",
    )  # fmt: skip
