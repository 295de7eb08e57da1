"""References of training episodes: recorded frames warped as in deployment, with the errors that
real recordings have.

A sequence of pairs has its recorded frames (`training.reference_store`). A recorded video has no
depth: its own neighbouring frames stand for the recording, carried along by optical flow, which is
then bent by a smooth error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F32, F64, I64, U8, Bool
from alpasim_plugin.fixers.ground import carry
from alpasim_plugin.fixers.references import ReferenceIndex
from alpasim_plugin.fixers.warp import INCONSISTENT, VALID, RecordedImage, on_boxes
from alpasim_plugin.lab.training.pair_store import PairClip, PairSequence
from alpasim_plugin.lab.training.reference_store import SequenceReferences, open_references

COUNTS = (0.10, 0.15, 0.45, 0.30)  # chance of 0, 1, 2, 3 references
SLOTS = len(COUNTS) - 1
USUAL_REFERENCES = 2  # of a bundle's settings; the number is free
# The nearest ones are missing
P_SKIP = 0.25
MOST_SKIPPED = 2
# Spread of the error of a recorded frame's pose
P_MISPLACED = 0.35
SHIFT_M = 0.06
TURN_RAD = 0.004
# Spread of the logarithm of a channel's gain
P_EXPOSURE = 0.4
EXPOSURE = 0.08
P_WRONG = 0.04  # one of them is of another place
FLOW_FRAMES = (2, 10)  # of a video: how far away the frames are that stand for the recording
P_BENT = 0.7
BENT_PX = 2.0  # error of the flow
BENT_CELL_PX = 24  # over which it is smooth
# forward and backward flow agree within this: the neighbouring frame shows the same surface
CONSISTENT_PX = 1.0
# Kept in memory
OPEN_SEQUENCES = 100
PICTURES = 64


@dataclass(frozen=True, eq=False)
class ReferenceDraw:
    """What references the frames of an episode have.

    Attributes:
        count: How many.
        skipped: So many of the nearest are missing.
        errors: ``(SLOTS, 6)`` of the poses: shift in metres and axis-angle, in the camera's axes.
        gains: ``(SLOTS, 3)`` of the channels.
        wrong: Slot that shows another place; -1: none.
        seed: Of what is drawn for single frames.
    """

    count: int
    skipped: int
    errors: F64
    gains: F64
    wrong: int
    seed: int


def draw_references(rng: np.random.Generator) -> ReferenceDraw:
    """Draw the references of an episode."""
    count = int(rng.choice(len(COUNTS), p=COUNTS))
    skipped = int(rng.integers(1, MOST_SKIPPED + 1)) if rng.random() < P_SKIP else 0
    spread = np.repeat([SHIFT_M, TURN_RAD], 3) * (rng.random() < P_MISPLACED)
    errors = spread * rng.standard_normal((SLOTS, 6))
    gains = np.exp(EXPOSURE * (rng.random() < P_EXPOSURE) * rng.standard_normal((SLOTS, 3)))
    wrong = int(rng.integers(SLOTS)) if rng.random() < P_WRONG else -1
    return ReferenceDraw(count, skipped, errors, gains, wrong, int(rng.integers(2**31)))


def pair_references(
    sequence: PairSequence, draw: ReferenceDraw, index: I64, rows: slice, columns: slice
) -> U8:
    """Return the references of some frames of a sequence of pairs, cut to a crop: ``(T, SLOTS, h,
    w, 4)``; zero where there is none.
    """
    out = np.zeros(
        (len(index), SLOTS, rows.stop - rows.start, columns.stop - columns.start, 4), dtype=np.uint8
    )
    opened = _opened(sequence)
    if opened is None or not draw.count:
        return out
    references, recorded = opened
    K = _cropped(references.K, rows, columns)
    last: Sequence[int] = ()
    for t, i in enumerate(index):
        wanted = draw.skipped + draw.count
        t_us = int(references.t_us[i])
        last = recorded.choose(references.T_world_camera[i], t_us, wanted + 1, last)
        # A photograph is not its own reference
        chosen = [j for j in last if references.rgb_t_us[j] != t_us][:wanted]
        target = references.target(int(i), K, rows, columns)
        used = chosen[draw.skipped :]
        places = [
            (j + len(recorded.recorded) // 2) % len(recorded.recorded) if slot == draw.wrong else j
            for slot, j in enumerate(used)
        ]
        pictures = [
            _misplaced(_recorded_image(sequence, place), error)
            for place, error in zip(places, draw.errors, strict=False)
        ]
        for slot, carried in enumerate(carry(pictures, target, references.T_world_rig(int(i)))):
            out[t, slot] = carried
    return out


def road_users(sequence: PairSequence, index: I64, rows: slice, columns: slice) -> Bool:
    """Return which pixels of some frames of a sequence of pairs show road users, hidden ones among
    them: ``(T, h, w)``.
    """
    shape = rows.stop - rows.start, columns.stop - columns.start
    opened = _opened(sequence)
    if opened is None:
        return np.zeros((len(index), *shape), dtype=bool)
    references, _ = opened
    K = _cropped(references.K, rows, columns)
    return np.stack(
        [on_boxes(shape, references.target(int(i), K, rows, columns).placed.boxes) for i in index]
    )


def _cropped(K: F64, rows: slice, columns: slice) -> F64:
    out = K.copy()
    out[:2, 2] -= (columns.start, rows.start)
    return out


def video_references(
    clip: PairClip, draw: ReferenceDraw, index: I64, rows: slice, columns: slice
) -> U8:
    """Return the same for a recorded video, whose neighbouring frames stand for the recording."""
    out = np.zeros(
        (len(index), SLOTS, rows.stop - rows.start, columns.stop - columns.start, 4), dtype=np.uint8
    )
    rng = stream("training", draw.seed, "references.video")
    away = rng.integers(*FLOW_FRAMES, SLOTS) * rng.choice([-1, 1], SLOTS)
    size = clip.rgb_gt.shape[1:3]
    bent = [
        smooth_field(rng, size, BENT_PX * rng.random(dtype=np.float32))
        if rng.random() < P_BENT
        else None
        for _ in range(SLOTS)
    ]
    for t, i in enumerate(index):
        for slot in range(draw.count):
            j = int(i) + int(away[slot])
            if 0 <= j < len(clip):
                out[t, slot] = _carried(clip.rgb_gt[i], clip.rgb_gt[j], bent[slot])[rows, columns]
    return out


def _carried(target: U8, source: U8, bent: F32 | None) -> U8:
    """Carry frame ``source`` to ``target`` by optical flow (Kroeger et al., 2016, DIS)."""
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_FAST)  # type: ignore[attr-defined]
    grey = [
        cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY) for image in (target, source)
    ]
    forward = flow.calc(*grey, None)
    backward = flow.calc(*grey[::-1], None)
    height, width = grey[0].shape
    place = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float32)
    pixel = place + forward
    back = cv2.remap(
        backward, pixel[..., 0], pixel[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    agrees = np.linalg.norm(forward + back, axis=-1) < CONSISTENT_PX
    inside = (pixel >= 0).all(-1) & (pixel[..., 0] <= width - 1) & (pixel[..., 1] <= height - 1)
    pixel = pixel if bent is None else pixel + bent
    out = np.empty((height, width, 4), dtype=np.uint8)
    out[..., :3] = cv2.remap(
        np.ascontiguousarray(source),
        pixel[..., 0],
        pixel[..., 1],
        cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REPLICATE,
    )
    out[..., 3] = np.where(inside, np.where(agrees, VALID, INCONSISTENT), 0)
    return out


def smooth_field(rng: np.random.Generator, size: tuple[int, ...], spread_px: float) -> F32:
    """Draw a smooth field of shifts ``(H, W, 2)``, pixels."""
    height, width = size
    coarse = rng.standard_normal((height // BENT_CELL_PX + 2, width // BENT_CELL_PX + 2, 2)).astype(
        np.float32
    )
    smooth: F32 = np.float32(spread_px) * cv2.resize(
        coarse, (width, height), interpolation=cv2.INTER_CUBIC
    )
    return smooth


def _misplaced(picture: RecordedImage, error: F64) -> RecordedImage:
    if not error.any():
        return picture
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(error[3:])[0], error[:3]
    return replace(picture, T_world_camera=picture.T_world_camera @ T)


@lru_cache(maxsize=OPEN_SEQUENCES)
def _opened(sequence: PairSequence) -> tuple[SequenceReferences, ReferenceIndex] | None:
    references = open_references(sequence)
    return None if references is None else (references, references.index())


@lru_cache(maxsize=PICTURES)
def _recorded_image(sequence: PairSequence, i: int) -> RecordedImage:
    opened = _opened(sequence)
    assert opened is not None
    return opened[0].picture(i)
