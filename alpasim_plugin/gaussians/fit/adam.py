"""Adam on a set of rows that grows and shrinks."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

BETA1, BETA2, EPS = 0.9, 0.999, 1e-15  # epsilon as in the published 3DGS code: gradients of single Gaussians are tiny


class RowAdam:
    """Adam (Kingma and Ba 2015, Algorithm 1) on named tensors with one row per Gaussian.

    Attributes:
        first: Name to running mean of the gradient, like the tensor.
        second: Name to running mean of its square.
        step: Updates made.
    """

    def __init__(self, params: Mapping[str, Tensor]) -> None:
        self.first = {name: torch.zeros_like(p, requires_grad=False) for name, p in params.items()}
        self.second = {name: torch.zeros_like(p, requires_grad=False) for name, p in params.items()}
        self.step = 0

    @torch.no_grad()
    def update(self, params: Mapping[str, Tensor], rates: Mapping[str, float]) -> None:
        """Make one update in place from the tensors' gradients, which are cleared; a tensor without gradient stays as it is."""
        self.step += 1
        correct1, correct2 = 1 - BETA1**self.step, 1 - BETA2**self.step
        for name, p in params.items():
            if p.grad is None:
                continue
            m, v = self.first[name], self.second[name]
            m.lerp_(p.grad, 1 - BETA1)
            v.mul_(BETA2).addcmul_(p.grad, p.grad, value=1 - BETA2)
            p.addcdiv_(m, (v / correct2).sqrt_().add_(EPS), value=-rates[name] / correct1)
            p.grad = None

    def take(self, rows: Tensor, fresh: Tensor) -> None:
        """Follow a choice of rows ``(M,)``; the moments of ``fresh (M,)`` ones begin at zero."""
        for moments in (self.first, self.second):
            for name, m in moments.items():
                chosen = m[rows]
                chosen[fresh] = 0
                moments[name] = chosen

    def forget(self, name: str) -> None:
        """Begin the moments of one tensor again."""
        self.first[name].zero_()
        self.second[name].zero_()
