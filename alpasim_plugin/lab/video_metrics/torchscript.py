"""Networks of metrics that exist only as TorchScript programs. torch keeps reading them, though it
advises against writing new ones.
"""

from __future__ import annotations

from pathlib import Path

import torch

from alpasim_plugin.core.errors import InputError


def load_script(path: Path) -> torch.nn.Module:
    """Load a TorchScript program onto the CPU, for inference.

    Raises:
        InputError: Another or a damaged file.
    """
    try:
        program: torch.nn.Module = torch.jit.load(str(path), map_location="cpu")  # type: ignore[no-untyped-call]
    except (RuntimeError, ValueError) as error:
        raise InputError(
            f"{path}: no TorchScript program that torch {torch.__version__} can read",
            "give a file that torch.jit.save wrote",
        ) from error
    return program.eval()
