"""Clone, split and remove Gaussians: the adaptive density control of 3D Gaussian Splatting (Kerbl et al. 2023, Sec. 5.2)."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.gaussians.fit.adam import RowAdam
from alpasim_plugin.gaussians.fit.model import SplatModel
from alpasim_plugin.gaussians.fit.recipe import SplatRecipe

SPLIT_SHRINK = 1.6  # of scales when a Gaussian becomes two


class ScreenGradients:
    """Mean screen gradient of every Gaussian over the views that showed it.

    Attributes:
        total: ``(N,)`` sum of norms, in half image widths.
        count: ``(N,)`` views that showed it.
    """

    def __init__(self, n: int, device: str | torch.device = "cpu") -> None:
        self.total, self.count = torch.zeros(n, device=device), torch.zeros(n, device=device)

    def add(self, rows: Tensor, gradient_norm_px: Tensor, radii: Tensor, width_px: int) -> None:
        """Count one view: its Gaussians' rows ``(M,)``, the norms by pixels ``(M,)`` and the radii ``(M,)``, both 0 where not drawn."""
        self.total.index_add_(0, rows, gradient_norm_px * (width_px / 2))
        self.count.index_add_(0, rows, (radii > 0).float())

    def mean(self) -> Tensor:
        """Return ``(N,)``; 0 for what no view showed."""
        return self.total / self.count.clamp(min=1)


@torch.no_grad()
def densify(
    model: SplatModel, adam: RowAdam, gradients: ScreenGradients, recipe: SplatRecipe, extent_m: float, rng: np.random.Generator
) -> None:
    """Clone small and split large Gaussians whose place the loss pulls at, then remove faint and oversized ones; in place.

    A clone starts where its original is. A split one is replaced by two, drawn from it, smaller by 1.6. Where the cap leaves too little
    room the strongest gradients come first.
    """
    pull, size = gradients.mean(), model.params["log_scales"].max(dim=1).values
    wanted = torch.nonzero(pull >= recipe.densify_gradient)[:, 0]
    room = max(recipe.cap - len(model), 0)
    wanted = wanted[torch.sort(pull[wanted], descending=True, stable=True).indices[:room]]
    large = size[wanted] > math.log(max(recipe.dense_share * extent_m, 1e-9))
    clones, splits = wanted[~large], wanted[large]
    kept = torch.ones(len(model), dtype=torch.bool, device=size.device)
    kept[splits] = False
    old = torch.nonzero(kept)[:, 0]
    rows = torch.cat([old, clones, splits, splits])
    fresh = torch.arange(len(rows), device=rows.device) >= len(old)
    _take(model, adam, rows, fresh)
    halves = slice(len(old) + len(clones), len(rows))
    _scatter(model, halves, rng)
    _prune(model, adam, recipe, extent_m)


@torch.no_grad()
def reset_opacities(model: SplatModel, adam: RowAdam, to: float) -> None:
    """Lower all opacities to at most ``to``; what the views need comes back, floaters do not."""
    model.params["logit_opacities"].clamp_(max=math.log(to / (1 - to)))
    adam.forget("logit_opacities")


def _take(model: SplatModel, adam: RowAdam, rows: Tensor, fresh: Tensor) -> None:
    model.params = {name: p.detach()[rows].requires_grad_() for name, p in model.params.items()}
    model.node = model.node[rows]
    adam.take(rows, fresh)


def _scatter(model: SplatModel, part: slice, rng: np.random.Generator) -> None:
    """Draw new centres from the Gaussians of a part, and shrink them."""
    p = model.params
    draw = torch.as_tensor(rng.standard_normal(p["means"][part].shape, dtype=np.float32), device=p["means"].device)
    w, x, y, z = torch.nn.functional.normalize(p["quaternions"][part], dim=1).unbind(1)
    along = draw * p["log_scales"][part].exp()
    # v + 2 u x (u x v + w v) turns v by the quaternion (w, u).
    u = torch.stack([x, y, z], dim=1)
    turned = along + 2 * torch.linalg.cross(u, torch.linalg.cross(u, along) + w[:, None] * along)
    p["means"][part] += turned
    p["log_scales"][part] -= math.log(SPLIT_SHRINK)


def _prune(model: SplatModel, adam: RowAdam, recipe: SplatRecipe, extent_m: float) -> None:
    """Remove what is too faint or too large, and put the rows in the order of their nodes."""
    p = model.params
    faint = p["logit_opacities"] < math.log(recipe.prune_opacity / (1 - recipe.prune_opacity))
    large = p["log_scales"].max(dim=1).values > math.log(recipe.prune_share * extent_m)
    rows = torch.nonzero(~(faint | large))[:, 0]
    rows = rows[torch.sort(model.node[rows], stable=True).indices]
    _take(model, adam, rows, torch.zeros(len(rows), dtype=torch.bool, device=rows.device))
