"""Devices by name: ``cpu``, ``cuda`` (the first card) or ``cuda:N``."""

from __future__ import annotations

import re

from alpasim_plugin.core.errors import InfrastructureError, InputError


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
