"""Scenes of splats for training in float64, and gradients of them by slow ways that can be
trusted.
"""

from dataclasses import dataclass

import numpy as np
import torch

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.gaussians import GaussianCloud, PinholeCamera
from alpasim_plugin.gaussians.cloud import logit, sigmoid
from alpasim_plugin.gaussians.raster.rasterize_gradient import rasterize_gradient
from alpasim_plugin.gaussians.raster.rasterize_reference import (
    composite_reference,
    project_gaussians,
)
from alpasim_plugin.gaussians.raster.splats import Splats


def cloud_of(splats):
    """Return splats as a cloud: float64 means, other fields float32, quaternions normalised; all
    must be drawable.
    """
    means, log_scales, quaternions, logits, sh = (
        t.detach().cpu().double().numpy()
        for t in (
            splats.means,
            splats.log_scales,
            splats.quaternions,
            splats.logit_opacities,
            splats.sh,
        )
    )
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        unit = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
        arrays = (unit, np.exp(log_scales), sigmoid(logits), sh)
    cloud = GaussianCloud(means, *(a.astype(np.float32) for a in arrays))
    cloud.require_drawable()
    return cloud


FIELDS = ("means", "log_scales", "quaternions", "logit_opacities", "sh")
_DEPTH_SHARE = 0.05  # weight of depths, which are metres, beside colours


@dataclass(frozen=True)
class Scene:
    """Splats as float64 arrays, a camera and a background."""

    means: np.ndarray
    log_scales: np.ndarray
    quaternions: np.ndarray
    logit_opacities: np.ndarray
    sh: np.ndarray
    camera: PinholeCamera
    background: tuple[float, float, float] = (0.3, 0.6, 0.2)
    depth_weight: float = _DEPTH_SHARE

    def arrays(self):
        return {name: getattr(self, name) for name in FIELDS}


def scene(
    means,
    scales,
    cam,
    *,
    opacities=0.6,
    quaternions=None,
    sh=None,
    seed=0,
    **other,
):
    """Build a scene; what is not given is random, and every number is one that float32 can hold."""
    rng = stream("gradient-tests", seed, "scene")
    means = np.atleast_2d(np.asarray(means, dtype=float))
    n = len(means)
    arrays = (
        means,
        np.log(np.broadcast_to(np.asarray(scales, dtype=float), (n, 3))),
        rng.normal(size=(n, 4))
        if quaternions is None
        else np.broadcast_to(np.asarray(quaternions, dtype=float), (n, 4)),
        logit(np.broadcast_to(np.asarray(opacities, dtype=float), (n,))),
        rng.normal(size=(n, 4, 3)) * 0.2 if sh is None else np.asarray(sh, dtype=float),
    )
    return Scene(*(a.astype(np.float32).astype(np.float64) for a in arrays), cam, **other)


def weights_of(cam):
    """Return ``(H, W, 5)`` random weights of colour, alpha and depth: the loss is the weighted
    sum.
    """
    return stream("gradient-tests", 0, "weights").normal(size=(cam.height, cam.width, 5))


def weighted(out, s):
    """Return the loss of rendered tensors."""
    image = torch.cat([out.rgb, out.alpha[..., None], s.depth_weight * out.depth[..., None]], dim=2)  # type: ignore[attr-defined]
    return (image * torch.as_tensor(weights_of(s.camera), dtype=image.dtype)).sum()


def kernel_gradients(s, compositor=None):
    """Return the gradients of the compiled kernels, and the image that they belong to."""
    tensors = {
        k: torch.tensor(a, dtype=torch.float32, requires_grad=True) for k, a in s.arrays().items()
    }
    background = torch.tensor(s.background, requires_grad=True)
    out = rasterize_gradient(
        Splats(**tensors), s.camera, background=background, threads=1, compositor=compositor
    )
    weighted(out, s).backward()
    leaves = {**tensors, "background": background}
    return {name: t.grad.double().numpy() for name, t in leaves.items()}, out


def reference_loss(s, values):
    """Return the loss of the float64 reference at other values of the parameters."""
    cloud = GaussianCloud(
        values["means"],
        values["quaternions"],
        np.exp(values["log_scales"]),
        sigmoid(values["logit_opacities"]),
        values["sh"],
    )
    behind = np.asarray(values["background"], dtype=float).reshape(1, 1, 3)
    colour, alpha, depth = composite_reference(project_gaussians(cloud, s.camera), s.camera, behind)
    image = np.concatenate([colour, alpha[..., None], s.depth_weight * depth[..., None]], axis=2)
    return float((image * weights_of(s.camera)).sum())


def central_differences(function, value, step):
    """Return the gradient of a function by an array that it reads, changing it in place and
    back.
    """
    out = np.zeros_like(value)
    for at in np.ndindex(value.shape):
        kept = value[at]
        value[at] = kept + step
        high = function()
        value[at] = kept - step
        out[at] = (high - function()) / (2 * step)
        value[at] = kept
    return out


def numeric_gradients(s):
    """Return central finite differences of the float64 reference."""
    values = {
        **{k: a.copy() for k, a in s.arrays().items()},
        "background": np.array(s.background, dtype=float),
    }
    return {
        name: central_differences(lambda: reference_loss(s, values), array, 1e-6)
        for name, array in values.items()
    }


def assert_close(found, wanted, share, names=(*FIELDS, "background")):
    """Compare row by row: each Gaussian's error in a field is at most ``share`` of the largest
    gradient of that row and field.
    """
    for name in names:
        a, b = (
            np.atleast_2d(g[name]).reshape(len(np.atleast_2d(g[name])), -1) for g in (found, wanted)
        )
        assert np.isfinite(a).all(), name
        scale = np.maximum(np.abs(b).max(axis=1), 1e-3 * np.abs(b).max(initial=1e-12))
        error = np.abs(a - b).max(axis=1) / np.maximum(scale, 1e-12)
        assert error.max(initial=0.0) <= share, (
            f"{name}: row {error.argmax()} off by {error.max():.2g} of its largest, {a[error.argmax()]}"
        )
