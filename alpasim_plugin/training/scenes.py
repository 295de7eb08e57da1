"""Write the scenarios of the splits train, val and test: disjoint by seed; test also by family."""

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
DRAWS = 8  # samples per scene: one that the expert cannot drive is rejected


def write_scenes(folder: Path, split: Split, count: int, duration_s: float) -> Iterator[Path]:
    """Write ``count`` scenario files of a split, families in rotation, and yield their paths; existing files are kept.

    Rejection sampling: a scene must load, which requires a feasible expert path.

    Raises:
        InputError: All samples of a scene are rejected.
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
        "sampling a training scene", f"{scene_id}, seeds {first_seed} to {first_seed + DRAWS - 1}",
        f"no sample can be driven; the last: {last}",
        f"change the family {family!r} in training/scene_families.py",
    )  # fmt: skip
