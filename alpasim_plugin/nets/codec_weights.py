"""Load the weights of a video codec from a checkpoint, with every key and shape checked, or initialise them at random."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from alpasim_plugin.core import seeding
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.nets.checkpoints import convert, listed


def load_checked(net: nn.Module, tensors: Mapping[str, Tensor], dtype: torch.dtype, doing: str, source: str, do: str) -> None:
    """Give ``net`` (built on the meta device) copies of ``tensors`` in one precision.

    Args:
        net: Its state dict gives the expected keys and shapes.
        tensors: Half, single or double precision, also mixed.
        dtype: Precision of the network's parameters; its constants are float32.
        doing, source, do: For the message.

    Raises:
        InputError: Missing, unexpected, mis-shaped (also transposed), non-floating keys, all in one message; or a value that
            overflows ``dtype``.
    """
    expected = {key: tuple(value.shape) for key, value in net.state_dict().items()}
    shared = sorted(expected.keys() & tensors.keys())
    wrong = [_describe(key, tensors[key], expected[key]) for key in shared if tuple(tensors[key].shape) != expected[key]]
    other = [f"{key} ({tensors[key].dtype})" for key in sorted(tensors) if not tensors[key].is_floating_point()]
    missing, unexpected = sorted(expected.keys() - tensors.keys()), sorted(tensors.keys() - expected.keys())
    groups = {"missing": missing, "unexpected": unexpected, "wrong shape": wrong, "not floating point": other}
    if found := [listed(what, keys) for what, keys in groups.items() if keys]:
        raise InputError(doing, f"{source} ({len(tensors)} tensors, {len(expected)} expected)", "; ".join(found), do)
    constants = {key for key, _ in net.named_buffers()}
    precision = {key: torch.float32 if key in constants else dtype for key in expected}
    net.load_state_dict({key: _packed(convert(key, tensors[key], precision[key], source)) for key in expected}, assign=True)


def fill_random(net: nn.Module, seed: int, component: str) -> None:
    """Initialise ``net`` with weights that depend on the key names, the seed and the component only.

    Matrices are normal with standard deviation 1/sqrt(fan-in), vectors that multiply (``gamma``) are 1, biases 0.
    """
    filled = {}
    for key, value in net.state_dict().items():
        if value.ndim > 1 and not key.endswith("gamma"):
            numbers = seeding.stream("nets", seed, f"{component}/{key}").standard_normal(tuple(value.shape))
            filled[key] = _packed(torch.from_numpy(numbers / value[0].numel() ** 0.5).float())
        else:
            filled[key] = torch.ones(value.shape) if key.endswith("gamma") else torch.zeros(value.shape)
    net.load_state_dict(filled, assign=True)


def _packed(value: Tensor) -> Tensor:
    """Return a kernel in channels-last memory format; shape and values unchanged."""
    if value.ndim == 4:
        return value.contiguous(memory_format=torch.channels_last)
    return value.permute(2, 0, 3, 4, 1).contiguous().permute(1, 4, 0, 2, 3) if value.ndim == 5 else value


def _describe(key: str, value: Tensor, expected: tuple[int, ...]) -> str:
    shape = tuple(value.shape)
    hint = ", transposed" if sorted(shape) == sorted(expected) else ""
    return f"{key} is {list(shape)} for {list(expected)}{hint}"
