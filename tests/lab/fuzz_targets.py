"""The laboratory's readers, for the fuzzer of `tests.fuzz`, and an input that once failed."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzz.seen import Make
from tests.fuzz.uses import Target


def toy_training(folder: Path) -> Any:
    """Return a trainer of one small layer, four updates long, that continues what the folder
    holds.
    """
    import torch

    from alpasim_plugin.lab.training.trainer import Schedule, Trainer

    torch.manual_seed(0)
    net = torch.nn.Linear(2, 2)
    return Trainer(
        net,
        folder,
        Schedule(4, 1e-3, 0),
        lambda i: torch.ones(1, 2) * i,
        lambda x, i: (net(x).square().mean(), {}),
        {"toy": 1},
    )


def make_training_run(folder: Path) -> None:
    toy_training(folder / "run").run(until=2)


def use_training_run(folder: Path) -> None:
    assert toy_training(folder / "run").step >= 0


def make_pairs(folder: Path) -> None:
    from tests.lab.training.pair_files import make

    make(folder, frames=2, height=8, width=8)


def use_pairs(folder: Path) -> None:
    from alpasim_plugin.lab.training.pair_store import PairDataset

    for sequence in PairDataset(folder, "train").sequences:
        clip = sequence.clip
        assert len(np.asarray(clip.t_us)) == len(clip) > 0


def pairs_header(shape: tuple[int, ...]) -> Make:
    def make(folder: Path) -> list[str]:
        sequence = folder / "pairs" / "train" / "one"
        sequence.mkdir(parents=True)
        (sequence / "sequence.json").write_text("{}")
        for name, axes, dtype in (
            ("rgb_input", 4, "|u1"),
            ("rgb_gt", 4, "|u1"),
            ("opacity", 3, "|u1"),
            ("sdmap", 4, "|u1"),
            ("T_world_camera", 3, "<f8"),
            ("t_us", 1, "<i8"),
        ):
            head = (
                f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape[:axes]!r}, }}".ljust(
                    117
                )
                + "\n"
            )
            (sequence / f"{name}.npy").write_bytes(
                b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode() + b"\0" * 64
            )
        return [
            "train",
            "per-frame",
            str(folder / "pairs"),
            "--out",
            str(folder / "run"),
            "--steps",
            "1",
        ]

    return make


TARGETS = (
    Target("training run", make_training_run, use_training_run),
    Target("pairs", make_pairs, use_pairs),
)
SEEN = {"pairs of 999999999999 frames": pairs_header((999_999_999_999, 8, 8, 3))}
