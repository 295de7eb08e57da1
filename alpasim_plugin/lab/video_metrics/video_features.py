"""Feature vectors of videos for distances between sets of clips: I3D, with weights from the user,
and tracked motion.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64, U8
from alpasim_plugin.lab.video_metrics import fvmd
from alpasim_plugin.lab.video_metrics.i3d import FEWEST_FRAMES, load_i3d, video_tensor
from alpasim_plugin.lab.video_metrics.torchscript import load_script

POSITION_FRAMES = 93  # of a window of the curve over a clip
Features = Mapping[str, F64]  # name of a metric, and "@FIRST_FRAME" of a window, to (n, d)


@dataclass(frozen=True)
class PublishedI3D:
    """A file of weights of I3D.

    Attributes:
        file: Its name here.
        git_blob: Its SHA-1 as git counts it, with a header; what public copies are recorded by.
        is_script: Whether it is a TorchScript program, which resizes and scales by itself.
    """

    file: str
    git_blob: str
    is_script: bool


I3D_FILES = {
    "fvd": PublishedI3D("i3d_torchscript.pt", "93daef59c7ae0e9e8f76225521407e60cbafa6aa", True),
    "fvd_state_dict": PublishedI3D(
        "i3d_pretrained_400.pt", "a867b87ac3a9097d200598b1d48a1b890d8ec744", False
    ),
}
OPTIONS = {
    "i3d": "400 scores before the softmax, a clip in one pass; frames squeezed to 224x224, bilinear; covariance by n - 1",
    fvmd.NAME: "Lucas-Kanade tracks (21x21, 3 levels) in place of PIPs++; 16 frames every 25, JPEG 95, squeezed to 256x256, "
    "20x20 points; covariance by n - 1, no ridge",
}


def options(name: str) -> str:
    """Return how a metric is computed where its definition leaves a choice."""
    return OPTIONS[name if name in OPTIONS else "i3d"]


def available_i3d(folder: Path | None) -> dict[str, str]:
    """Return the metrics whose I3D is in a folder of weights, each with the digest that is asked
    of its file.
    """
    if folder is None:
        return {}
    return {name: i3d.git_blob for name, i3d in I3D_FILES.items() if (folder / i3d.file).is_file()}


def video_features(video: U8, folder: Path | None) -> Features:
    """Return the vectors of one video ``(T, H, W, 3)`` by metric; a metric that the video is too
    short for is left out.

    I3D gives one vector for the whole video, and, where the video has at least two of them, one for
    every window of 93 frames, under ``NAME@FIRST_FRAME``.

    Raises:
        InputError: Weights that are not the published ones.
        EvaluatorError: No stack of frames.
    """
    motion = fvmd.motion_features(video)
    features = {fvmd.NAME: motion} if len(motion) else {}
    if len(video) < FEWEST_FRAMES:
        return features
    for name in available_i3d(folder):
        assert folder is not None
        features[name] = i3d_vector(name, folder, video)
        windows = len(video) // POSITION_FRAMES
        for first in range(0, windows * POSITION_FRAMES if windows > 1 else 0, POSITION_FRAMES):
            window = video[first : first + POSITION_FRAMES]
            features[f"{name}@{first}"] = i3d_vector(name, folder, window)
    return features


def i3d_vector(name: str, folder: Path, video: U8) -> F64:
    """Return the scores ``(1, 400)`` of a video ``(T, H, W, 3)`` of at least nine frames."""
    net = _network(name, folder)
    frames = torch.from_numpy(np.array(video))
    with torch.inference_mode():
        if I3D_FILES[name].is_script:
            whole = frames.permute(3, 0, 1, 2)[None].float()  # (1, 3, T, H, W), 0 to 255
            scores = net(whole, rescale=True, resize=True, return_features=True)
        else:
            scores = net(video_tensor(frames))
    return np.asarray(scores.double().numpy())


@cache
def _network(name: str, folder: Path) -> torch.nn.Module:
    i3d = I3D_FILES[name]
    path = folder / i3d.file
    digest = git_blob(path)
    if digest != i3d.git_blob:
        raise InputError(
            f"{path}: git blob {digest}, not {i3d.git_blob}",
            "give the published file (docs/lab/video-metrics.md), or remove it to leave the metric out",
        )
    return load_script(path) if i3d.is_script else load_i3d(path)


def git_blob(path: Path) -> str:
    """Return the SHA-1 of a file with the header that git puts before it."""
    digest = hashlib.sha1(f"blob {path.stat().st_size}\0".encode(), usedforsecurity=False)
    with path.open("rb") as file:
        while piece := file.read(1 << 20):
            digest.update(piece)
    return digest.hexdigest()
