"""Hold the Gaussians that are fitted (a background and rigid actors, each in its own frame), with
their optimiser and density control.

`RowAdam` moves them; `densify` clones, splits and removes them: the adaptive density control of 3D
Gaussian Splatting (Kerbl et al. 2023, Sec. 5.2).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.core.devices import download, upload
from alpasim_plugin.core.geometry import quat_from_matrix
from alpasim_plugin.core.types import F64
from alpasim_plugin.gaussians.cloud import GaussianCloud, logit
from alpasim_plugin.gaussians.fit.recipe import SplatRecipe
from alpasim_plugin.gaussians.fit.start import Start
from alpasim_plugin.gaussians.raster.splats import Splats
from alpasim_plugin.gaussians.sh import SH_SIZES, sh_rotation

NAMES = ("means", "log_scales", "quaternions", "logit_opacities", "sh_dc", "sh_rest")


@dataclass(frozen=True, eq=False)
class Motion:
    """Where the actors of one view are, as tensors by node: row 0 is the background, which stands
    still.

    Attributes:
        present: ``(M,)`` bool, on the host.
        rotation: ``(M, 3, 3)``; identity where absent.
        shift: ``(M, 3)`` metres, in the fit's frame.
        quat: ``(M, 4, 4)``, the matrix that multiplies a quaternion from the left.
        harmonics: ``(M, K, K)``, which turns colour coefficients with the actor.
    """

    present: Tensor
    rotation: Tensor
    shift: Tensor
    quat: Tensor
    harmonics: Tensor


class SplatModel:
    """The trainable state.

    Attributes:
        actors: Ids; node i + 1 is the i-th.
        origin: ``(3,)`` world position that is zero in the fit: float32 means keep their digits
            wherever the scene lies.
        params: Name (`NAMES`) to a leaf tensor with N rows: means in the node's frame, logarithms
            of scales, quaternions, logits of opacity, constant and further colour coefficients.
        device: Where its parameters are.
        node: ``(N,)`` the node of each Gaussian, ascending; on the host, which thus knows how many
            are in view.
    """

    def __init__(
        self, actors: tuple[str, ...], origin: F64, params: Mapping[str, Tensor], node: Tensor
    ) -> None:
        self.actors, self.origin, self.node = actors, origin, node
        self.params = {name: params[name].detach().requires_grad_() for name in NAMES}
        self.device = self.params["means"].device

    @classmethod
    def from_start(
        cls, start: Start, origin: F64, sh_degree: int, device: str = "cpu"
    ) -> SplatModel:
        """Take over a start's Gaussians; their colours are padded or cut to the degree."""
        names = tuple(sorted(start.actors))
        clouds = [start.background, *(start.actors[name] for name in names)]
        moved = [clouds[0].means - origin, *(cloud.means for cloud in clouds[1:])]
        joined = GaussianCloud.concatenate(clouds)
        size = SH_SIZES[sh_degree]
        sh = np.zeros((len(joined), size, 3))
        have = min(size, joined.sh.shape[1])
        sh[:, :have] = joined.sh[:, :have]
        arrays = {
            "means": np.concatenate(moved),
            "log_scales": np.log(joined.scales),
            "quaternions": joined.quats,
            "logit_opacities": logit(joined.opacities),
            "sh_dc": sh[:, :1],
            "sh_rest": sh[:, 1:],
        }
        node = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
        tensors = {name: upload(array.astype(np.float32), device) for name, array in arrays.items()}
        return cls(names, origin, tensors, torch.as_tensor(node))

    def __len__(self) -> int:
        """Return N."""
        return len(self.node)

    def motion(self, poses: Mapping[str, F64]) -> Motion:
        """Turn a view's actor poses ``T_world_box`` into tensors."""
        m = len(self.actors) + 1
        size = 1 + self.params["sh_rest"].shape[1]
        present = np.zeros(m, dtype=bool)
        T = np.tile(np.eye(4), (m, 1, 1))
        quat = np.tile(np.eye(4), (m, 1, 1))
        harmonics = np.tile(np.eye(size), (m, 1, 1))
        present[0] = True
        for i, name in enumerate(self.actors, start=1):
            if name in poses:
                present[i], T[i] = True, poses[name]
                T[i, :3, 3] -= self.origin
                w, x, y, z = quat_from_matrix(T[i, :3, :3])
                quat[i], harmonics[i] = (
                    np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]),
                    _harmonics(T[i, :3, :3].tobytes(), size),
                )
        tensors = (
            upload(array.astype(np.float32), self.device)
            for array in (T[:, :3, :3], T[:, :3, 3], quat, harmonics)
        )
        return Motion(torch.as_tensor(present), *tensors)

    def placed(self, motion: Motion, sh_size: int) -> tuple[Splats, Tensor]:
        """Move every node to its place.

        Args:
            motion: Of the view.
            sh_size: How many colour coefficients are in use.

        Returns:
            Gaussians in the fit's frame (world minus origin), with graph; and the row of the model
            that each is, ``(M,)``.
        """
        p = self.params
        still = int(torch.searchsorted(self.node, 1))
        sh = (
            torch.cat([p["sh_dc"], p["sh_rest"][:, : sh_size - 1]], dim=1)
            if sh_size > 1
            else p["sh_dc"]
        )
        moving = still + torch.nonzero(motion.present[self.node[still:]])[:, 0]
        if not len(moving):
            parts = [*(p[name][:still] for name in NAMES[:4]), sh[:still]]
            return Splats(*parts), torch.arange(still, device=self.device)
        node, moving = (upload(rows, self.device) for rows in (self.node[moving], moving))
        means = (
            torch.einsum("nij,nj->ni", motion.rotation[node], p["means"][moving])
            + motion.shift[node]
        )
        quats = torch.einsum("nij,nj->ni", motion.quat[node], p["quaternions"][moving])
        turned = torch.einsum(
            "njk,nkc->njc", motion.harmonics[node, :sh_size, :sh_size], sh[moving]
        )
        splats = Splats(
            torch.cat([p["means"][:still], means]),
            torch.cat([p["log_scales"][:still], p["log_scales"][moving]]),
            torch.cat([p["quaternions"][:still], quats]),
            torch.cat([p["logit_opacities"][:still], p["logit_opacities"][moving]]),
            torch.cat([sh[:still], turned]),
        )
        return splats, torch.cat([torch.arange(still, device=self.device), moving])

    def clouds(self) -> tuple[GaussianCloud, dict[str, GaussianCloud]]:
        """Return the background in world coordinates and each actor in its box frame, as ordinary
        clouds; actors without Gaussians too.
        """
        p = {name: t.detach().cpu().double().numpy() for name, t in self.params.items()}
        sh = np.concatenate([p["sh_dc"], p["sh_rest"]], axis=1).astype(np.float32)
        first = np.searchsorted(self.node.numpy(), np.arange(len(self.actors) + 2))
        out: list[GaussianCloud] = []
        for low, high in pairwise(first.tolist()):
            part = slice(low, high)
            opacities = 1 / (1 + np.exp(-p["logit_opacities"][part]))
            shift = 0.0 if out else self.origin
            cloud, _ = GaussianCloud.cleaned(
                p["means"][part] + shift,
                p["quaternions"][part],
                np.exp(p["log_scales"][part]).astype(np.float32),
                opacities.astype(np.float32),
                sh[part],
            )
            out.append(cloud)
        return out[0], dict(zip(self.actors, out[1:], strict=True))


