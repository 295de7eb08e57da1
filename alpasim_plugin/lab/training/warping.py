"""`warp-farneback`: what the temporal Harmonizer's prediction lacks of the motion of the clean
    frames.

    L = mean_k mean sqrt(d_k^2 + 1e-6),   d_k(p) = valid_k(p) (y_k(p) - x(p + F_k(p)))

``x`` is the prediction of the present frame, ``y_k`` the clean frame k before it, ``F_k`` the flow
from ``y_k`` to the present clean frame. The published recipe takes RAFT's flow; here it is
Farneback's, with the settings of the metric Warp L1, on the clean frames.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.core.devices import download, upload
from alpasim_plugin.core.types import F32

EPS = 1e-6


def flow_between(earlier: Tensor, present: Tensor) -> Tensor:
    """Estimate the flow from earlier frames to the present one, without gradients.

    Args:
        earlier: ``(B, 3, K, H, W)`` clean frames in [-1, 1].
        present: ``(B, 3, H, W)``.

    Returns:
        ``(B, K, H, W, 2)``: displacement (x, y), pixels, from a pixel of the earlier frame to its
        place in the present one; on the device of the frames.
    """
    clips = zip(_grey(earlier), _grey(present[:, :, None]), strict=True)
    flow = np.stack([[_farneback(frame, now) for frame in before] for before, (now,) in clips])
    return upload(flow, earlier.device)


def warping_loss(predicted: Tensor, earlier: Tensor, flow: Tensor) -> Tensor:
    """Return the mean Charbonnier error of the warped prediction against earlier clean frames.

    Args:
        predicted: ``(B, 3, H, W)`` the prediction of the present frame.
        earlier: ``(B, 3, K, H, W)`` clean frames.
        flow: From `flow_between`.
    """
    h, w = predicted.shape[-2:]
    columns, rows = np.meshgrid(np.arange(w), np.arange(h))
    place = flow + upload(np.stack([columns, rows], axis=-1), flow.device)
    size = upload(np.array([w - 1, h - 1]), flow.device)
    valid = ((place >= 0) & (place <= size)).all(dim=-1)
    errors = []
    for k in range(earlier.shape[2]):
        warped = F.grid_sample(
            predicted,
            2 * place[:, k] / size - 1,
            mode="bilinear",
            padding_mode="zeros",
            align_corners=True,
        )
        d = valid[:, k, None] * (earlier[:, :, k] - warped)
        errors.append(torch.sqrt(d.square() + EPS).mean())
    return torch.stack(errors).mean()


def _grey(frames: Tensor) -> list[list[np.ndarray]]:
    """Convert ``(B, 3, K, H, W)`` to B x K grey images, uint8."""
    levels = frames.detach().add(1).mul(127.5).round().clamp(0, 255).to(torch.uint8)
    (clips,) = download(levels.permute(0, 2, 3, 4, 1))
    return [[cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in clip] for clip in clips]


def _farneback(earlier: np.ndarray, present: np.ndarray) -> F32:
    return np.asarray(
        cv2.calcOpticalFlowFarneback(earlier, present, None, 0.5, 3, 21, 3, 5, 1.2, 0),
        dtype=np.float32,
    )
