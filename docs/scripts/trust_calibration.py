"""How wrong is a picture where its trust map says that it was recorded, kept from the render, or
made up?

python docs/scripts/trust_calibration.py data/pairs --split val --fixer onefixer --frames 31

Prints a row for each class of cell: its share of the pictures, the root mean square error against
the truth (levels of 255) before and after the fixer, means over clips with their 95 % interval
(Student's t over clips).
"""

from __future__ import annotations

import argparse
from itertools import pairwise

import numpy as np

from alpasim_plugin.core.parts import build, resolve
from alpasim_plugin.core.parts.resolve import split_names
from alpasim_plugin.core.types import F64, TRUST_CELLS
from alpasim_plugin.fixers.refine import refine_frames
from alpasim_plugin.fixers.settings import FixerSettings
from alpasim_plugin.fixers.trust import CELL_PX, LEVELS, MOST_COLUMNS, trust_cells
from alpasim_plugin.lab.bench.quality import QualityClip, fixer_input
from alpasim_plugin.lab.bench.quality_run import quality_clip
from alpasim_plugin.lab.training.pair_store import PairDataset
from evaluators.statistics.intervals import t_interval

GUESSED, RECORDED = (
    (0, 1 / 16, 1 / 8, 1 / 4, 1),
    (0, 1 / 8, 1 / 2, 7 / 8, 1),
)  # borders of the classes


def cells_of(clip: QualityClip, name: str) -> F64:
    """Return a row a cell of a clip: recorded share, guessed share, mean square error before and
    after.
    """
    spec = resolve("fixer", name, ())
    assert isinstance(spec.settings, FixerSettings)
    rows, t = [], 0
    for block in refine_frames(
        fixer_input(clip, spec.settings),
        build(spec, scene_id=clip.name, seed=0, device="cpu", threads=1),
    ):
        for frame in block.fixed:
            if TRUST_CELLS in frame.facts:
                shares = trust_cells(str(frame.facts[TRUST_CELLS])).reshape(-1, 2) / LEVELS
                before, after = (
                    cell_errors(image, clip.truth[t]) for image in (clip.render[t], frame.rgb)
                )
                rows.append(np.column_stack([shares, before, after]))
            t += 1
    return np.concatenate(rows)


def cell_errors(image: np.ndarray, truth: np.ndarray) -> F64:
    """Return the mean square error of every cell ``(N,)``."""
    height, width = image.shape[:2]
    side = max(CELL_PX, -(-width // MOST_COLUMNS))
    error = np.square(image.astype(np.float64) - truth).mean(axis=2)
    return np.array(
        [
            error[y : y + side, x : x + side].mean()
            for y in range(0, height, side)
            for x in range(0, width, side)
        ]
    )


def classes(values: F64, borders: tuple[float, ...]) -> list[np.ndarray]:
    """Return which values lie in each class; the last one holds its upper border."""
    place = np.clip(np.searchsorted(borders, values, "right") - 1, 0, len(borders) - 2)
    return [place == k for k in range(len(borders) - 1)]


def asked_for(description: str | None, fixers: str) -> tuple[list[str], list[QualityClip]]:
    """Return the fixers and the first frames of the clips that the command line names."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data")
    parser.add_argument("--split", default="val")
    parser.add_argument("--fixer", default=fixers)
    parser.add_argument("--frames", type=int, default=31)
    asked = parser.parse_args()
    clips = [
        quality_clip(one).first(asked.frames)
        for one in PairDataset(asked.data, asked.split).sequences
    ]
    return split_names(asked.fixer), clips


def main() -> None:
    """Measure and print."""
    (name,), clips = asked_for(__doc__, "onefixer")
    found = [cells_of(clip, name) for clip in clips]
    for title, column, borders in (("made up", 1, GUESSED), ("recorded", 0, RECORDED)):
        print(f"| {title} | share of cells | error before | error after |\n|---|---:|---:|---:|")
        for k, (low, high) in enumerate(pairwise(borders)):
            here = [cells[classes(cells[:, column], borders)[k]] for cells in found]
            kept = [cells for cells in here if len(cells)]
            share = sum(map(len, here)) / sum(map(len, found))
            words = [
                words_of(np.array([np.sqrt(cells[:, at].mean()) for cells in kept]))
                for at in (2, 3)
            ]
            print(f"| {low:.3g} to {high:.3g} | {share:.1%} | {words[0]} | {words[1]} |")


def words_of(values: F64, digits: int = 1) -> str:
    """Return mean and half width of the interval."""
    if len(values) < 2:
        return "too few clips"
    high = t_interval(values, "clips").high
    return f"{values.mean():.{digits}f}" + (
        "" if high is None else f" ± {high - values.mean():.{digits}f}"
    )


if __name__ == "__main__":
    main()