@lru_cache(maxsize=100_000)
def _harmonics(rotation: bytes, size: int) -> F64:
    """Return the block-diagonal matrix ``(size, size)`` that turns colour coefficients; kept,
    because every view comes again.
    """
    R = np.frombuffer(rotation).reshape(3, 3)
    out = np.eye(size)
    for degree in range(1, SH_SIZES.index(size) + 1):
        band = slice(degree * degree, (degree + 1) ** 2)
        out[band, band] = sh_rotation(R, degree)
    return out


BETA1 = 0.9
BETA2 = 0.999
# As in the published 3DGS code: gradients of single Gaussians are tiny.
EPS = 1e-15


class RowAdam:
    """Adam (Kingma and Ba 2015, Algorithm 1) on named tensors with one row per Gaussian.

    Attributes:
        first: Name to running mean of the gradient, like the tensor.
        second: Name to running mean of its square.
        step: Updates made.
    """

    def __init__(self, params: Mapping[str, Tensor]) -> None:
        self.first = {
            name: torch.zeros_like(parameter, requires_grad=False)
            for name, parameter in params.items()
        }
        self.second = {
            name: torch.zeros_like(parameter, requires_grad=False)
            for name, parameter in params.items()
        }
        self.step = 0

    @torch.no_grad()
    def update(self, params: Mapping[str, Tensor], rates: Mapping[str, float]) -> None:
        """Make one update in place from the tensors' gradients, which are cleared; a tensor without
        gradient stays as it is.
        """
        self.step += 1
        correct1 = 1 - BETA1**self.step
        correct2 = 1 - BETA2**self.step
        for name, p in params.items():
            if p.grad is None:
                continue
            m = self.first[name]
            v = self.second[name]
            m.lerp_(p.grad, 1 - BETA1)
            v.mul_(BETA2).addcmul_(p.grad, p.grad, value=1 - BETA2)
            p.addcdiv_(m, (v / correct2).sqrt_().add_(EPS), value=-rates[name] / correct1)
            p.grad = None

    def take(self, rows: Tensor, old: int) -> None:
        """Follow a choice of rows ``(M,)``; the moments of all behind the ``old`` ones begin at
        zero.
        """
        for moments in (self.first, self.second):
            for name, m in moments.items():
                chosen = m[rows]
                chosen[old:] = 0
                moments[name] = chosen


