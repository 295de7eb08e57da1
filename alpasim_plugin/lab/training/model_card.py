"""Model cards: training data, schedule, command and machine of a file of weights."""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from alpasim_plugin.core.files import read_json_lines
from alpasim_plugin.core.files.atomic import write_json
from alpasim_plugin.lab.training.trainer import CORE_S


@dataclass(frozen=True)
class ModelCard:
    """Model card of ``NAME.safetensors``, written as ``NAME.card.json``.

    Args:
        what: One sentence.
        data: Training data.
        training: Steps, batch, schedule, seed, starting point.
        curves: Logged values at some updates, first and last included.
        hours: Wall-clock time of the training.
    """

    what: str
    data: Mapping[str, Any]
    training: Mapping[str, Any]
    curves: list[Mapping[str, float]]
    hours: float

    def write(self, weights: Path) -> Path:
        """Write the card next to the weights, with their digest, the machine and the command
        line.
        """
        path = weights.with_suffix(".card.json")
        card = {
            **asdict(self),
            "weights": weights.name,
            "sha256": hashlib.sha256(weights.read_bytes()).hexdigest(),
            "bytes": weights.stat().st_size,
            "command": command(),
            "machine": machine(),
        }
        write_json(path, card)
        return path


def command() -> str:
    """Return the command line of this process."""
    return shlex.join(["simrun", *sys.argv[1:]])


def machine() -> dict[str, Any]:
    """Return processor, GPU and torch version."""
    flags = torch.backends.cpu.get_cpu_capability()
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return {
        "cpu": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "vectors": flags,
        "gpu": gpu,
        "torch": torch.__version__,
    }


def curves(log: Path, points: int = 25) -> tuple[list[Mapping[str, float]], float]:
    """Return means of a `Trainer` log over ``points`` equal intervals, and the total hours of its
    updates.

    Returns:
        Rows with ``step`` (the last of the interval) and the means of all values; hours.
    """
    rows = read_json_lines(log)
    size = max(len(rows) // points, 1)
    parts = [rows[i : i + size] for i in range(0, len(rows), size)]
    out: list[Mapping[str, float]] = []
    for part in parts:
        keys = [
            key
            for key in part[-1]
            if key not in ("step", "s", CORE_S) and all(key in row for row in part)
        ]
        out.append(
            {
                "step": part[-1]["step"],
                **{key: float(f"{sum(row[key] for row in part) / len(part):.5g}") for key in keys},
            }
        )
    return out, sum(row.get("s", 0.0) for row in rows) / 3600
