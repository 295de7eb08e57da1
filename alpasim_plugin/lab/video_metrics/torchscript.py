"""Networks of metrics as TorchScript programs: what is published exists in no other form, and our own
detectors are exchanged for others in the same. torch keeps reading them, though it advises against
writing new ones.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import torch

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.atomic import atomic_file


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


def save_script(net: torch.nn.Module, path: Path) -> None:
    """Write a network as a TorchScript program, for inference."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        program = torch.jit.script(net.eval().requires_grad_(False))
        with atomic_file(path) as partial:
            program.save(os.fspath(partial))  # type: ignore[no-untyped-call]
