"""Which scenes the transfer beyond driving is trained and tested on: names, seeds, cameras and
damage; frozen before the first training.

``configs/fixers/transfer-scenes.json`` holds a digest of every scene's definition. As with driving
scenes, a definition is what is drawn; how it is built is the code's.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from alpasim_plugin.core.atomic import write_json
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.reading import read_json_as
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import Degradation
from alpasim_plugin.lab.training.frozen_scenes import FrozenEntry, FrozenSplit
from alpasim_plugin.lab.training.scene_draws import number
from alpasim_plugin.lab.training.scene_looks import KNOWN_DAMAGE, draw_damage

Split = Literal["train", "test"]
DOING = "choosing scenes of the transfer"
FAMILIES = ("room", "table", "path")  # of `alpasim_plugin.lab.interiors.places`, in rotation
RECORD = Path(__file__).parents[3] / "configs" / "fixers" / "transfer-scenes.json"
# The damage of driving scenes, but surfaces are a quarter as far away, so poses err by less.
DAMAGE = replace(KNOWN_DAMAGE, pose_error_m=(0.0, 0.015))
WIDTH, HEIGHT = 256, 144


@dataclass(frozen=True)
class SplitFacts:
    """What a split is: its scenes and their length.

    Attributes:
        first_seed: Of its first scene; scene i has ``first_seed + i``.
        count: Scenes.
        frames: Of every sequence, 0.1 s apart.
    """

    first_seed: int
    count: int
    frames: int


SPLITS: Mapping[Split, SplitFacts] = {
    "train": SplitFacts(21_000_000, 32, 61),
    "test": SplitFacts(22_000_000, 8, 100),
}


@dataclass(frozen=True)
class TransferScene:
    """The definition of a scene.

    Attributes:
        split, family, scene_id, seed: What it is; ``scene_id`` and ``seed`` are the key of its
            random streams.
        frames: Of its sequence, 0.1 s apart.
        hfov_deg: Of its camera, 256x144.
        degradation: How its reconstruction is damaged.
    """

    split: Split
    family: str
    scene_id: str
    seed: int
    frames: int
    hfov_deg: float
    degradation: Degradation

    @property
    def name(self) -> str:
        """Name of its sequence."""
        return self.scene_id.removeprefix(f"transfer-{self.split}-")

    @property
    def digest(self) -> str:
        """SHA-256 of the definition."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()


def transfer_scene(split: Split, number_in_split: int) -> TransferScene:
    """Return scene ``number_in_split`` of a split; families come in rotation."""
    facts, family = SPLITS[split], FAMILIES[number_in_split % len(FAMILIES)]
    scene_id, seed = (
        f"transfer-{split}-{family}_{number_in_split:03d}",
        facts.first_seed + number_in_split,
    )
    rng = stream(scene_id, seed, "transfer.scene")
    hfov_deg = number(rng, 58, 76, 1)
    drawn: dict[str, Any] = draw_damage(rng, DAMAGE)
    drawn.pop(
        "shift_m", None
    )  # a walk has no side to be shifted to: all are reconstructions of the walk itself
    return TransferScene(
        split,
        family,
        scene_id,
        seed,
        facts.frames,
        hfov_deg,
        Degradation(**{**drawn, "kind": "reconstruction"}),
    )


def frozen_split(split: Split) -> FrozenSplit:
    """Return the digests of a split's scenes."""
    scenes = {
        scene.name: scene.digest
        for scene in (transfer_scene(split, i) for i in range(SPLITS[split].count))
    }
    lines = "".join(f"{name} {digest}\n" for name, digest in scenes.items())
    return FrozenSplit(hashlib.sha256(lines.encode()).hexdigest(), scenes)


def freeze(record: Path = RECORD) -> None:
    """Write the digests of all splits.

    Raises:
        InputError: The record exists: what is frozen stays.
    """
    if record.exists():
        raise InputError(f"{record}: it exists", "remove it if the scenes are really to change")
    write_json(record, {split: asdict(frozen_split(split)) for split in SPLITS})


def check_frozen(record: Path = RECORD) -> None:
    """Check that the scenes are those that were frozen.

    Raises:
        InputError: A scene is defined otherwise now, or no readable record.
    """
    entries = read_json_as(dict[str, FrozenEntry], record, do_this="take the record of the package")
    for split in SPLITS:
        known, now = entries[split]["scenes"], frozen_split(split)
        if differ := sorted({name for name, _ in known.items() ^ now.scenes.items()}):
            raise InputError(
                f"{record}: {len(differ)} of split {split} are defined otherwise now: {', '.join(differ[:5])}",
                "undo the change of what is drawn, or freeze anew and measure everything again",
            )
