"""Fit Gaussians to posed views: the training loop of 3D Gaussian Splatting, readable from `fit`
downwards.
"""

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.core.devices import require_device, true_rows, upload
from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.core.files import parsing
from alpasim_plugin.core.files.arrays import START_ANEW, read_checkpoint
from alpasim_plugin.core.files.atomic import write_safetensors
from alpasim_plugin.core.image_metrics import CAP_DB, decibels
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.fit.model import (
    Exposure,
    Motion,
    RowAdam,
    ScreenGradients,
    SplatModel,
    densify,
    needles,
)
from alpasim_plugin.gaussians.fit.quality import SsimTarget
from alpasim_plugin.gaussians.fit.recipe import SplatRecipe
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction, sky_of
from alpasim_plugin.gaussians.fit.start import Start
from alpasim_plugin.gaussians.fit.views import PosedView, halved
from alpasim_plugin.gaussians.lens_camera import LensCamera, lens_key
from alpasim_plugin.gaussians.raster.rasterize_gradient import rasterize_gradient
from alpasim_plugin.gaussians.raster.rasterize_triton import compositor_of
from alpasim_plugin.gaussians.scene.sky import HEIGHT, WIDTH, Sky

Report = Callable[[int, Mapping[str, float]], None]  # (updates made, numbers of the last one)

DEPTH_CLIP = 0.5  # of a share: a measured depth may be wrong altogether
STATE_FILE = "state.safetensors"
SMALLEST_EXTENT_M = 5.0  # of a drive that hardly moves


@dataclass(frozen=True)
class Look:
    """A look at a model while it is fitted.

    Attributes:
        step: After so many updates.
        show: Given the model.
    """

    step: int
    show: Callable[[Reconstruction], None]


def fit(
    views: Sequence[PosedView],
    start: Start | GaussianCloud,
    recipe: SplatRecipe,
    *,
    scene_id: str = "",
    folder: Path | None = None,
    report: Report | None = None,
    look: Look | None = None,
    threads: int | None = None,
    device: str = "cpu",
) -> Reconstruction:
    """Fit a background, and the actors that ``start`` holds, to posed views.

    Args:
        views: To train on, all of them; see `held_out`. Those through a lens are fitted on the CPU
            alone, in the lens's own image.
        start: Gaussians to begin with: see `start_from_depth` and `cloud_from_points`. A cloud
            alone is a background without actors.
        recipe: Amounts, rates and schedule.
        scene_id: Key of the random streams, with ``recipe.seed``: order of views and splits.
        folder: Receives checkpoints; the same call with the same folder continues, and ends with
            the same bits. None keeps none.
        report: Called after every update with loss, psnr_db (of the training view just seen) and
            gaussians.
        look: Given the model as it is after a number of updates; a fit that goes on behind it does
            not come by there.
        threads: Of the CPU rasteriser; None leaves it as it is.
        device: Where to fit; a folder begun on one may go on on another. The host waits for a GPU
            once an update.

    Returns:
        Background, actors, the sky that the views saw, and their exposures.

    Raises:
        InputError: A folder begun with other views or another recipe.
        InfrastructureError: The loss or a gradient is not finite; the folder keeps the state before
            it; or there is no such device.
    """
    begin = Start(start, {}) if isinstance(start, GaussianCloud) else start
    with _one_torch_thread():
        run = SplatFit(views, begin, recipe, scene_id, threads, folder, device)
        while run.step < recipe.steps:
            numbers = run.update()
            if report is not None:
                report(run.step, numbers)
            if look is not None and run.step == look.step:
                look.show(run.reconstruction())
            is_due = run.step % recipe.save_every == 0 or run.step == recipe.steps
            if folder is not None and is_due:
                run.save()
        return run.reconstruction()


@contextmanager
def _one_torch_thread() -> Iterator[None]:
    """Let torch sum in one order, so that the model is the same on any number of cores; its share
    of a fit is too small to divide.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@dataclass(frozen=True, eq=False)
class _Target:
    """A view as the loop needs it; the camera is moved to the fit's frame."""

    name: str
    camera: PinholeCamera | LensCamera
    rgb: Tensor  # (H, W, 3) 0..1
    behind: Tensor | None  # (H, W, 3) sky
    sky: Tensor | None  # (H, W) 0 or 1
    counts: Tensor | None  # (H, W, 1) bool
    motion: Motion
    ssim: SsimTarget
    depth: tuple[Tensor, Tensor] | None  # numbers (K,) of the pixels of known depth, metres (K,)
    index: int  # of the view


