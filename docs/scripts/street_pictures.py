"""Look at an imported drive: held-out photographs beside what renderers show there, and what they
show beside the path.

python docs/scripts/street_pictures.py street/scenario.yaml PICTURE --renderer 3dgs,onefixer --rows
2 --beside 1

One row for each of some held-out photographs: the photograph, then every renderer. Then as many
rows from that many metres to the left of the same places, where nobody took a photograph. Renderers
see all photographs' poses in order of time, so a fixer has its history.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from alpasim_plugin.core.parts import resolve_renderer, split_names
from alpasim_plugin.core.types import U8
from alpasim_plugin.lab.bench.real import Shot, request_of, shots_of
from alpasim_plugin.lab.video_metrics.sheet import sheet
from alpasim_plugin.runs.cell import make_renderer
from scenarios.load import load_scenario

WIDTH = 512


def shifted(shot: Shot, left_m: float) -> Shot:
    """Return a shot from this far to the left, with nothing that was photographed there."""
    T = shot.photograph.T_world_camera.copy()
    T[:3, 3] -= left_m * T[:3, 0]  # OpenCV axes: x points right
    return replace(
        shot, photograph=replace(shot.photograph, T_world_camera=T), rgb=np.full_like(shot.rgb, 90)
    )


def fitted_to(rgb: U8) -> U8:
    """Scale a picture to the sheet's width."""
    return np.asarray(
        cv2.resize(
            rgb, (WIDTH, round(rgb.shape[0] * WIDTH / rgb.shape[1])), interpolation=cv2.INTER_AREA
        ),
        np.uint8,
    )


def main() -> None:
    """Render and write the picture."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenario")
    parser.add_argument("picture", type=Path)
    parser.add_argument("--renderer", default="3dgs,onefixer")
    parser.add_argument("--rows", type=int, default=2)
    parser.add_argument("--beside", type=float, default=1.0, help="metres to the left")
    asked = parser.parse_args()
    scenario = load_scenario(asked.scenario)
    shots = next(iter(shots_of(scenario).values()))
    unseen = [i for i, shot in enumerate(shots) if shot.photograph.use != "fitted"]
    chosen = [unseen[round(k)] for k in np.linspace(0, len(unseen) - 1, asked.rows + 2)[1:-1]]
    beside = [shifted(shot, asked.beside) for shot in shots]
    columns = {
        "photograph": [fitted_to(shots_[i].rgb) for shots_ in (shots, beside) for i in chosen]
    }
    for name in split_names(asked.renderer):
        columns[name] = []
        for taken in (shots, beside):
            renderer = make_renderer(
                resolve_renderer(name), scenario, 0, device="cpu", threads=None
            )
            frames = [
                renderer.render(request_of(scenario, shot)).rgb for shot in taken[: max(chosen) + 1]
            ]
            columns[name] += [fitted_to(frames[i]) for i in chosen]
    rows = [f"held out {i}" for i in chosen] + [
        f"{asked.beside:g} m to the left of {i}" for i in chosen
    ]
    cv2.imwrite(str(asked.picture), sheet(columns, rows)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main()
