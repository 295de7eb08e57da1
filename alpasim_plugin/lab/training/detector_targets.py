"""What our own detectors should find in the clean frames of pairs, and batches of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F32, F64
from alpasim_plugin.lab.training.detector_nets import (
    COLUMN_M,
    COLUMNS,
    DEPTH_M,
    FIELDS,
    FOCAL_PX,
    HEIGHT_M,
    PITCH,
    ROW_M,
    SIZE_M,
    STRIDE,
)
from alpasim_plugin.lab.training.lane_lines import read_lanes
from alpasim_plugin.lab.training.pair_store import PairSequence
from alpasim_plugin.lab.training.reference_store import open_references
from alpasim_plugin.lab.video_metrics.cuboids import NEAREST_M, corners_of
from alpasim_plugin.lab.video_metrics.lanes import SAMPLES_M

LEAST_SIZE_M = (3.0, 1.0, 1.4)  # length, height, width of a vehicle
SMALLEST_PX = 3.0  # sides of its part inside the image
LEAST_VISIBLE = 0.3  # share of its pixels that nothing hides
DEPTH_SLACK_M = 1.0  # of the render's depth
SPREAD = 0.15  # of a score around a middle, as a share of the smaller side
GAIN = (0.8, 1.2)  # of the brightness


@dataclass(frozen=True)
class Frame:
    """A clean frame with what is to be found in it.

    Attributes:
        image: ``(3, H, W)`` float32, 0 to 1.
        K: ``(3, 3)`` pixels.
        boxes: ``(N, 7)``, camera axes, as a detector of vehicles returns them.
        lanes: ``(L, 29)`` lateral positions, metres, NaN where there are none.
    """

    image: F32
    K: F64
    boxes: F64
    lanes: F64

    def mirrored(self) -> Frame:
        """Return the frame as in a mirror."""
        K = self.K.copy()
        K[0, 2] = self.image.shape[2] - K[0, 2]
        boxes = self.boxes.copy()
        boxes[:, 0] *= -1
        boxes[:, 6] = np.pi - boxes[:, 6]
        return Frame(np.ascontiguousarray(self.image[:, :, ::-1]), K, boxes, -self.lanes)


def frame_of(sequence: PairSequence, index: int) -> Frame:
    """Return a clean frame of a sequence.

    Raises:
        InputError: The sequence has no lanes or no road users.
    """
    K = np.array(sequence.info["camera"]["K"], dtype=np.float64)
    levels = np.moveaxis(np.array(sequence.clip.rgb_gt[index]), -1, 0)
    image = np.asarray(levels / 255.0, dtype=np.float32)
    return Frame(image, K, _vehicles(sequence, index, K), _lanes(sequence.folder)[index])


@lru_cache(512)
def _lanes(folder: Path) -> list[F64]:
    return read_lanes(folder)


def _vehicles(sequence: PairSequence, index: int, K: F64) -> F64:
    """Return the boxes ``(N, 7)`` of the vehicles that a frame shows."""
    recorded = open_references(sequence)
    if recorded is None:
        raise InputError(
            f"{sequence.folder}: no road users", "Make the pairs of scenes that are rendered."
        )
    T_camera_world = inverse(recorded.T_world_camera[index])
    depth = recorded.depth[index].astype(np.float32)
    rows = []
    for T_world_box, (length, width, height) in zip(
        recorded.actors[index], recorded.boxes, strict=True
    ):
        size = np.array([length, height, width])
        if np.isnan(T_world_box[0, 0]) or np.any(size < LEAST_SIZE_M):
            continue
        T = T_camera_world @ T_world_box
        yaw = np.arctan2(-T[2, 0], T[0, 0])
        box = np.array([*T[:3, 3], *size, yaw])
        if is_visible(box, K, depth):
            rows.append(box)
    return np.array(rows).reshape(-1, 7)


def is_visible(box: F64, K: F64, depth: F32) -> bool:
    """Return whether a box ``(7,)`` is in an image, before the camera, and not hidden.

    Args:
        box: Camera axes.
        K: ``(3, 3)``.
        depth: ``(H, W)`` metres; 0 where nothing is near.
    """
    corners = corners_of(box)
    if corners[:, 2].min() < NEAREST_M:
        return False
    bounds = bounds_of(box, K, depth.shape)
    if min(bounds[2] - bounds[0], bounds[3] - bounds[1]) < SMALLEST_PX:
        return False
    pixels = corners @ K.T
    outline = cv2.convexHull(np.rint(pixels[:, :2] / pixels[:, 2:]).astype(np.int32))
    canvas = np.zeros(depth.shape, dtype=np.uint8)
    cv2.fillConvexPoly(canvas, outline, 1)
    covered = depth[canvas.astype(bool)]
    hidden = (covered > 0) & (covered < corners[:, 2].min() - DEPTH_SLACK_M)
    return covered.size > 0 and float(np.mean(~hidden)) >= LEAST_VISIBLE


def bounds_of(box: F64, K: F64, size: tuple[int, ...]) -> F64:
    """Return left, top, right and bottom of a box's part inside an image, pixels."""
    pixels = corners_of(box) @ K.T
    points = pixels[:, :2] / pixels[:, 2:]
    limit = np.array([size[1], size[0]], dtype=np.float64)
    return np.concatenate([points.min(axis=0).clip(0, limit), points.max(axis=0).clip(0, limit)])


