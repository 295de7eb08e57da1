"""Carry Gaussians as a file states them, before anything is dropped or normalised."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from alpasim_plugin.gaussians.cloud import CleanReport, GaussianCloud
from alpasim_plugin.gaussians.sh import SH_SIZES

SH_C0 = 0.28209479177387814  # 1 / (2 sqrt(pi)): the constant basis function


class GaussianArrays(NamedTuple):
    """Decoded columns of a Gaussian file; values may still be NaN, infinite or unnormalised.

    Attributes:
        means: ``(N, 3)`` positions, file units and axes.
        quats: ``(N, 4)`` wxyz, as stored.
        scales: ``(N, 3)`` linear standard deviations.
        opacities: ``(N,)`` linear, 0..1.
        sh: ``(N, K, 3)`` colour coefficients, constant term first.
    """

    means: NDArray[np.floating]
    quats: NDArray[np.floating]
    scales: NDArray[np.floating]
    opacities: NDArray[np.floating]
    sh: NDArray[np.floating]


def sigmoid(x: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the logistic function in float64, without overflow for large negative input."""
    e = np.exp(-np.abs(np.asarray(x, dtype=np.float64)))
    return np.where(np.asarray(x) >= 0, 1.0 / (1.0 + e), e / (1.0 + e))


def logit(p: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the inverse of `sigmoid` in float64; 0 and 1 give minus and plus infinity."""
    q = np.asarray(p, dtype=np.float64)
    with np.errstate(divide="ignore"):
        return np.log(q) - np.log1p(-q)


def build_cloud(arrays: GaussianArrays) -> tuple[GaussianCloud, CleanReport]:
    """Clean decoded columns into a cloud; bands of harmonics above what can be drawn are left out and counted as repaired.

    Raises:
        InputError: Shapes disagree.
    """
    k = arrays.sh.shape[1]
    kept = min(k, SH_SIZES[-1])
    cloud, report = GaussianCloud.cleaned(*arrays[:4], arrays.sh[:, :kept])
    if k > kept:
        cause = f"colour harmonics beyond {kept} coefficients left out"
        report = replace(report, repaired={**report.repaired, cause: len(cloud)})
    return cloud, report
