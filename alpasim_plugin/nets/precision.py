"""Cast a trained network to another precision for inference.

In bf16 and fp16 the token stream and the linear layers have that type; the time embedding, the modulation, the rotary angles and the
arithmetic inside norms stay float32. Cast last: fold at float32 and cast the folded network, so that each weight is rounded once.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor, nn

from alpasim_plugin.nets import checkpoints
from alpasim_plugin.nets.dit import FLOAT32_KEYS, CosmosCausalDiT, TextContext
from alpasim_plugin.nets.machine_probe import WORTH, Probe, probe_precision

Precision = Literal["fp32", "bf16", "fp16"]
DTYPES: Mapping[Precision, torch.dtype] = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}

Net = TypeVar("Net", bound=nn.Module)


@dataclass(frozen=True)
class Choice:
    """A precision, and the reason for it."""

    name: Literal["fp32", "bf16"]
    why: str
    probe: Probe | None = None  # what was measured; None where nothing had to be

    def as_dict(self) -> dict[str, Any]:
        """Return it for a record, with the measured error of one convolution at this precision."""
        out: dict[str, Any] = {"name": self.name, "why": self.why}
        if self.probe is not None:
            out |= {"error": self.probe.bf16_error if self.name == "bf16" else self.probe.fp32_error, "probe": asdict(self.probe)}
        return out


def choose_precision(wanted: Literal["auto", "fp32", "bf16"] = "auto", device: str = "cpu") -> Choice:
    """Return the precision of convolutions that pays on this machine.

    ``auto`` is bfloat16 on a GPU, and on a processor on which a convolution in bfloat16 takes at most two thirds of the time that it takes
    in float32 (`alpasim_plugin.nets.machine_probe`). Where bfloat16 is emulated it takes several times as long.

    Example:
        >>> choose_precision("fp32")
        Choice(name='fp32', why='as set', probe=None)
    """
    if wanted != "auto":
        return Choice(wanted, "as set")
    if device.split(":")[0] == "cuda":
        return Choice("bf16", "a GPU")
    probe = probe_precision()
    gain = probe.fp32_ms / probe.bf16_ms
    return Choice("bf16" if gain >= WORTH else "fp32", f"bfloat16 is {gain:.2g} times as fast as float32 on this processor", probe)


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
