"""The transformer's feed-forward layer."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn


class Mlp(nn.Module):
    """Linear, exact GELU, linear; without biases unless modulation is folded in."""

    def __init__(self, width: int, inner: int) -> None:
        super().__init__()
        self.layer1 = nn.Linear(width, inner, bias=False)
        self.layer2 = nn.Linear(inner, width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(..., width)`` to ``(..., width)``."""
        out: Tensor = self.layer2(F.gelu(self.layer1(x)))
        return out
