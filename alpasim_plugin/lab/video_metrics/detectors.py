"""Detectors that the user gives as exported programs, and what they find in a video: TorchScript
(``.pt``), or ONNX (``.onnx``) with inputs named ``image`` and ``K`` and three outputs in this order.

``cuboid_detector.pt``: ``forward(image, K) -> (boxes, scores, labels)``
    image   ``(3, H, W)`` float32 RGB, 0 to 1, scaled to a focal length of 1266.42 px
    K       ``(3, 3)`` float32, pixels of that image
    boxes   ``(N, 7)`` float32: x, y, z of the middle, length, height, width, metres; yaw, radians.
            Camera axes: x right, y down, z forward; the length lies along (cos yaw, 0, -sin yaw)
    scores  ``(N,)`` float32, 0 to 1
    labels  ``(N,)`` int64; 0 to 4 are vehicles, as in nuScenes' order of PGD

``lane_detector.pt``: ``forward(image, K) -> (points, visible, scores)``
    image, K as above, not scaled
    points  ``(N, S, 3)`` float32 metres on the ground: x right, y forward, z up; y rises along S
    visible ``(N, S)`` float32, above 0 where a point is visible
    scores  ``(N,)`` float32, 0 to 1
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.core.errors import EvaluatorError, InputError
from alpasim_plugin.core.files import file_sha256
from alpasim_plugin.core.types import F32, F64, U8
from alpasim_plugin.lab.video_metrics.cuboids import FOCAL_PX, Boxes
from alpasim_plugin.lab.video_metrics.lanes import Lanes
from alpasim_plugin.lab.video_metrics.onnx_program import load_onnx
from alpasim_plugin.lab.video_metrics.torchscript import load_script

CUBOIDS = "cuboid_f1"
LANES = "lane_f1"
FILES = {CUBOIDS: "cuboid_detector.pt", LANES: "lane_detector.pt"}
ONNX = ".onnx"


def available_detectors(folder: Path | None) -> dict[str, str]:
    """Return the metrics whose detector is in a folder of weights, each with its SHA-256.

    Raises:
        InputError: A detector in both formats.
    """
    if folder is None:
        return {}
    paths = {name: _file(folder, name) for name in FILES}
    return {name: file_sha256(path) for name, path in paths.items() if path is not None}


def _file(folder: Path, name: str) -> Path | None:
    program = folder / FILES[name]
    paths = [path for path in (program, program.with_suffix(ONNX)) if path.is_file()]
    if len(paths) > 1:
        raise InputError(
            f"{folder}: {paths[0].name} and {paths[1].name}", "Leave one of them there."
        )
    return paths[0] if paths else None


def detect_boxes(video: U8, K: F64, folder: Path) -> Iterator[Boxes]:
    """Yield the boxes of every frame ``(T, H, W, 3)``; ``K`` ``(3, 3)`` is of its pixels.

    Raises:
        EvaluatorError: A detector that does not answer as this module says.
    """
    scale = FOCAL_PX / K[0, 0]
    scaled_K = np.diag([scale, scale, 1.0]) @ K
    for frame in video:
        large = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)
        boxes, scores, labels = _call(folder, CUBOIDS, large, scaled_K)
        count = len(boxes)
        _check("boxes", boxes, (count, 7))
        _check("scores", scores, (count,))
        _check("labels", labels, (count,))
        yield Boxes(boxes, scores, labels.astype(np.int64), scaled_K, large.shape[:2])


def detect_lanes(video: U8, K: F64, folder: Path) -> Iterator[Lanes]:
    """Yield the lanes of every frame ``(T, H, W, 3)``.

    Raises:
        EvaluatorError: A detector that does not answer as this module says.
    """
    for frame in video:
        points, visible, scores = _call(folder, LANES, frame, K)
        count, samples = points.shape[:2] if points.ndim == 3 else (0, 0)
        _check("points", points, (count, samples, 3))
        _check("visible", visible, (count, samples))
        _check("scores", scores, (count,))
        yield Lanes(points, visible > 0, scores)


def intrinsics_of(camera: object, clip: str) -> F64:
    """Return the matrix ``K`` ``(3, 3)`` of a clip's camera.

    Raises:
        InputError: The clip's ``sequence.json`` has none.
    """
    K = camera.get("K") if isinstance(camera, dict) else None
    if K is None or np.shape(K) != (3, 3):
        raise InputError(
            f"{clip}: its sequence.json has no pinhole camera, which the detectors need",
            f"measure pairs with a camera, or take {' and '.join(FILES.values())} out of --metric-weights",
        )
    return np.array(K, dtype=np.float64)


def _call(folder: Path, name: str, image: U8, K: F64) -> tuple[F64, ...]:
    path = _file(folder, name)
    if path is None:
        raise InputError(f"{folder}: no {FILES[name]}", HINT)
    levels = np.ascontiguousarray(np.moveaxis(image, -1, 0), dtype=np.float32) / np.float32(255)
    answer = _network(path)(levels, K.astype(np.float32))
    if len(answer) != 3:
        raise EvaluatorError(f"{path}: it did not return three tensors", HINT)
    return tuple(np.asarray(part, dtype=np.float64) for part in answer)


HINT = "export the detector as docs/lab/video-metrics.md says"


def _check(name: str, values: F64, shape: tuple[int, ...]) -> None:
    if values.shape != shape or not np.isfinite(values).all():
        problem = "not finite" if values.shape == shape else f"of shape {values.shape}, not {shape}"
        raise EvaluatorError(f"{name} of the detector: {problem}", HINT)


Program = Callable[[F32, F32], tuple[Any, ...]]


@cache
def _network(path: Path) -> Program:
    return load_onnx(path) if path.suffix == ONNX else _torchscript(path)


def _torchscript(path: Path) -> Program:
    program = load_script(path)

    def call(image: F32, K: F32) -> tuple[Any, ...]:
        with torch.inference_mode():
            answer = program(torch.from_numpy(image), torch.from_numpy(K))
        if not isinstance(answer, tuple) or not all(isinstance(part, Tensor) for part in answer):
            raise EvaluatorError(f"{path}: it did not return three tensors", HINT)
        return tuple(part.numpy() for part in answer)

    return call
