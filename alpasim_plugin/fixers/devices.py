"""Where a fixer computes."""

from __future__ import annotations

import torch

from alpasim_plugin.errors import FixerError


def require_device(device: str, doing: str) -> None:
    """Refuse a CUDA device on a machine without one.

    Raises:
        FixerError: torch sees no such device.
    """
    if device.split(":")[0] == "cuda" and not torch.cuda.is_available():
        raise FixerError(doing, f"device {device!r}", "torch sees no CUDA device", "use --device cpu")
