"""FVD's network: the TorchScript I3D of the StyleGAN-V protocol, from the user's weights; nothing
is bundled or downloaded.

The file is ``i3d_torchscript.pt``, called as ``net(video, rescale=True, resize=True,
return_features=True)``: uint8 values as floats in 0 to 255, scaled inside to [-1, 1] and to
224x224; the 400 logits are averaged over time. Distances on anything else are not called FVD.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64, U8
from alpasim_plugin.fixers.network.checkpoints import file_sha256

FILE = "i3d_torchscript.pt"
LOGITS = 400
LEAST_FRAMES = 10
DOING = "loading FVD's network"
PROBE = (1, 3, 16, 32, 32)


class VideoFeatures(Protocol):
    """A TorchScript I3D of the protocol's form."""

    def __call__(self, video: Tensor, rescale: bool, resize: bool, return_features: bool) -> Tensor:
        """Return ``(B, 400)`` for ``(B, 3, T, H, W)`` in 0 to 255."""
        ...


def load_i3d(folder: str | Path) -> tuple[VideoFeatures, str]:
    """Load the network from a folder of metric weights.

    Returns:
        The network and the SHA-256 of its file, which every table prints: no digest of the original
        is published.

    Raises:
        InputError: No such file, or a file of another form.
    """
    path = Path(folder) / FILE
    do = f"put the TorchScript I3D of the StyleGAN-V protocol there as {FILE} (docs/lab/judges.md)"
    if not path.is_file():
        raise InputError(f"{path}: no such file", do)
    try:
        net = torch.jit.load(str(path), map_location="cpu").eval()  # type: ignore[no-untyped-call]
        with torch.inference_mode():
            made = net(torch.zeros(PROBE), rescale=True, resize=True, return_features=True)
    except (RuntimeError, ValueError, TypeError) as error:
        raise InputError(
            f"{path}: not a network of this form: {str(error).splitlines()[-1].strip()[:120]}",
            do,
        ) from error
    if not isinstance(made, Tensor) or tuple(made.shape) != (1, LOGITS):
        found = (
            f"features of shape {tuple(made.shape)}"
            if isinstance(made, Tensor)
            else f"a {type(made).__name__}"
        )
        raise InputError(f"{path}: {found}, not (1, {LOGITS})", do)
    return net, file_sha256(path)


def i3d_features(net: VideoFeatures, video: U8, frames: int | None = None) -> F64:
    """Return a clip's feature vectors.

    Args:
        net: As `load_i3d` gives it.
        video: ``(T, H, W, 3)``, at least 10 frames.
        frames: None: one vector of the whole clip ``(1, 400)`` (the paper's ``fvd_clip``); a
            number: one for each whole window of so many frames (``fvd_16``).

    Raises:
        InputError: Fewer than 10 frames in a window.
    """
    length = len(video) if frames is None else frames
    if length < LEAST_FRAMES or len(video) < length:
        raise InputError(
            f"a clip: {len(video)} frames, windows of {length}",
            f"give at least {LEAST_FRAMES} frames a window",
        )
    rows = []
    with torch.inference_mode():
        for start in range(0, len(video) - length + 1, length):
            window = (
                torch.from_numpy(np.array(video[start : start + length]))
                .permute(3, 0, 1, 2)[None]
                .float()
            )
            rows.append(
                net(window, rescale=True, resize=True, return_features=True)[0].double().numpy()
            )
    return np.stack(rows)