def box_cells(frame: Frame) -> F32:
    """Return what `CuboidNet.cells` should say ``(10, H/4, W/4)``; the last channel is 1 in the cells
    of boxes.
    """
    height, width = (side // STRIDE for side in frame.image.shape[1:])
    cells = np.zeros((FIELDS, height, width), dtype=np.float32)
    rows, columns = np.mgrid[0:height, 0:width]
    far_first = frame.boxes[np.argsort(-frame.boxes[:, 2])] if len(frame.boxes) else frame.boxes
    for box in far_first:
        bounds = bounds_of(box, frame.K, frame.image.shape[1:]) / STRIDE
        middle = (bounds[:2] + bounds[2:]) / 2
        column, row = np.minimum(middle.astype(int), [width - 1, height - 1])
        spread = max(SPREAD * float(min(bounds[2:] - bounds[:2])), 0.7)
        near = np.exp(-((columns - column) ** 2 + (rows - row) ** 2) / (2 * spread**2))
        cells[0] = np.maximum(cells[0], near)
        u, v = (frame.K @ box[:3])[:2] / box[2]
        turn = 2 * (box[6] - np.arctan2(box[0], box[2]))
        values = [u / STRIDE - column - 0.5, v / STRIDE - row - 0.5, np.log(box[2] / DEPTH_M)]
        cells[1:4, row, column] = values
        cells[4:7, row, column] = np.log(box[3:6] / SIZE_M)
        cells[7:, row, column] = (np.sin(turn), np.cos(turn), 1.0)
    return cells


def lane_cells(frame: Frame) -> F32:
    """Return what `LaneNet.cells` should say ``(4, 29, 49)``; the last channel is 1 in the cells of
    lines.
    """
    rows = len(SAMPLES_M)
    cells = np.zeros((4, rows, COLUMNS), dtype=np.float32)
    columns = np.arange(COLUMNS) - COLUMNS // 2
    for lane in frame.lanes:
        slopes = np.gradient(lane, ROW_M)
        for row in np.flatnonzero(~np.isnan(lane)):
            place = lane[row] / COLUMN_M
            column = int(np.rint(place)) + COLUMNS // 2
            if not 0 <= column < COLUMNS:
                continue
            cells[0, row] = np.maximum(cells[0, row], np.exp(-((columns - place) ** 2) / 2))
            cells[0, row, column] = 1.0
            slope = 0.0 if np.isnan(slopes[row]) else slopes[row]
            cells[1:, row, column] = (place - np.rint(place), slope, 1.0)
    return cells


class FrameBatches:
    """Batches of clean frames, each drawn by its number.

    Args:
        sequences: Of `usual_sequences`.
        count: Frames of a batch.
        seed: Of the draws.

    Raises:
        InputError: No sequences.
    """

    def __init__(self, sequences: Sequence[PairSequence], count: int, seed: int) -> None:
        if not sequences:
            raise InputError("the pairs: no finished sequence", "Run 'simrun train pairs' first.")
        self.sequences, self.count, self.seed = sequences, count, seed

    def __getitem__(self, index: int) -> list[Frame]:
        """Draw batch ``index``: frames, mirrored in half of the cases, brighter or darker."""
        rng = stream("training", self.seed, "detectors.frames", index)
        frames = []
        for _ in range(self.count):
            sequence = self.sequences[int(rng.integers(len(self.sequences)))]
            frame = frame_of(sequence, int(rng.integers(len(sequence.clip))))
            if rng.random() < 0.5:
                frame = frame.mirrored()
            image = np.clip(frame.image * np.float32(rng.uniform(*GAIN)), 0.0, 1.0)
            frames.append(Frame(image, frame.K, frame.boxes, frame.lanes))
        return frames


def mounting(sequence: PairSequence) -> tuple[float, float, float]:
    """Return the focal length of a sequence's camera, pixels, its height over the ground, metres, and
    by how much it looks down, radians.
    """
    camera = sequence.info["camera"]
    T_rig_camera = np.array(camera["T_rig_camera"])
    return (
        float(camera["K"][0][0]),
        float(T_rig_camera[2, 3]),
        float(np.arcsin(-T_rig_camera[2, 2])),
    )


def usual_sequences(sequences: Sequence[PairSequence]) -> list[PairSequence]:
    """Return the sequences with the camera that the networks are for: that of the test scenes.

    Raises:
        InputError: None has it.
    """
    usual = (FOCAL_PX, HEIGHT_M, PITCH)
    chosen = [item for item in sequences if np.allclose(mounting(item), usual, rtol=0.01)]
    if not chosen:
        raise InputError(
            f"the pairs: {len(sequences)} sequences, none with the camera of the test scenes",
            "Make pairs of more drawn scenes.",
        )
    return chosen


def stacked(frames: Sequence[Frame], cells: Sequence[F32]) -> tuple[Tensor, Tensor, Tensor]:
    """Return images ``(B, 3, H, W)``, the cells that belong to them, and ``K`` of the first."""
    images = torch.from_numpy(np.stack([frame.image for frame in frames]))
    wanted = torch.from_numpy(np.stack(cells))
    return images, wanted, torch.from_numpy(frames[0].K).float()
