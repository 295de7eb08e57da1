"""Per-channel mean and standard deviation of a video latent; initialisation of a codec at random.

A diffusion network works on normalised latents, ``(mu - mean) / std`` per channel. The Wan 2.1
values are published with that autoencoder; LightVAE and the tiny decoders share its latent space
and therefore its statistics.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from alpasim_plugin.core import seeding
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.network.checkpoints import channels_last, listed

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


def fill_random(net: nn.Module, seed: int, component: str) -> None:
    """Initialise ``net`` with weights that depend on the key names, the seed and the component
    only.

    Matrices are normal with standard deviation 1/sqrt(fan-in), vectors that multiply (``gamma``)
    are 1, biases 0.
    """
    filled = {}
    for key, value in net.state_dict().items():
        if key.endswith("gamma"):
            filled[key] = torch.ones(value.shape)
        elif value.ndim > 1:
            rng = seeding.stream("nets", seed, f"{component}/{key}")
            numbers = rng.standard_normal(tuple(value.shape)) / value[0].numel() ** 0.5
            filled[key] = channels_last(torch.from_numpy(numbers).float())
        else:
            filled[key] = torch.zeros(value.shape)
    net.load_state_dict(filled, assign=True)


def first_axes(
    tensors: Mapping[str, Tensor], keys: Sequence[str], source: str, hint: str
) -> list[int]:
    """Return the length of the first axis of tensors that give a network its sizes.

    Raises:
        InputError: One of them is missing; ``source`` and ``hint`` are for its message.
    """
    missing = [key for key in keys if key not in tensors]
    if missing:
        raise InputError(f"{source} ({len(tensors)} tensors): {listed('missing', missing)}", hint)
    return [tensors[key].shape[:1].numel() for key in keys]


class LatentStats(nn.Module):
    """Normalise and de-normalise latents; the statistics stay float32 in every precision of the
    latents.

    Args:
        mean: One value a channel.
        std: One positive value a channel.
        stored: Whether the statistics are in the state dict (they are not in Wan checkpoints).

    They are on the CPU also under a default device of ``meta``.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self, mean: Sequence[float] = WAN_MEAN, std: Sequence[float] = WAN_STD, stored: bool = False
    ) -> None:
        super().__init__()
        for name, values in (("mean", mean), ("std", std)):
            numbers = torch.tensor(values, dtype=torch.float32, device="cpu")
            self.register_buffer(name, numbers, persistent=stored)

    def normalise(self, mu: Tensor) -> Tensor:
        """Map encoder means ``(B, C, t, h, w)`` to latents of about unit variance; same dtype."""
        return ((mu.float() - _by_channel(self.mean)) / _by_channel(self.std)).to(mu.dtype)

    def denormalise(self, z: Tensor) -> Tensor:
        """Undo `normalise`."""
        return (z.float() * _by_channel(self.std) + _by_channel(self.mean)).to(z.dtype)


def _by_channel(values: Tensor) -> Tensor:
    return values.view(1, -1, 1, 1, 1)
