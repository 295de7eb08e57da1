"""Which of torch's attention kernels runs. Nothing in the networks needs a choice: this is for measuring one against another.

No mask is ever built (`attention`), so every kernel applies: flash, cuDNN's, the memory-efficient one, and plain products (`math`), which
hold all scores and are the twin of the others.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, get_args

import torch
import torch.nn.functional as F
from torch.nn.attention import SDPBackend, sdpa_kernel

from alpasim_plugin.errors import InputError

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
        device, dtype, head_width: What it will be used on; tried once before anything runs, for a kernel that cannot is an error.

    Raises:
        InputError: A kernel that is unknown or not there for these.
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
