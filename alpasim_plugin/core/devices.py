"""Devices by name: ``cpu``, ``cuda`` (the first card) or ``cuda:N``."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from alpasim_plugin.core.errors import InfrastructureError, InputError

if TYPE_CHECKING:
    from torch import Tensor


def check_device_name(name: str) -> str:
    """Return a device's name.

    Raises:
        InputError: Neither ``cpu``, ``cuda`` nor ``cuda:N``.
    """
    if re.fullmatch(r"cpu|cuda(:[0-9]{1,3})?", name) is None:
        raise InputError(f"--device {name}: no such device", "Use cpu, cuda or cuda:N")
    return name


def require_device(name: str) -> str:
    """Return a device's full name, ``cpu`` or ``cuda:N``; nothing falls back to another device.

    Raises:
        InputError: Neither ``cpu``, ``cuda`` nor ``cuda:N``.
        InfrastructureError: torch sees no such card.
    """
    if check_device_name(name) == "cpu":
        return name
    import torch

    number = int(name.partition(":")[2] or 0)
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if number >= count:
        raise InfrastructureError(
            f"--device {name}: torch {torch.__version__} sees {count} CUDA devices",
            "Install torch with CUDA on a machine with an NVIDIA GPU, or choose --device cpu",
        )
    # Float32 is float32: neither products nor convolutions round to TF32.
    torch.backends.cuda.matmul.allow_tf32 = False
    torch.backends.cudnn.allow_tf32 = False
    return f"cuda:{number}"


def download(*parts: Tensor) -> list[Any]:
    """Return tensors as arrays, brought to the host in one copy: each copy waits for the device."""
    import torch

    data = torch.cat([part.contiguous().view(-1).view(torch.uint8) for part in parts])
    pieces = torch.split(data.cpu(), [part.nbytes for part in parts])
    return [
        piece.clone().view(part.dtype).view(part.shape).numpy()
        for piece, part in zip(pieces, parts, strict=True)
    ]


def known_false(mask: Tensor) -> bool:
    """Return whether a mask is false everywhere, where that is known without waiting for a
    device.
    """
    return mask.device.type == "cpu" and not bool(mask.any())
