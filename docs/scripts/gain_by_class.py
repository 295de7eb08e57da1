"""What does a fixer gain on the ground, on structures, on road users and in the sky, and does it
speckle in flat places?

python docs/scripts/gain_by_class.py data/pairs --split val --fixer
"onefixer[references=0],onefixer" --frames 31

Prints a row for each class of pixel: its share of the pictures, PSNR of the render, and of each
fixer minus that, means over clips with their 95 % interval (Student's t over clips). Classes come
from the render's own depth: *road user* is a pixel whose ray meets the box of one, *sky and holes*
have no depth, *ground* lies within `GROUND_M` of the plane below the rig, and *structures*
(facades, trees, poles, walls) are all else. The last table is the speckle: the root mean square of
what changes from one frame to the next where the truth is flat, divided by that of the truth.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from trust_calibration import asked_for, words_of

from alpasim_plugin.core.parts import build, resolve
from alpasim_plugin.core.parts.resolve import split_settings
from alpasim_plugin.core.types import F64, U8, Bool
from alpasim_plugin.fixers.refine import refine_frames
from alpasim_plugin.fixers.settings import FixerSettings
from alpasim_plugin.fixers.warp import on_boxes, plain_points
from alpasim_plugin.lab.bench.quality import QualityClip, fixer_input

CLASSES = ("ground", "structures", "road users", "sky and holes")
GROUND_M = 0.3  # a point that is higher above the plane below the rig, or lower, is not the ground
# grey levels: the standard deviation in a window of 5 x 5 pixels of the truth below which a place
# is flat
FLAT = 2.0
LEAST_PIXELS = 200  # of a class in a clip; with fewer it counts for nothing there


def classes(clip: QualityClip) -> Iterator[U8]:
    """Yield the class of every pixel ``(H, W)`` of each frame, by place in `CLASSES`."""
    recorded = clip.recorded
    if recorded is None:
        raise SystemExit(f"{clip.name} has no depth: it was made without references")
    whole = slice(None)
    for i in range(len(clip.t_us)):
        view = recorded.target(i, recorded.K, whole, whole)
        T_world_rig = recorded.T_world_rig(i)
        height_m = (
            plain_points(view.depth, view.K, view.T_world_camera) - T_world_rig[:3, 3]
        ) @ T_world_rig[:3, 2]
        out = np.where(np.abs(height_m) <= GROUND_M, 0, 1).astype(np.uint8)
        out[view.depth <= 0] = 3
        out[on_boxes(view.depth.shape, view.placed.seen)] = 2
        yield out


def videos(clip: QualityClip, names: list[str]) -> Iterator[U8]:
    """Yield the clip as the render shows it, then behind each fixer ``(T, H, W, 3)``."""
    yield np.asarray(clip.render)
    for name in names:
        plain, settings = split_settings(name)
        spec = resolve("fixer", plain, settings)
        assert isinstance(spec.settings, FixerSettings)
        session = build(spec, scene_id=clip.name, seed=0, device="cpu", threads=1)
        blocks = refine_frames(fixer_input(clip, spec.settings), session)
        yield np.stack([frame.rgb for block in blocks for frame in block.fixed])


def flat_places(truth: U8) -> Bool:
    """Return where the truth is flat ``(T, H, W)``."""
    flat = []
    for image in truth:
        grey = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY).astype(np.float32)
        mean, square = (cv2.boxFilter(x, -1, (5, 5)) for x in (grey, grey * grey))
        flat.append(square - mean * mean < FLAT**2)
    return np.stack(flat)


def restlessness(video: U8, where: Bool) -> float:
    """Return the root mean square of the differences between frames, grey levels, where both are
    flat.
    """
    apart = np.diff(video.astype(np.float64).mean(axis=-1), axis=0)
    return float(np.sqrt(np.square(apart[where[1:] & where[:-1]]).mean()))


def main() -> None:
    """Measure and print."""
    names, clips = asked_for(__doc__, "onefixer[references=0],onefixer")
    shares = np.zeros((len(clips), len(CLASSES)))
    error = np.full((len(clips), 1 + len(names), len(CLASSES)), np.nan)
    speckle = np.zeros((len(clips), 1 + len(names)))
    for i, clip in enumerate(clips):
        place, truth = np.stack(list(classes(clip))), np.asarray(clip.truth)
        flat = flat_places(truth)
        shares[i] = [np.mean(place == k) for k in range(len(CLASSES))]
        for n, video in enumerate(videos(clip, names)):
            apart = np.square(video.astype(np.float64) - truth).mean(axis=-1)
            error[i, n] = [
                apart[place == k].mean() if (place == k).sum() >= LEAST_PIXELS else np.nan
                for k in range(len(CLASSES))
            ]
            speckle[i, n] = restlessness(video, flat) / restlessness(truth, flat)
    print(
        f"| pixels | share | 3dgs, dB | {' | '.join(names)} |\n|---|---:|---:|{'---:|' * len(names)}"
    )
    for k, word in enumerate(CLASSES):
        known = ~np.isnan(error[:, 0, k])
        psnr: F64 = 10 * np.log10(255.0**2 / error[known, :, k])
        gains = [words_of(psnr[:, 1 + n] - psnr[:, 0], 2) for n in range(len(names))]
        print(
            f"| {word} | {shares[:, k].mean():.0%} | {psnr[:, 0].mean():.2f} | {' | '.join(gains)} |"
        )
    print(
        f"\n| speckle, truth is 1 | 3dgs | {' | '.join(names)} |\n|---|{'---:|' * (1 + len(names))}"
    )
    print(
        f"| flat places | {' | '.join(words_of(speckle[:, n], 2) for n in range(1 + len(names)))} |"
    )


if __name__ == "__main__":
    main()
