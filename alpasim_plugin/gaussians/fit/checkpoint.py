"""Keep the state of a fit in a file, so that it continues to the same bits."""

from __future__ import annotations

from pathlib import Path

from alpasim_plugin.gaussians.fit.adam import RowAdam
from alpasim_plugin.gaussians.fit.density import ScreenGradients
from alpasim_plugin.gaussians.fit.model import NAMES, SplatModel
from alpasim_plugin.io.atomic import write_safetensors
from alpasim_plugin.io.reading import parsing
from alpasim_plugin.io.reading.checkpoints import START_ANEW, read_checkpoint

STATE_FILE = "state.safetensors"


def save_state(folder: Path, model: SplatModel, adam: RowAdam, gradients: ScreenGradients, step: int, facts: str) -> None:
    """Write everything that later updates depend on; the file appears complete or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    tensors = {"node": model.node, "gradients.total": gradients.total, "gradients.count": gradients.count}
    for name in NAMES:
        tensors |= {f"value.{name}": model.params[name].detach(), f"first.{name}": adam.first[name], f"second.{name}": adam.second[name]}
    write_safetensors(folder / STATE_FILE, tensors, {"step": str(step), "adam_step": str(adam.step), "facts": facts})


def load_state(folder: Path, model: SplatModel, adam: RowAdam, gradients: ScreenGradients, facts: str) -> int:
    """Put a saved state into objects made from the same start, and return the number of updates made.

    Raises:
        InputError: The folder was begun with other views, another start or another recipe, or its file is damaged.
    """
    path, doing = folder / STATE_FILE, "continuing a fit"
    meta, stored = read_checkpoint(path, doing, facts)
    device = model.node.device
    with parsing(doing, path, START_ANEW, "not a whole checkpoint"):
        tensors = {name: t.to(device) for name, t in stored.items()}
        model.node = tensors["node"]
        model.params = {name: tensors[f"value.{name}"].requires_grad_() for name in NAMES}
        adam.first = {name: tensors[f"first.{name}"] for name in NAMES}
        adam.second = {name: tensors[f"second.{name}"] for name in NAMES}
        adam.step = int(meta["adam_step"])
        gradients.total, gradients.count = tensors["gradients.total"], tensors["gradients.count"]
        return int(meta["step"])
