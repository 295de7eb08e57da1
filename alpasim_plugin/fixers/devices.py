"""Where a fixer computes."""

from __future__ import annotations

from typing import Any

import torch

from alpasim_plugin.core.errors import FixerError
from alpasim_plugin.nets.machine_probe import choose_threads


def require_device(device: str, doing: str) -> None:
    """Refuse a CUDA device on a machine without one.

    Raises:
        FixerError: torch sees no such device.
    """
    if device.split(":")[0] == "cuda" and not torch.cuda.is_available():
        raise FixerError(doing, f"device {device!r}", "torch sees no CUDA device", "use --device cpu")


def take_threads(threads: int | None) -> dict[str, Any]:
    """Set torch's threads to as many of the allowed ones as pay.

    Args:
        threads: That this process may use; None leaves their number.

    Returns:
        The choice with its measurements, under ``threads``, for a fixer's ``chosen``; empty where nothing was chosen.
    """
    if threads is None:
        return {}
    number = choose_threads(threads)
    torch.set_num_threads(number.number)
    return {"threads": number.as_dict()}
