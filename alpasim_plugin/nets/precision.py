"""Cast a trained network to another precision for inference.

In bf16 and fp16 the token stream and the linear layers have that type; the time embedding, the modulation, the rotary angles and the
arithmetic inside norms stay float32. Cast last: fold at float32 and cast the folded network, so that each weight is rounded once.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Literal, TypeVar

import torch
from torch import Tensor, nn

from alpasim_plugin.nets import checkpoints
from alpasim_plugin.nets.dit import FLOAT32_KEYS, CosmosCausalDiT, TextContext

Precision = Literal["fp32", "bf16", "fp16"]
DTYPES: Mapping[Precision, torch.dtype] = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}

Net = TypeVar("Net", bound=nn.Module)


@dataclass(frozen=True)
class Choice:
    """A precision, and the reason for it."""

    name: Literal["fp32", "bf16"]
    why: str


@cache
def choose_precision(wanted: Literal["auto", "fp32", "bf16"] = "auto", device: str = "cpu") -> Choice:
    """Return the precision of convolutions that pays on this machine; the machine is asked once per process.

    ``auto`` is bfloat16 on a GPU and on a processor with matrix or dot-product instructions for it (AMX, AVX-512 BF16). Anywhere else
    bfloat16 is emulated and takes several times as long as float32.

    Example:
        >>> choose_precision("fp32")
        Choice(name='fp32', why='as set')
    """
    if wanted != "auto":
        return Choice(wanted, "as set")
    if device.split(":")[0] == "cuda":
        return Choice("bf16", "a GPU")
    probes = {"AMX": torch.cpu._is_amx_tile_supported, "AVX-512 BF16": torch.cpu._is_avx512_bf16_supported}
    found = [label for label, probe in probes.items() if probe()]
    if found:
        return Choice("bf16", f"the processor has {found[0]}")
    return Choice("fp32", "the processor has no instructions for bfloat16")


def at_precision(net: CosmosCausalDiT, precision: Precision) -> CosmosCausalDiT:
    """Return a frozen copy of a transformer, folded or not, at another precision.

    Equal bit for bit to loading the same tensors with ``dtype=``.

    Args:
        net: At float32, for one rounding only.
        precision: See the module.

    Raises:
        InputError: A weight that overflows the precision, named.
    """
    return _cast(net, DTYPES[precision], lambda key: any(part in key for part in FLOAT32_KEYS))


def codec_at_precision(codec: Net, precision: Precision) -> Net:
    """Return a frozen copy of a video autoencoder or decoder at another precision; its constants stay float32.

    Raises:
        InputError: A weight that overflows the precision, named.
    """
    return _cast(codec, DTYPES[precision], lambda key: False)


def text_at_precision(text: TextContext, precision: Precision) -> TextContext:
    """Return a prompt's keys and values at another precision."""
    dtype = DTYPES[precision]
    return TextContext(tuple((k.to(dtype), v.to(dtype)) for k, v in text.keys_values))


def weight_bytes(net: nn.Module) -> int:
    """Return the bytes of all parameters and buffers."""
    parts: list[Tensor] = [*net.parameters(), *net.buffers()]
    return sum(part.numel() * part.element_size() for part in parts)


def _cast(net: Net, dtype: torch.dtype, stays: Callable[[str], bool]) -> Net:
    """Copy ``net`` without ever holding a second copy at the old precision."""
    cast: dict[int, object] = {}
    for key, value in net.named_parameters():
        kept = torch.float32 if stays(key) else dtype
        cast[id(value)] = nn.Parameter(checkpoints.convert(key, value.detach(), kept, "network"), requires_grad=False)
    return copy.deepcopy(net, cast)
