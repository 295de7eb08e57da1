"""Linear layers with 8-bit weights: one scale per output channel, activations quantised row by row as they come.

With ``W = diag(s) Q`` and a row ``x = a q`` (``Q``, ``q`` integers, ``s``, ``a`` positive), ``W x + b = a s (Q q) + b``. The sum ``Q q``
is exact in every engine, so engines differ by the rounding of the last two products alone.

Weights use the integers -63 to 63. A processor without dot-product instructions for bytes adds pairs of products in 16 bits:
``(127 + 128) * 127 * 2`` would saturate there, half the range cannot. The rule is the same everywhere, so that a network does not change
with the machine it runs on.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from alpasim_plugin.errors import InputError

WEIGHT_LEVELS = 63
ACTIVATION_LEVELS = 127
TINY = 1e-30  # scale of a row of zeros
INT_MM_ROWS = 17  # torch._int_mm on CUDA takes more than 16 rows, and sides in multiples of 8
INT_MM_SIDE = 8


def quantise_rows(x: Tensor, levels: int) -> tuple[Tensor, Tensor]:
    """Round every row to integers between ``-levels`` and ``levels``.

    Args:
        x: ``(rows, columns)`` floating point.
        levels: At most 127.

    Returns:
        ``(rows, columns)`` int8 and ``(rows, 1)`` float32 such that their product is near ``x``. A row with a value that is not finite has
        a scale that is not finite, so it stays visible.
    """
    wide = x.float()
    scale = wide.abs().amax(dim=1, keepdim=True).clamp_min(TINY * levels) / levels
    return (wide / scale).round_().to(torch.int8), scale


def sum_exactly(q: Tensor, weight: Tensor) -> Tensor:
    """Multiply integers ``(rows, inputs)`` and ``(outputs, inputs)`` to ``(rows, outputs)`` float32: the readable twin of the engines."""
    return (q.double() @ weight.double().T).float()


class Int8Linear(nn.Module):
    """A frozen `nn.Linear` with int8 weights, for inference.

    Engine: oneDNN on a CPU that has it, ``torch._int_mm`` on CUDA (and without numbers on ``meta``), else `sum_exactly`.

    Args:
        linear: What to quantise.
    """

    weight: Tensor  # (outputs, inputs) int8
    scale: Tensor  # (outputs,) float32
    bias: Tensor | None

    def __init__(self, linear: nn.Linear) -> None:
        super().__init__()
        weight, scale = quantise_rows(linear.weight.detach(), WEIGHT_LEVELS)
        self.register_buffer("weight", weight)
        self.register_buffer("scale", scale[:, 0].contiguous())
        self.register_buffer("bias", None if linear.bias is None else linear.bias.detach().float().clone())
        self._packed: Tensor | None = None  # oneDNN's layout of the weight, made on first use

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(..., inputs)`` to ``(..., outputs)`` in the dtype of ``x``.

        Raises:
            InputError: When gradients would have to pass.
        """
        if x.requires_grad and torch.is_grad_enabled():
            do = "train the float network and quantise it afterwards, or run under torch.no_grad()"
            raise InputError("running an int8 layer", f"weight {list(self.weight.shape)}", "an input that wants gradients", do)
        q, scale = quantise_rows(x.flatten(0, -2), ACTIVATION_LEVELS)
        out = self._sum(q) * scale
        return (out if self.bias is None else out + self.bias).to(x.dtype).view(*x.shape[:-1], -1)

    def _sum(self, q: Tensor) -> Tensor:
        """Return ``(Q q) s``, ``(rows, outputs)`` float32."""
        if q.device.type == "cpu" and torch.backends.mkldnn.is_available():  # type: ignore[no-untyped-call]
            return self._onednn(q)
        if q.device.type in ("cuda", "meta"):
            return self._int_mm(q) * self.scale
        return sum_exactly(q, self.weight) * self.scale

    def _onednn(self, q: Tensor) -> Tensor:
        ops: Any = torch.ops.onednn
        if self._packed is None:
            self._packed = ops.qlinear_prepack(self.weight, None)
        no_offset = torch.zeros(len(self.scale), dtype=torch.long)
        out: Tensor = ops.qlinear_pointwise(
            q, 1.0, 0, self._packed, self.scale, no_offset, None, 1.0, 0, torch.float32, "none", [], ""
        )  # fmt: skip
        return out

    def _int_mm(self, q: Tensor) -> Tensor:
        rows, outputs = q.shape[0], self.weight.shape[0]
        pad = (0, -q.shape[1] % INT_MM_SIDE, 0, max(0, INT_MM_ROWS - rows))
        weight = nn.functional.pad(self.weight, (0, pad[1], 0, -outputs % INT_MM_SIDE))
        return torch._int_mm(nn.functional.pad(q, pad), weight.T)[:rows, :outputs].float()

    def __getstate__(self) -> dict[str, Any]:
        """Leave oneDNN's copy behind: it can be neither copied nor pickled."""
        return {**self.__dict__, "_packed": None}


def quantise_linears(net: nn.Module) -> nn.Module:
    """Replace every plain `nn.Linear` below ``net`` in place; subclasses (float32 islands, patch embeddings) stay as they are."""
    for parent in list(net.modules()):
        for name, child in list(parent.named_children()):
            if type(child) is nn.Linear:
                setattr(parent, name, Int8Linear(child))
    return net
