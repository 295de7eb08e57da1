"""GSFix3D and 3DGS-Enhancer: flow matching from noise alone, with the render as a condition in the
map's place.

    z_t = (1 - t) z_0 + t eps,   v_hat = v(z_t, t | z_r), attention over the whole window

    GSFix3D         t ~ U(0, 1), eps of several scales        | v_hat - (eps - z_0) |^2
    3DGS-Enhancer   t = s / (1 + s), s log-normal             ((1 - t)^2 + t^2) / t  | v_hat - (eps - z_0) |

The second is EDM's ``(1 + s^2) / s^2 |x0_hat - x0|`` (absolute, as the public code has it) with
``x0_hat = z_t - t v_hat``. GSFix3D predicts v of a variance-preserving path; on the straight one
this is the velocity.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT, TextContext
from alpasim_plugin.fixers.network.schedule import TABLE, interpolant

# Of s, as SVD's training has them
LOG_MEAN = 0.7
LOG_STD = 1.6
Error = Callable[[Tensor, Tensor], Tensor]  # v_hat - v (B, C, T, H, W), t (B,) -> the same shape


def uniform_times(rng: np.random.Generator, count: int) -> Tensor:
    """Draw times ``(count,)`` from (0, 1)."""
    return torch.from_numpy(rng.random(count, dtype=np.float32))


def log_normal_times(rng: np.random.Generator, count: int) -> Tensor:
    """Draw times ``(count,)`` of log-normal noise levels s on the straight path, ``t = s / (1 +
    s)``.
    """
    s = np.exp(LOG_MEAN + LOG_STD * rng.standard_normal(count, dtype=np.float32))
    return torch.from_numpy(s / (1 + s))


def seen_latents(rng: np.random.Generator, shape: tuple[int, int], dropout: float) -> Tensor:
    """Draw which latents of windows ``(B, T)`` keep their condition; the first and the last always
    do.
    """
    keeps_condition = rng.random(shape) >= dropout
    keeps_condition[:, [0, -1]] = True
    return torch.from_numpy(keeps_condition)


def squared_error(error: Tensor, t: Tensor) -> Tensor:
    """Return the squared error of the velocity."""
    return error.square()


def edm_error(error: Tensor, t: Tensor) -> Tensor:
    """Return the absolute error of the velocity in EDM's weight, which is that of the clean
    latents.
    """
    return error.abs() * (((1 - t).square() + t.square()) / t).view(-1, 1, 1, 1, 1)


def noise_window_errors(
    net: CosmosCausalDiT,
    z_0: Tensor,
    z_r: Tensor,
    eps: Tensor,
    t: Tensor,
    text: Tensor | TextContext,
    error: Error,
) -> Tensor:
    """Return the errors of the velocity of whole windows.

    Args:
        net: The network.
        z_0, z_r: ``(B, C, T, H, W)`` latents of the clean frames and of the render.
        eps: Noise, like them.
        t: ``(B,)``, times in (0, 1], one a window.
        text: Prompt.
        error: Weight and power.

    Returns:
        Like ``z_0``, not averaged.
    """
    z_t = interpolant(z_0, eps, t.view(-1, 1, 1, 1, 1))
    v = net(z_t, TABLE * t[:, None], text, z_r, block_latents=None)
    return error(v - (eps - z_0), t)
