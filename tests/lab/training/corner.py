"""One small scene of nothing but a road, with the pairs of its few frames."""

from __future__ import annotations

from pathlib import Path

from alpasim_plugin.lab.training.pairs import PairRecipe, make_sequence
from alpasim_plugin.renderers.gaussian import clear_cache
from scenarios.load import load_scenario

SCENE = """
version: 1
scene_id: corner
road: {{segments: [{{kind: straight, length_m: 90}}]}}
ego: {{speed_mps: 10}}
environment: {{buildings: 0, trees_per_100m: 0, poles_spacing_m: 20, texture: 0}}
cameras: [{{name: front, width: 48, height: 32}}]
timing: {{duration_us: {duration_us}, warmup_us: 100_000}}
"""


def make_corner(scenes: Path, pairs: Path, split: str, duration_us: int) -> Path:
    """Write the scene and its pairs, whose input is the clean render, below their folders; return
    the folder of the pairs.
    """
    path, folder = scenes / split / "corner.yaml", pairs / split / "corner"
    path.parent.mkdir(parents=True)
    path.write_text(SCENE.format(duration_us=duration_us))
    assert make_sequence(
        load_scenario(path),
        folder,
        PairRecipe(source="clean", max_offset_m=0.0),
        0,
        split=split,
        family="street",
    )
    clear_cache()
    return folder
