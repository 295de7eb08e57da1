"""Write the scenarios of the splits: disjoint by seed; the test of unseen families also by family,
look and damage.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import yaml

from alpasim_plugin.core.errors import InputError, SimrunError
from alpasim_plugin.core.files.atomic import write_text
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.lab.training.scene_draws import Spec
from alpasim_plugin.lab.training.scene_families import KNOWN_FAMILIES, Family
from alpasim_plugin.lab.training.scene_families_three import SIDE_FAMILIES, THREE_FAMILIES
from alpasim_plugin.lab.training.scene_families_unseen import UNSEEN_FAMILIES
from alpasim_plugin.lab.training.scene_looks import (
    KNOWN_DAMAGE,
    UNSEEN_DAMAGE,
    draw_camera,
    draw_damage,
    draw_rig,
    known_surroundings,
    unseen_surroundings,
)
from scenarios.load import load_scenario

Split = Literal[
    "train",
    "val",
    "test-known",
    "test-unseen",
    "beside-known",
    "beside-unseen",
    "three/train",
    "three/val",
    "three/test",
]
TEST_SPLITS: tuple[Split, ...] = ("test-known", "test-unseen")
# Tests of fixed distances from the recorded path.
BESIDE_SPLITS: tuple[Split, ...] = (
    "beside-known",
    "beside-unseen",
)
DRAWS = 8  # samples per scene: one that the expert cannot drive is rejected


@dataclass(frozen=True)
class SplitRecipe:
    """What a split is drawn from.

    Attributes:
        families: By name.
        first_seed: Of its first scene; scene i has the seeds from ``first_seed + i * DRAWS`` on.
        count: Scenes by default.
        duration_s: Length of every drive by default.
        unseen: Whether looks and damage are those that training never sees.
        own_cameras: Whether cameras are drawn; else all scenes have the default camera.
        three_cameras: Whether front, left and right cameras are drawn.
        cycles: Whether some scenes are cycle renders, which lie on the logged path.
    """

    families: Mapping[str, Family]
    first_seed: int
    count: int
    duration_s: float
    unseen: bool = False
    own_cameras: bool = False
    cycles: bool = True
    three_cameras: bool = False


SPLITS: Mapping[Split, SplitRecipe] = {
    "train": SplitRecipe(KNOWN_FAMILIES, 11_000_000, 408, 6.0, own_cameras=True),
    "val": SplitRecipe(KNOWN_FAMILIES, 12_000_000, 24, 6.0),
    "test-known": SplitRecipe(KNOWN_FAMILIES, 13_000_000, 30, 19.8),
    "test-unseen": SplitRecipe(UNSEEN_FAMILIES, 14_000_000, 30, 19.8, unseen=True),
    "beside-known": SplitRecipe(KNOWN_FAMILIES, 15_000_000, 12, 9.0, cycles=False),
    "beside-unseen": SplitRecipe(UNSEEN_FAMILIES, 16_000_000, 6, 9.0, unseen=True, cycles=False),
    "three/train": SplitRecipe(THREE_FAMILIES, 17_000_000, 240, 9.0, three_cameras=True),
    "three/val": SplitRecipe(THREE_FAMILIES, 18_000_000, 40, 9.0, three_cameras=True),
    "three/test": SplitRecipe(SIDE_FAMILIES, 19_000_000, 40, 9.0, three_cameras=True),
}


def draw_spec(split: Split, family: str, scene_id: str, seed: int, duration_s: float) -> Spec:
    """Return a scenario specification (docs/scenario-files.md).

    Args:
        split: Says from where looks, cameras and damage are drawn.
        family: One of the split's.
        scene_id: Name of the scene; part of the keys of the random streams.
        seed: Of the sample.
        duration_s: Length of the drive, seconds, which determines the road length.

    Raises:
        KeyError: The split has no such family.
    """
    recipe = SPLITS[split]
    rng, looks, damage = (
        stream(scene_id, seed, f"training.{part}")
        for part in (f"scene.{family}", "looks", "damage")
    )
    spec = recipe.families[family](rng, duration_s + 2.0)
    spec["road"].setdefault("heading_deg", round(float(rng.uniform(-180, 180)), 1))
    surroundings = unseen_surroundings(looks) if recipe.unseen else known_surroundings(looks)
    spec["environment"] = surroundings | spec.get("environment", {})
    if recipe.own_cameras:
        spec["cameras"] = [draw_camera(looks)]
    if recipe.three_cameras:
        spec["cameras"] = draw_rig(looks)
    kind = None if recipe.cycles else "reconstruction"
    ranges = (
        UNSEEN_DAMAGE[int(damage.integers(len(UNSEEN_DAMAGE)))] if recipe.unseen else KNOWN_DAMAGE
    )
    return {
        "version": 1,
        "scene_id": scene_id,
        "seed": seed,
        "tags": ["training", split, family],
        "timing": {"duration_us": round(duration_s * 1e6)},
        **spec,
        "degradation": draw_damage(damage, ranges, kind),
    }


def write_scenes(folder: Path, split: Split, count: int, duration_s: float) -> Iterator[Path]:
    """Write ``count`` scenario files of a split, families in rotation, and yield their paths;
    existing files are kept.

    Rejection sampling: a scene must load, which requires a feasible expert path.

    Raises:
        InputError: All samples of a scene are rejected.
    """
    families = tuple(SPLITS[split].families)
    (folder / split).mkdir(parents=True, exist_ok=True)
    for i in range(count):
        family = families[i % len(families)]
        path = folder / split / f"{family}_{i:03d}.yaml"
        if not path.exists():
            _write_drivable(
                path,
                split,
                family,
                f"{split.replace('/', '-')}-{family}-{i:03d}",
                SPLITS[split].first_seed + i * DRAWS,
                duration_s,
            )
        yield path


def _write_drivable(
    path: Path, split: Split, family: str, scene_id: str, first_seed: int, duration_s: float
) -> None:
    last: SimrunError | None = None
    for draw in range(DRAWS):
        text = yaml.safe_dump(
            draw_spec(split, family, scene_id, first_seed + draw, duration_s), sort_keys=False
        )
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
        f"{scene_id}, seeds {first_seed} to {first_seed + DRAWS - 1}: no sample can be driven; the last: {last}",
        f"change the family {family!r} in training/scene_families.py",
    )
