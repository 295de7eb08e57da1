"""Select torch's attention kernel, for benchmarks; the networks work with any.

No mask is built (`attention`), so every kernel applies: flash, cuDNN, memory-efficient, and `math` (plain matrix products that hold all
scores), which is the reference of the others.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, get_args

import torch
import torch.nn.functional as F
from torch.nn.attention import SDPBackend, sdpa_kernel

from alpasim_plugin.core.errors import InputError

Kernel = Literal["auto", "flash", "cudnn", "efficient", "math"]
BACKENDS = {
    "flash": SDPBackend.FLASH_ATTENTION,
    "cudnn": SDPBackend.CUDNN_ATTENTION,
    "efficient": SDPBackend.EFFICIENT_ATTENTION,
    "math": SDPBackend.MATH,
}


@contextmanager
def attention_kernel(
    name: Kernel, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32, head_width: int = 64
) -> Iterator[None]:
    """Run attention with one kernel and no other; ``auto`` leaves the choice to torch.

    Args:
        name: The kernel.
        device, dtype, head_width: Of the inputs; the kernel is tried on them once.

    Raises:
        InputError: The kernel is unknown or does not support these inputs.
    """
    if name not in get_args(Kernel):
        raise InputError("choosing an attention kernel", name, "no such kernel", f"take one of {', '.join(get_args(Kernel))}")
    if name == "auto":
        yield
        return
    with sdpa_kernel(BACKENDS[name]):
        x = torch.zeros(1, 2, 16, head_width, device=device, dtype=dtype)
        try:
            F.scaled_dot_product_attention(x, x, x)
        except RuntimeError as error:
            found = f"{str(error).splitlines()[0]} ({device}, {dtype}, head width {head_width})"
            raise InputError("choosing an attention kernel", name, found, "use auto, or another precision") from error
        yield