class SplatFit:
    """The state of one fit: Gaussians, moments, screen gradients and the number of updates made."""

    def __init__(
        self,
        views: Sequence[PosedView],
        start: Start,
        recipe: SplatRecipe,
        scene_id: str,
        threads: int | None,
        folder: Path | None,
        device: str = "cpu",
    ) -> None:
        self.device = require_device(device)
        self.compositor = compositor_of(self.device)
        centres = np.array([view.camera.centre_world for view in views])
        origin = centres.mean(axis=0)
        self.recipe, self.scene_id, self.threads, self.folder = recipe, scene_id, threads, folder
        self.extent_m = max(
            1.1 * float(np.linalg.norm(centres - origin, axis=1).max()), SMALLEST_EXTENT_M
        )
        self.sky = sky_of(views)
        self.model = SplatModel.from_start(start, origin, recipe.sh_degree, self.device)
        self.adam = RowAdam(self.model.params)
        self.gradients = ScreenGradients(len(self.model), self.device)
        self.step = 0
        small = [halved(view) for view in views] if recipe.coarse_share > 0 else []
        self.targets, self.coarse = (
            [self._target(i, view) for i, view in enumerate(sized_views)]
            for sized_views in (views, small)
        )
        self.exposure = Exposure(np.array([view.gain for view in views]), self.device)
        self._facts = json.dumps(
            {"recipe": asdict(recipe), "scene": scene_id, "views": _digest(views, start)},
            sort_keys=True,
        )
        if folder is not None and os.path.exists(folder / STATE_FILE):
            self._load(folder / STATE_FILE)

    def update(self) -> dict[str, float]:
        """Learn from one view.

        Raises:
            InfrastructureError: The loss or a gradient is not finite.
        """
        target = self._next_view()
        recipe = self.recipe
        numbers = self._differentiate(target)
        if not math.isfinite(numbers["loss"]):
            self._stop(target, f"loss {numbers['loss']}")
        for name in self.model.params:
            if not math.isfinite(numbers.get(name, 0.0)):
                self._stop(target, f"a gradient of {name} that is not finite")
        rates = {
            "means": recipe.lr_means_at(self.step) * self.extent_m,
            "log_scales": recipe.lr_scales,
            "quaternions": recipe.lr_quaternions,
            "logit_opacities": recipe.lr_opacities,
            "sh_dc": recipe.lr_colour,
            "sh_rest": recipe.lr_colour / 20,
        }
        self.adam.update(self.model.params, rates)
        self.exposure.update(recipe.lr_exposure)
        self.step += 1
        if recipe.densifies_after(self.step):
            rng = stream(self.scene_id, recipe.seed, "fit.split", self.step)
            densify(self.model, self.adam, self.gradients, recipe, self.extent_m, rng)
            self.gradients = ScreenGradients(len(self.model), self.device)
        psnr = min(CAP_DB, decibels(max(numbers["mse"], 1e-30), peak=1.0))
        return {"loss": numbers["loss"], "psnr_db": psnr, "gaussians": len(self.model)}

    def reconstruction(self) -> Reconstruction:
        """Return the model as it is now."""
        background, actors = self.model.clouds()
        gains = tuple(
            (float(red), float(green), float(blue)) for red, green, blue in self.exposure.gains()
        )
        sky = self.sky or Sky(np.zeros((HEIGHT, WIDTH, 3), dtype=np.float32))
        return Reconstruction(background, actors, sky, gains)

    def _differentiate(self, target: _Target) -> dict[str, float]:
        """Give the parameters the gradients of a view's loss, and add up how strongly the view pulls at
        each Gaussian.

        Returns:
            ``loss``, ``mse``, and the sum of each parameter's gradient by its name; all in one copy
            from the device.
        """
        recipe = self.recipe
        splats, rows = self.model.placed(target.motion, recipe.sh_size_at(self.step))
        out = rasterize_gradient(
            splats,
            target.camera,
            background=target.behind,
            threads=self.threads,
            compositor=self.compositor,
        )
        lit = out.rgb * self.exposure.gain(target.index)
        rgb = lit if target.counts is None else torch.where(target.counts, lit, target.rgb)
        # (1 - w) L1 + w (1 - SSIM) (Kerbl et al. 2023, Eq. 7), the opacity that stands before the
        # sky, and the error of depth.
        w = recipe.ssim_weight
        loss = (1 - w) * (rgb - target.rgb).abs().mean() + w * (1 - target.ssim.ssim(rgb))
        if target.sky is not None:
            loss = loss + recipe.sky_weight * (out.alpha * target.sky).mean()
        if target.depth is not None and len(target.depth[0]):
            # Inverse depths differ by so much as a share of the true one, at most `DEPTH_CLIP`.
            pixels, depth = target.depth
            off = depth / out.depth.view(-1)[pixels].clamp(min=0.1) - 1
            loss = loss + recipe.depth_weight * off.abs().clamp(max=DEPTH_CLIP).mean()
        screen_rows, weight = true_rows(out.on_screen)
        gaussian_rows = out.index[screen_rows]
        if recipe.needle_weight > 0:
            loss = loss + recipe.needle_weight * needles(
                splats.log_scales[gaussian_rows], weight, recipe.needle_ratio
            )
        loss.backward()  # type: ignore[no-untyped-call]
        off = rgb.detach().clamp(0, 1) - target.rgb
        facts = {"loss": loss.detach(), "mse": off.double().square().mean(), "pairs": out.pairs}
        for name, p in self.model.params.items():
            if p.grad is not None:
                facts[name] = p.grad.sum()
        values = torch.stack([fact.double() for fact in facts.values()]).cpu().tolist()
        numbers = dict(zip(facts, values, strict=True))
        card = self.compositor
        if card is not None and not card.had_room(card.capacity, int(numbers["pairs"])):
            for tensor in (*self.model.params.values(), self.exposure.log_gain):
                tensor.grad = None
            return self._differentiate(target)
        assert out.uv.grad is not None  # the backward pass has run
        pull = out.uv.grad[screen_rows].norm(dim=1) * (target.camera.width / 2)
        self.gradients.add(rows[gaussian_rows], pull, weight)
        return numbers

    def save(self) -> None:
        """Write everything that later updates depend on, whole or not at all."""
        assert self.folder is not None
        self.folder.mkdir(parents=True, exist_ok=True)
        tensors = {"node": self.model.node, "log_gain": self.exposure.log_gain.detach()}
        tensors |= {"total": self.gradients.total, "count": self.gradients.count}
        for name, parts in self._named().items():
            tensors |= {f"{name}.{part}": value.detach() for part, value in parts.items()}
        steps = {"step": self.step, "adam": self.adam.step, "exposure": self.exposure.adam.step}
        meta = {name: str(step) for name, step in steps.items()} | {"facts": self._facts}
        write_safetensors(self.folder / STATE_FILE, tensors, meta)

    def _named(self) -> dict[str, dict[str, Tensor]]:
        """Return the tensors of the model and of both optimisers, by where they belong."""
        adam = self.adam
        exposure = self.exposure.adam
        moments = {"first": adam.first, "second": adam.second}
        return {
            "value": self.model.params,
            **moments,
            "exposure_first": exposure.first,
            "exposure_second": exposure.second,
        }

    def _load(self, path: Path) -> None:
        """Go on from a saved state.

        Raises:
            InputError: The folder was begun with other views, another start or another recipe, or
                its file is damaged.
        """
        meta, tensors = read_checkpoint(path, self._facts)
        with parsing(path, START_ANEW, "not a whole checkpoint"):
            self.model.node = tensors["node"]
            tensors = {name: part.to(self.device) for name, part in tensors.items()}
            for name, parts in self._named().items():
                parts.update({part: tensors[f"{name}.{part}"] for part in parts})
            for value in self.model.params.values():
                value.requires_grad_()
            self.exposure.log_gain = tensors["log_gain"].requires_grad_()
            self.gradients.total, self.gradients.count = tensors["total"], tensors["count"]
            self.step, self.adam.step = int(meta["step"]), int(meta["adam"])
            self.exposure.adam.step = int(meta["exposure"])

    def _next_view(self) -> _Target:
        """Return the view of this step: all in a random order, then all in another."""
        turn, i = divmod(self.step, len(self.targets))
        begins = self.step < self.recipe.coarse_share * self.recipe.steps
        rng = stream(self.scene_id, self.recipe.seed, "fit.order", turn)
        chosen = int(rng.permutation(len(self.targets))[i])
        return (self.coarse if begins else self.targets)[chosen]

    def _target(self, index: int, view: PosedView) -> _Target:
        camera = view.camera
        device = self.device
        T = camera.T_camera_world.copy()
        T[:3, 3] += T[:3, :3] @ self.model.origin
        rgb = upload(view.rgb, device).float() / 255
        depth = None
        if view.depth is not None and self.recipe.depth_weight > 0:
            measured = np.flatnonzero(view.depth)
            depth = upload(measured, device), upload(view.depth.reshape(-1)[measured], device)
        return _Target(
            view.name,
            replace(camera, T_camera_world=T),
            rgb,
            None if self.sky is None else upload(self.sky.image(camera), device),
            None if view.sky is None else upload(view.sky, device).float(),
            None if view.mask is None else upload(view.mask, device)[..., None],
            self.model.motion(view.actors),
            SsimTarget(rgb),
            depth,
            index,
        )

    def _stop(self, target: _Target, problem: str) -> None:
        if self.folder is not None:
            self.save()
        raise InfrastructureError(
            f"view {target.name!r}, update {self.step}: {problem}",
            "look at this view and its pose, or lower the recipe's rates; a folder that was given keeps the state before this update",
        )


def _digest(views: Sequence[PosedView], start: Start) -> str:
    """Return what the result depends on besides the recipe."""
    digest = hashlib.blake2b(digest_size=16)

    def add(array: np.ndarray[Any, Any] | None) -> None:
        digest.update(b"-" if array is None else np.ascontiguousarray(array).tobytes())

    for view in views:
        camera = view.camera
        if isinstance(camera, LensCamera):
            digest.update(repr(lens_key(camera.spec)).encode())
        for array in (
            view.rgb,
            camera.spec.K if isinstance(camera, LensCamera) else camera.K,
            camera.T_camera_world,
            view.sky,
            view.mask,
            view.depth,
            np.array(view.gain),
        ):
            add(array)
        for name, T in sorted(view.actors.items()):
            digest.update(name.encode())
            add(T)
    for name, cloud in (("", start.background), *sorted(start.actors.items())):
        digest.update(name.encode())
        for part in (cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.sh):
            add(part)
    return digest.hexdigest()
