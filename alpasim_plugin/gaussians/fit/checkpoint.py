"""Keep the state of a fit in a file, so that it continues to the same bits."""

from __future__ import annotations

from pathlib import Path

from safetensors import safe_open
from safetensors.torch import load_file

from alpasim_plugin.atomic import write_safetensors
from alpasim_plugin.errors import InputError
from alpasim_plugin.gaussians.fit.adam import RowAdam
from alpasim_plugin.gaussians.fit.density import ScreenGradients
from alpasim_plugin.gaussians.fit.model import NAMES, SplatModel

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
        InputError: The folder was begun with other views, another start or another recipe.
    """
    path = folder / STATE_FILE
    with safe_open(str(path), "pt") as file:
        meta = file.metadata()
    if meta["facts"] != facts:
        raise InputError("continuing a fit", str(path), f"it was begun as {meta['facts']}, this is {facts}", "choose another folder")
    device = model.node.device
    tensors = {name: t.to(device) for name, t in load_file(str(path)).items()}
    model.node = tensors["node"]
    model.params = {name: tensors[f"value.{name}"].requires_grad_() for name in NAMES}
    adam.first = {name: tensors[f"first.{name}"] for name in NAMES}
    adam.second = {name: tensors[f"second.{name}"] for name in NAMES}
    adam.step = int(meta["adam_step"])
    gradients.total, gradients.count = tensors["gradients.total"], tensors["gradients.count"]
    return int(meta["step"])
