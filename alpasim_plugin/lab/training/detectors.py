"""Train our own detectors on the clean frames of drawn scenes, export them, and measure how far they
are right there.

    OUT/cuboids/, OUT/lanes/    state.safetensors, log.jsonl: the same call resumes
    OUT/cuboid_detector.pt, OUT/lane_detector.pt    TorchScript programs, see `lab.video_metrics.detectors`
    OUT/detectors.json          precision and recall on other clean frames, and what they were trained on
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.random import fork_rng

from alpasim_plugin.core.devices import require_device
from alpasim_plugin.core.files.atomic import write_json
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.lab.training.detector_nets import HEIGHT_M, PITCH, CuboidNet, LaneNet
from alpasim_plugin.lab.training.detector_targets import (
    Frame,
    FrameBatches,
    box_cells,
    frame_of,
    lane_cells,
    stacked,
    usual_sequences,
)
from alpasim_plugin.lab.training.pair_store import PairDataset, PairSequence, pairs_digest
from alpasim_plugin.lab.training.trainer import Loss, Schedule, Trainer
from alpasim_plugin.lab.video_metrics.cuboids import drawn_vehicles, overlap
from alpasim_plugin.lab.video_metrics.detectors import (
    CUBOIDS,
    FILES,
    LANES,
    detect_boxes,
    detect_lanes,
)
from alpasim_plugin.lab.video_metrics.lanes import lane_matches, lanes_at
from alpasim_plugin.lab.video_metrics.torchscript import save_script

RECORD_FILE = "detectors.json"
FRAMES = 8  # of a batch
FOCUS = 4.0  # exponent by which cells near a middle count less as wrong ones
FRAMES_MEASURED = 8  # of every sequence, evenly chosen
Report = Callable[[str, int, Mapping[str, float]], None]
Batch = tuple[Tensor, Tensor, Tensor]


class _Task:
    """Batches and loss of one network, for `Trainer`."""

    def __init__(
        self,
        net: CuboidNet | LaneNet,
        frames: FrameBatches,
        wanted: Callable[[Frame], Any],
        device: torch.device,
    ) -> None:
        self.net, self.frames, self.wanted, self.device = net, frames, wanted, device

    def batch(self, index: int) -> Batch:
        """Return batch ``index``: images, cells and matrix."""
        frames = self.frames[index]
        images, wanted, K = stacked(frames, [self.wanted(frame) for frame in frames])
        return images.to(self.device), wanted.to(self.device), K.to(self.device)

    def loss(self, batch: Batch, index: int) -> Loss:
        """Return the loss of a batch and its parts."""
        del index
        images, wanted, K = batch
        cells = self.net.cells(images, K)
        score = score_loss(cells[:, 0], wanted[:, 0])
        chosen = wanted[:, -1:]
        fields = slice(1, wanted.shape[1] - 1)
        difference = (cells[:, fields] - wanted[:, fields]).abs() * chosen
        values = difference.sum() / chosen.sum().clamp(min=1.0)
        return score + values, {"score": score.detach(), "values": values.detach()}


def score_loss(logits: Tensor, wanted: Tensor) -> Tensor:
    """Return the focal loss of scores (CornerNet): cells with a score of 1 are right, and others count
    the less as wrong ones the nearer they are to one.
    """
    chance = torch.sigmoid(logits)
    right = (wanted >= 1.0).to(logits.dtype)
    positive = right * (1 - chance) ** 2 * F.logsigmoid(logits)
    negative = (1 - right) * (1 - wanted) ** FOCUS * chance**2 * F.logsigmoid(-logits)
    return -(positive + negative).sum() / right.sum().clamp(min=1.0)


def train_detectors(
    data: Path,
    out: Path,
    steps: int,
    seed: int,
    check: Path,
    check_split: str,
    report: Report | None = None,
    device: str = "cpu",
) -> dict[str, Any]:
    """Train both detectors, export them, and return what OUT/detectors.json says of them.

    Args:
        data: Folder of pairs of scenes that are rendered; the split ``train`` is used.
        out: Folder of the run; the same call resumes.
        steps: Updates of each.
        seed: Of weights and draws.
        check: Folder of pairs whose clean frames precision and recall are measured on.
        check_split: Which of its splits.
        report: Called after every update with the detector, the update and logged values.
        device: Where to train.

    Raises:
        InputError: No such pairs, or pairs without lanes and road users.
    """
    sequences = usual_sequences(PairDataset(data, "train").sequences)
    checked = usual_sequences(PairDataset(check, check_split).sequences)
    frames = FrameBatches(sequences, FRAMES, seed)
    initial = stream("training", seed, "detectors.weights")
    torch_seed = int(initial.integers(2**31))
    with fork_rng(devices=[]):
        torch.manual_seed(torch_seed)
        networks: dict[str, tuple[CuboidNet | LaneNet, Callable[[Frame], Any]]] = {
            CUBOIDS: (CuboidNet(), box_cells),
            LANES: (LaneNet(HEIGHT_M, PITCH), lane_cells),
        }
    for name, (net, wanted) in networks.items():
        net.to(require_device(device))
        task = _Task(net, frames, wanted, torch.device(device))
        schedule = Schedule(steps, peak_lr=1e-3, ema=0.99).of_length(steps)
        facts = {"detector": name, "pairs": pairs_digest(sequences), "seed": seed}
        trainer = Trainer(net, out / name, schedule, task.batch, task.loss, facts)
        trainer.run(None if report is None else _named(report, name))
        net.load_state_dict(trainer.averaged(), strict=False)
        save_script(net.cpu(), out / FILES[name])
    record = {
        "steps": steps,
        "seed": seed,
        "trained_on": len(sequences),
        "checked_on": {"split": check_split, "scenes": len(checked)},
        "clean_frames": measured(checked, out),
    }
    write_json(out / RECORD_FILE, record)
    return record


def _named(report: Report, name: str) -> Callable[[int, Mapping[str, float]], None]:
    return lambda step, numbers: report(name, step, numbers)


def measured(sequences: Sequence[PairSequence], folder: Path) -> dict[str, dict[str, float | None]]:
    """Return precision and recall of both detectors on clean frames, pooled over sequences."""
    made_boxes, true_boxes, made_lanes, true_lanes = [], [], [], []
    for sequence in sequences:
        count = min(FRAMES_MEASURED, len(sequence.clip))
        index = np.linspace(0, len(sequence.clip) - 1, count).round().astype(int)
        video = np.stack([sequence.clip.rgb_gt[i] for i in index])
        frames = [frame_of(sequence, int(i)) for i in index]
        K = frames[0].K
        masks = [boxes.mask() for boxes in detect_boxes(video, K, folder)]
        made_boxes += masks
        true_boxes += [drawn_vehicles(sequence.clip.sdmap[i], masks[0].shape) for i in index]
        made_lanes += list(detect_lanes(video, K, folder))
        true_lanes += [lanes_at(frame.lanes) for frame in frames]
    vehicles = overlap(made_boxes, true_boxes)
    lanes = lane_matches(made_lanes, true_lanes)
    return {
        CUBOIDS: {"precision": vehicles.precision, "recall": vehicles.recall, "f1": vehicles.f1},
        LANES: {"precision": lanes.precision, "recall": lanes.recall, "f1": lanes.f1},
    }