EXPOSURE_PULL = 1.0  # towards where a gain began, per update, in rates


class Exposure:
    """The gain of each view's colours over the model's, learned with Adam and held to where it
    began; it keeps its mean over the views.

    Args:
        begin: ``(V, 3)`` of red, green and blue.
        device: Where to keep it.

    Attributes:
        log_gain: ``(V, 3)``.
        adam: Its optimiser.
    """

    def __init__(self, begin: F64, device: str = "cpu") -> None:
        self.begin = upload(np.log(begin).astype(np.float32), device)
        self.log_gain = self.begin.clone().requires_grad_()
        self.adam = RowAdam({"log_gain": self.log_gain})

    def gain(self, view: int) -> Tensor:
        """Return the gain ``(3,)`` of a view, with graph."""
        return self.log_gain[view].exp()

    def gains(self) -> F64:
        """Return all gains ``(V, 3)``."""
        return self.log_gain.detach().cpu().double().exp().numpy()

    @torch.no_grad()
    def update(self, rate: float) -> None:
        """Make one update; a rate of 0 makes none."""
        if rate > 0:
            self.adam.update({"log_gain": self.log_gain}, {"log_gain": rate})
            self.log_gain.lerp_(self.begin, EXPOSURE_PULL * rate)
            self.log_gain -= (self.log_gain - self.begin).mean(dim=0)
        elif self.log_gain.grad is not None:
            self.log_gain.grad = None


def needles(log_scales: Tensor, weight: Tensor, ratio: float) -> Tensor:
    """Return by how much, in logarithms, the longest axes of Gaussians ``(N, 3)`` exceed ``ratio``
    times the middle ones: the mean by weight ``(N,)``.
    """
    axes = log_scales.sort(dim=1).values
    excess = (axes[:, 2] - axes[:, 1] - math.log(ratio)).clamp(min=0)
    return (excess * weight).sum() / weight.sum().clamp(min=1)


