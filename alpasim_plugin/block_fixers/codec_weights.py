"""Load the weights of a video codec from a checkpoint, with every key and shape checked, or
initialise them at random.

Per-channel mean and standard deviation of a video latent; normalisation and its inverse.

A diffusion network works on normalised latents, ``(mu - mean) / std`` per channel. The Wan 2.1
values are published with that autoencoder; LightVAE and the tiny decoders share its latent space
and therefore its statistics.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from alpasim_plugin.block_fixers.streaming import Float32Buffers
from alpasim_plugin.core import seeding
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.network.checkpoints import convert, listed

WAN_MEAN = (
    -0.7571,
    -0.7089,
    -0.9113,
    0.1075,
    -0.1745,
    0.9653,
    -0.1517,
    1.5508,
    0.4134,
    -0.0715,
    0.5517,
    -0.3632,
    -0.1922,
    -0.9497,
    0.2503,
    -0.2921,
)
WAN_STD = (
    2.8184,
    1.4541,
    2.3275,
    2.6558,
    1.2196,
    1.7708,
    2.6052,
    2.0743,
    3.2687,
    2.1526,
    2.8652,
    1.5579,
    1.6382,
    1.1253,
    2.8251,
    1.9160,
)


def load_checked(
    net: nn.Module,
    tensors: Mapping[str, Tensor],
    dtype: torch.dtype,
    source: str,
    do: str,
) -> None:
    """Give ``net`` (built on the meta device) copies of ``tensors`` in one precision.

    Args:
        net: Its state dict gives the expected keys and shapes.
        tensors: Half, single or double precision, also mixed.
        dtype: Precision of the network's parameters; its constants are float32.
        doing, source, do: For the message.

    Raises:
        InputError: Missing, unexpected, mis-shaped (also transposed), non-floating keys, all in one
            message; or a value that overflows ``dtype``.
    """
    expected = {key: tuple(value.shape) for key, value in net.state_dict().items()}
    shared = sorted(expected.keys() & tensors.keys())
    wrong = [
        _describe(key, tensors[key], expected[key])
        for key in shared
        if tuple(tensors[key].shape) != expected[key]
    ]
    other = [
        f"{key} ({tensors[key].dtype})"
        for key in sorted(tensors)
        if not tensors[key].is_floating_point()
    ]
    missing, unexpected = (
        sorted(expected.keys() - tensors.keys()),
        sorted(tensors.keys() - expected.keys()),
    )
    groups = {
        "missing": missing,
        "unexpected": unexpected,
        "wrong shape": wrong,
        "not floating point": other,
    }
    if found := [listed(what, keys) for what, keys in groups.items() if keys]:
        raise InputError(
            f"{source} ({len(tensors)} tensors, {len(expected)} expected): {'; '.join(found)}",
            do,
        )
    constants = {key for key, _ in net.named_buffers()}
    precision = {key: torch.float32 if key in constants else dtype for key in expected}
    net.load_state_dict(
        {key: _packed(convert(key, tensors[key], precision[key], source)) for key in expected},
        assign=True,
    )


def fill_random(net: nn.Module, seed: int, component: str) -> None:
    """Initialise ``net`` with weights that depend on the key names, the seed and the component
    only.

    Matrices are normal with standard deviation 1/sqrt(fan-in), vectors that multiply (``gamma``)
    are 1, biases 0.
    """
    filled = {}
    for key, value in net.state_dict().items():
        if value.ndim > 1 and not key.endswith("gamma"):
            numbers = seeding.stream("nets", seed, f"{component}/{key}").standard_normal(
                tuple(value.shape)
            )
            filled[key] = _packed(torch.from_numpy(numbers / value[0].numel() ** 0.5).float())
        else:
            filled[key] = (
                torch.ones(value.shape) if key.endswith("gamma") else torch.zeros(value.shape)
            )
    net.load_state_dict(filled, assign=True)


def _packed(value: Tensor) -> Tensor:
    """Return a kernel in channels-last memory format; shape and values unchanged."""
    if value.ndim == 4:
        return value.contiguous(memory_format=torch.channels_last)
    return (
        value.permute(2, 0, 3, 4, 1).contiguous().permute(1, 4, 0, 2, 3)
        if value.ndim == 5
        else value
    )


def _describe(key: str, value: Tensor, expected: tuple[int, ...]) -> str:
    shape = tuple(value.shape)
    hint = ", transposed" if sorted(shape) == sorted(expected) else ""
    return f"{key} is {list(shape)} for {list(expected)}{hint}"


class LatentStats(Float32Buffers):
    """Normalise and de-normalise latents; the statistics stay float32 in every precision of the
    latents.

    Args:
        mean: One value a channel.
        std: One positive value a channel.
        stored: Whether the statistics are in the state dict (they are not in Wan checkpoints).

    Raises:
        InputError: Lengths differ or a deviation is not positive.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self, mean: Sequence[float] = WAN_MEAN, std: Sequence[float] = WAN_STD, stored: bool = False
    ) -> None:
        super().__init__()
        if len(mean) != len(std) or not all(s > 0 for s in std):
            raise InputError(
                f"{len(mean)} means and {len(std)} standard deviations: standard deviations {list(std)}",
                "give one mean and one positive standard deviation for each latent channel",
            )
        self.register_buffer("mean", torch.tensor(mean, dtype=torch.float32), persistent=stored)
        self.register_buffer("std", torch.tensor(std, dtype=torch.float32), persistent=stored)

    def normalise(self, mu: Tensor) -> Tensor:
        """Map encoder means ``(B, C, t, h, w)`` to latents of about unit variance; same dtype."""
        mean, std = self._broadcast(mu)
        return ((mu.float() - mean) / std).to(mu.dtype)

    def denormalise(self, z: Tensor) -> Tensor:
        """Undo `normalise`."""
        mean, std = self._broadcast(z)
        return (z.float() * std + mean).to(z.dtype)

    def _broadcast(self, z: Tensor) -> tuple[Tensor, Tensor]:
        shape = (1, -1) + (1,) * (z.ndim - 2)
        return self.mean.view(shape), self.std.view(shape)
