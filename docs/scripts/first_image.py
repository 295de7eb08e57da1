"""Make docs/img/drive.gif of a run: one scene behind three renderers, with the plan in force drawn
into each image.

simrun --renderer clean,3dgs,onefixer --policy lane-camera --out RUN suites/first
python docs/scripts/first_image.py RUN hard-hard_brake
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from alpasim_plugin.core.geometry import interpolate, inverse, transform_points
from alpasim_plugin.core.types import U8
from alpasim_plugin.log import decode_image, read_asl
from evaluators.metrics.outcomes import event_words, first_failure

COLOURS = {"clean": (11, 107, 179), "3dgs": (194, 84, 10), "onefixer": (0, 128, 106)}
SIZE = (320, 180)
GAP_PX = 6
FRAMES = slice(1, 57, 2)
MS = 200
PALETTE = 96


def frames(folder: Path, name: str) -> list[U8]:
    """Return the frames of a rollout ``(H, W, 3)``, with its plans, its name and, from then on, its
    first failure.
    """
    log = read_asl(folder / "rollout.asl")
    colour = COLOURS[name]
    out = []
    failure = first_failure(json.loads((folder / "manifest.json").read_text()))
    camera = log.info["cameras"][0]
    scale = SIZE[0] / camera.width
    for image in log.images[FRAMES]:
        rgb = cv2.resize(decode_image(image.data, name), SIZE, interpolation=cv2.INTER_CUBIC)
        plan = [one for one in log.plans if one.now_us <= image.end_us][-1].trajectory
        steps = [np.linspace(0, 1, n) for n in (60, len(plan))]
        points = np.stack([np.interp(*steps, plan.xyz[:, k]) for k in range(3)], axis=1)
        T = interpolate(log.ego, [image.end_us])[0] @ inverse(log.T_rig_box) @ camera.T_rig_camera
        seen = transform_points(inverse(T), points)
        seen = seen[seen[:, 2] > 0.5]
        line = np.round(8 * scale * (seen / seen[:, 2:] @ camera.K.T)[:, :2]).astype(np.int32)
        for ink, width in (((255, 255, 255), 5), (colour, 3)):
            cv2.polylines(rgb, [line], False, ink, width, cv2.LINE_AA, 3)
        cv2.rectangle(rgb, (0, 0), (12 + 9 * len(name), 22), (255, 255, 255), -1)
        cv2.putText(rgb, name, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.48, colour, 1, cv2.LINE_AA)
        if failure is not None and image.end_us >= failure["t_us"]:
            cv2.rectangle(rgb, (0, SIZE[1] - 24), SIZE, (255, 255, 255), -1)
            cv2.putText(
                rgb,
                event_words(failure["metric"]),
                (6, SIZE[1] - 8),
                cv2.FONT_HERSHEY_SIMPLEX,
                0.48,
                colour,
                1,
                cv2.LINE_AA,
            )
        out.append(rgb)
    return out


def main(run: Path, scene: str) -> None:
    """Write the image."""
    panels = [
        frames(run / "rollouts" / name / "lane-camera" / scene / "0", name) for name in COLOURS
    ]
    gap = np.full((SIZE[1], GAP_PX, 3), 255, np.uint8)
    rows = [
        np.concatenate([one, gap, two, gap, three], axis=1)
        for one, two, three in zip(*panels, strict=False)
    ]
    images = [
        Image.fromarray(row).convert("P", palette=Image.Palette.ADAPTIVE, colors=PALETTE)
        for row in rows
    ]
    out = Path(__file__).parents[1] / "img" / "drive.gif"
    images[0].save(out, save_all=True, append_images=images[1:], duration=MS, loop=0, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