SPLIT_SHRINK = 1.6  # of scales when a Gaussian becomes two


class ScreenGradients:
    """Mean screen gradient of every Gaussian over the views that showed it.

    Attributes:
        total: ``(N,)`` sum of norms, in half image widths.
        count: ``(N,)`` views that showed it.
    """

    def __init__(self, n: int, device: str = "cpu") -> None:
        self.total, self.count = (torch.zeros(n, device=device) for _ in range(2))

    def add(self, rows: Tensor, norms: Tensor, weight: Tensor) -> None:
        """Count one view: rows ``(M,)`` of Gaussians, the norms ``(M,)``, and 1 for those that it
        shows, 0 for others.
        """
        self.total.index_add_(0, rows, norms)
        self.count.index_add_(0, rows, weight)

    def mean(self) -> Tensor:
        """Return ``(N,)``; 0 for what no view showed."""
        return self.total / self.count.clamp(min=1)


@torch.no_grad()
def densify(
    model: SplatModel,
    adam: RowAdam,
    gradients: ScreenGradients,
    recipe: SplatRecipe,
    extent_m: float,
    rng: np.random.Generator,
) -> None:
    """Clone small and split large Gaussians whose place the loss pulls at, then remove faint and
    oversized ones; in place.

    A clone starts where its original is. A split one is replaced by two, drawn from it, smaller by
    1.6. Where the cap leaves too little room the strongest gradients come first.
    """
    p = model.params
    pull, size, logits = (
        torch.from_numpy(part)
        for part in download(
            gradients.mean(), p["log_scales"].max(dim=1).values, p["logit_opacities"]
        )
    )
    wanted = torch.nonzero(pull >= recipe.densify_gradient)[:, 0]
    room = max(recipe.cap - len(model), 0)
    wanted = wanted[torch.sort(pull[wanted], descending=True, stable=True).indices[:room]]
    large = size[wanted] > math.log(max(recipe.dense_share * extent_m, 1e-9))
    clones = wanted[~large]
    splits = wanted[large]
    kept = torch.ones(len(model), dtype=torch.bool)
    kept[splits] = False
    old = torch.nonzero(kept)[:, 0]
    rows = torch.cat([old, clones, splits, splits])
    _take(model, adam, rows, len(old))
    halves = slice(len(old) + len(clones), len(rows))
    p = model.params
    draw = upload(rng.standard_normal(p["means"][halves].shape, dtype=np.float32), model.device)
    w, x, y, z = torch.nn.functional.normalize(p["quaternions"][halves], dim=1).unbind(1)
    along = draw * p["log_scales"][halves].exp()
    # v + 2 u x (u x v + w v) turns v by the quaternion (w, u).
    u = torch.stack([x, y, z], dim=1)
    turned = along + 2 * torch.linalg.cross(u, torch.linalg.cross(u, along) + w[:, None] * along)
    p["means"][halves] += turned
    p["log_scales"][halves] -= math.log(SPLIT_SHRINK)
    size = size[rows]
    logits = logits[rows]
    size[halves] -= math.log(SPLIT_SHRINK)
    faint = logits < math.log(recipe.prune_opacity / (1 - recipe.prune_opacity))
    oversized = size > math.log(recipe.prune_share * extent_m)
    left = torch.nonzero(~(faint | oversized))[:, 0]
    left = left[torch.sort(model.node[left], stable=True).indices]  # in the order of their nodes
    _take(model, adam, left, len(left))


def _take(model: SplatModel, adam: RowAdam, rows: Tensor, old: int) -> None:
    model.node = model.node[rows]
    rows = upload(rows, model.device)
    model.params = {
        name: parameter.detach()[rows].requires_grad_() for name, parameter in model.params.items()
    }
    adam.take(rows, old)
