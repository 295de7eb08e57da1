"""Look at scenes of the transfer: PSNR and a picture of damaged frames, and of arms as they are on
a few frames of one scene.

python docs/scripts/transfer.py pairs PICTURE NUMBER...              test scenes by number: clean, degraded, opacity at five times
python docs/scripts/transfer.py arms PICTURE NUMBER --arms FOLDER    frames 45 to 68 of one test scene behind every arm, the last one shown
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import torch

from alpasim_plugin.core.image_metrics import psnr_db
from alpasim_plugin.core.parts import build, resolve
from alpasim_plugin.core.types import U8
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.lab.bench.paper import arms_in
from alpasim_plugin.lab.bench.quality import QualityClip, Variant, run_variant
from alpasim_plugin.lab.paper.transfer import COMPARED
from alpasim_plugin.lab.training.pair_store import Pair
from alpasim_plugin.lab.training.transfer_pairs import pair_frames
from alpasim_plugin.lab.training.transfer_scenes import HEIGHT, WIDTH, TransferScene, transfer_scene
from alpasim_plugin.lab.video_metrics.sheet import sheet

TIMES = (0, 24, 49, 74, 99)
FIRST, SETTLED, LAST = (
    40,
    45,
    69,
)  # frames of the arms: a history of five, then those that are measured


def frames_of(scene: TransferScene, wanted: Iterable[int]) -> list[Pair]:
    """Render only these frames of a scene."""
    camera = PinholeCamera.from_hfov(WIDTH, HEIGHT, np.radians(scene.hfov_deg))
    return list(pair_frames(scene, camera, 1, wanted))


def pairs(numbers: list[int]) -> U8:
    """Print PSNR and return the picture."""
    rows = []
    for number in numbers:
        scene = transfer_scene("test", number)
        found = frames_of(scene, TIMES)
        values = [f"{psnr_db(pair.rgb_input, pair.rgb_gt):.1f}" for pair in found]
        print(
            f"| `{scene.name}` | {scene.degradation.share:.3f} | {' | '.join(values)} |", flush=True
        )
        columns = [
            np.concatenate([p.rgb_gt, p.rgb_input, np.repeat(p.opacity[..., None], 3, axis=2)])
            for p in found
        ]
        rows.append(np.concatenate(columns, axis=1))
    return np.concatenate(rows)


def arms(number: int, folder: Path) -> U8:
    """Print PSNR of every arm and return the picture."""
    scene = transfer_scene("test", number)
    found = frames_of(scene, range(FIRST, LAST))
    stacked = {
        name: np.stack([getattr(pair, name) for pair in found])
        for name in ("rgb_input", "rgb_gt", "opacity", "sdmap")
    }
    clip = QualityClip(scene.name, {}, *stacked.values(), np.array([pair.t_us for pair in found]))
    shipped = [
        Variant(name, resolve("fixer", name, ())) for name in ("onefixer", "onefixer-dit-tiny")
    ]
    trained = {arm.label: arm for arm in arms_in(folder)}
    shown = {"clean": clip.truth[-1]}
    for arm in (Variant("3dgs"), *shipped, *(trained[name] for name in COMPARED)):
        fixer = (
            None
            if arm.spec is None
            else build(arm.spec, scene_id=scene.scene_id, seed=0, device="cpu", threads=1)
        )
        video = run_variant(clip, arm, fixer).video
        values = [psnr_db(a, b) for a, b in zip(video, clip.truth, strict=True)][SETTLED - FIRST :]
        print(f"{arm.label} {np.mean(values):.1f} dB", flush=True)
        shown[arm.label] = video[-1]
    names = list(shown)
    halves = [
        sheet({name: [shown[name]] for name in part}, [scene.name])
        for part in (names[:4], [names[0], *names[4:]])
    ]
    return np.concatenate(halves)


def main() -> None:
    """Look."""
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=("pairs", "arms"))
    parser.add_argument("picture", type=Path)
    parser.add_argument("numbers", type=int, nargs="+")
    parser.add_argument("--arms", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    image = (
        pairs(options.numbers)
        if options.what == "pairs"
        else arms(options.numbers[0], options.arms)
    )
    cv2.imwrite(str(options.picture), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    main()
