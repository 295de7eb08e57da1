"""Precision of a network that is done with training: what is cast, what stays float32, what becomes int8.

| name | stream and linears | stays float32 |
|---|---|---|
| fp32 | float32 | everything |
| bf16, fp16 | that type | time embedding, modulation, rotary angles, the arithmetic inside norms |
| int8 | linears of the blocks int8, stream float32 on a CPU and bfloat16 elsewhere | as above, and patch embeddings, final layer, prompt |

Cast last: fold at float32 and cast the folded network, so that each weight is rounded once.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Literal, TypeVar

import torch
from torch import Tensor, nn

from alpasim_plugin.nets import checkpoints
from alpasim_plugin.nets.dit import FLOAT32_KEYS, CosmosCausalDiT, TextContext
from alpasim_plugin.nets.int8 import quantise_linears

Precision = Literal["fp32", "bf16", "fp16", "int8"]
DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}

Net = TypeVar("Net", bound=nn.Module)


def stream_dtype(precision: Precision, device: torch.device | str = "cpu") -> torch.dtype:
    """Return the dtype of what runs between the layers.

    Example:
        >>> stream_dtype("int8"), stream_dtype("int8", "cuda"), stream_dtype("fp16")
        (torch.float32, torch.bfloat16, torch.float16)
    """
    if precision == "int8":
        return torch.float32 if torch.device(device).type == "cpu" else torch.bfloat16
    return DTYPES[precision]


def at_precision(net: CosmosCausalDiT, precision: Precision, device: torch.device | str | None = None) -> CosmosCausalDiT:
    """Return a frozen copy of a transformer, folded or not, at another precision.

    Equal bit for bit to loading the same tensors with ``dtype=``, except that int8 has no such dtype.

    Args:
        net: At float32, for one rounding only.
        precision: See the module.
        device: Where it will run, if not where it is.

    Raises:
        InputError: A weight that overflows the precision, named.
    """
    out = _cast(net, stream_dtype(precision, device or net.device), lambda key: any(part in key for part in FLOAT32_KEYS))
    if precision == "int8":
        quantise_linears(out.blocks)
    return out


def codec_at_precision(codec: Net, precision: Literal["fp32", "bf16", "fp16"]) -> Net:
    """Return a frozen copy of a video autoencoder or decoder at another precision; its constants stay float32.

    Raises:
        InputError: A weight that overflows the precision, named.
    """
    return _cast(codec, DTYPES[precision], lambda key: False)


def text_at_precision(text: TextContext, precision: Precision, device: torch.device | str | None = None) -> TextContext:
    """Return a prompt's keys and values in the stream's precision of a network; ``device`` as in `at_precision`."""
    pairs = text.keys_values
    return TextContext(tuple((k.to(dtype := stream_dtype(precision, device or k.device)), v.to(dtype)) for k, v in pairs))


def weight_bytes(net: nn.Module) -> int:
    """Return the bytes of all parameters and buffers; oneDNN's own copy of int8 weights comes on top once they have run on a CPU."""
    parts: list[Tensor] = [*net.parameters(), *net.buffers()]
    return sum(part.numel() * part.element_size() for part in parts)


def _cast(net: Net, dtype: torch.dtype, stays: Callable[[str], bool]) -> Net:
    """Copy ``net`` without ever holding a second copy at the old precision."""
    cast: dict[int, object] = {}
    for key, value in net.named_parameters():
        kept = torch.float32 if stays(key) else dtype
        cast[id(value)] = nn.Parameter(checkpoints.convert(key, value.detach(), kept, "network"), requires_grad=False)
    return copy.deepcopy(net, cast)
