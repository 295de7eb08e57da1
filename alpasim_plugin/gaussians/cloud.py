"""Hold a set of 3D Gaussians, as a file states them or cleaned for drawing; clean, move and join
such sets.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import matrix_from_quat, quat_from_matrix
from alpasim_plugin.core.types import F64, Bool, FloatArray
from alpasim_plugin.gaussians.constants import EPS2D_PX2, LOG_SCALE_LIMIT, MIP_PX2
from alpasim_plugin.gaussians.sh import SH_SIZES, rotate_sh

LARGEST_SCALE_M = np.exp(LOG_SCALE_LIMIT) * 1.0001  # room for float32 rounding


@dataclass(frozen=True)
class CleanReport:
    """Count what `GaussianCloud.cleaned` removed and repaired.

    Attributes:
        n_input: Gaussians offered.
        n_kept: Gaussians that remain.
        dropped: Cause to count; each dropped Gaussian is counted once, under the first cause that
            applies in the order listed.
        repaired: Cause to count of Gaussians kept with a changed value.
        notes: What the file says that was applied, or is not drawn.
    """

    n_input: int
    n_kept: int
    dropped: Mapping[str, int]
    repaired: Mapping[str, int]
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Say it in one line."""
        parts = [f"{count} {cause}" for cause, count in self.dropped.items() if count]
        fixed = [f"{count} {cause}" for cause, count in self.repaired.items() if count]
        return (
            f"{self.n_kept} of {self.n_input} Gaussians kept"
            + (f"; dropped: {', '.join(parts)}" if parts else "")
            + (f"; repaired: {', '.join(fixed)}" if fixed else "")
        )


@dataclass(frozen=True, eq=False)
class GaussianCloud:
    """A set of N Gaussians in one frame; its arrays are read-only.

    Attributes:
        means: ``(N, 3)`` centres, metres; float64 keeps UTM-sized coordinates exact.
        quats: ``(N, 4)`` wxyz, Gaussian axes to the cloud's frame; need not be unit, must not be
            zero.
        scales: ``(N, 3)`` standard deviations along the Gaussian's axes, metres, linear.
        opacities: ``(N,)`` linear, 0..1.
        sh: ``(N, K, 3)`` colour coefficients, K = (degree + 1)^2 in 1, 4, 9, 16; RGB = 0.5 + sum_k
            Y_k(view direction) sh_k.
        antialias_px2: Variance of the 2D filter that the model was trained with and that an
            opacity pays for (Mip-Splatting, equation 10), pixels^2: ``MIP_PX2`` or ``EPS2D_PX2``;
            0 for a model trained without antialiasing.

    Raises:
        InputError: Shapes disagree, K is not a full degree or the filter is another. Values are not inspected here: see
            `cleaned`.
    """

    means: FloatArray
    quats: FloatArray
    scales: FloatArray
    opacities: FloatArray
    sh: FloatArray
    antialias_px2: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        shapes = {}
        for name in ("means", "quats", "scales", "opacities", "sh"):
            value = np.asarray(getattr(self, name))
            if value.dtype not in (np.float32, np.float64):
                value = value.astype(np.float64)
            # A view that cannot be written through: what is prepared for rendering stays true to
            # the cloud.
            value = value.view()
            value.flags.writeable = False
            object.__setattr__(self, name, value)
            shapes[name] = value.shape
        n = self.means.shape[0] if self.means.ndim else -1
        colours = [(n, size, 3) for size in SH_SIZES]
        wanted = ((n, 3), (n, 4), (n, 3), (n,))
        if n < 0 or tuple(shapes.values())[:4] != wanted or shapes["sh"] not in colours:
            raise InputError(
                f"{n} means: {', '.join(f'{name} {shape}' for name, shape in shapes.items())}",
                "give means (N,3), quats (N,4), scales (N,3), opacities (N,) and sh (N,K,3) with K in 1, 4, 9, 16",
            )
        if self.antialias_px2 not in (0.0, MIP_PX2, EPS2D_PX2):
            raise InputError(
                f"a 2D filter of {self.antialias_px2} px^2", f"give 0, {MIP_PX2} or {EPS2D_PX2}"
            )

    def __len__(self) -> int:
        """Return N."""
        return int(self.means.shape[0])

    @property
    def sh_degree(self) -> int:
        """Return the degree of the colour coefficients, 0..3."""
        return SH_SIZES.index(self.sh.shape[1])

    @classmethod
    def empty(cls, sh_size: int = 1) -> GaussianCloud:
        """Return a cloud of no Gaussians."""
        return cls(
            np.zeros((0, 3)),
            np.zeros((0, 4)),
            np.zeros((0, 3)),
            np.zeros(0),
            np.zeros((0, sh_size, 3)),
        )

    @classmethod
    def cleaned(
        cls,
        means: npt.ArrayLike,
        quats: npt.ArrayLike,
        scales: npt.ArrayLike,
        opacities: npt.ArrayLike,
        sh: npt.ArrayLike,
    ) -> tuple[GaussianCloud, CleanReport]:
        """Build a cloud from untrusted arrays: drop what cannot be drawn, repair what can, count
        both.

        Dropped: a mean, opacity or colour coefficient that is not finite, a NaN or negative scale,
            a scale whose logarithm exceeds 20
        (infinite ones included), a quaternion of length zero or not finite. Repaired: scales below
        ``exp(-20)`` m are raised to it (they draw as a dot either way), opacities outside [0, 1]
        are clipped. Quaternions are normalised in float64.

        Returns:
            The cloud, float64 means and quaternions, other arrays in the type given; and the
            report.

        Raises:
            InputError: Shapes disagree.

        Example:
            >>> cloud, report = GaussianCloud.cleaned([[0, 0, np.nan]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[[0, 0, 0]]])
            >>> len(cloud), report.dropped["non-finite mean"]
            (0, 1)
        """
        raw = cls(*(np.asarray(array) for array in (means, quats, scales, opacities, sh)))
        n = len(raw)
        faults = raw._faults()
        # Scaling by the largest component first keeps tiny quaternions of float32 files from
        # underflowing in the square.
        q = raw.quats.astype(np.float64)
        with np.errstate(invalid="ignore", divide="ignore"):
            unit = q / np.abs(q).max(axis=1, initial=0.0, keepdims=True)
            unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
        low = np.exp(-LOG_SCALE_LIMIT)
        keep = np.ones(n, dtype=bool)
        dropped = {}
        for cause, bad in faults.items():
            dropped[cause] = int(np.count_nonzero(bad & keep))
            keep &= ~bad
        scales_kept = raw.scales[keep]
        opacities_kept = raw.opacities[keep]
        repaired = {
            "scale raised to exp(-20) m": int(np.count_nonzero(np.any(scales_kept < low, axis=1))),
            "opacity clipped to [0, 1]": int(
                np.count_nonzero((opacities_kept < 0) | (opacities_kept > 1))
            ),
        }
        cloud = cls(
            raw.means[keep].astype(np.float64),
            unit[keep],
            np.maximum(scales_kept, np.asarray(low, dtype=scales_kept.dtype)),
            np.clip(opacities_kept, 0, 1),
            raw.sh[keep],
        )
        return cloud, CleanReport(n, len(cloud), dropped, repaired)

    def _faults(self) -> dict[str, Bool]:
        """Return which Gaussians ``(N,)`` cannot be drawn, by cause."""
        return {
            "non-finite mean": ~np.isfinite(self.means).all(axis=1),
            "non-finite opacity": ~np.isfinite(self.opacities),
            "non-finite colour": ~np.isfinite(self.sh).all(axis=(1, 2)),
            "NaN or negative scale": (np.isnan(self.scales) | (self.scales < 0)).any(axis=1),
            "overflowing scale": (self.scales > LARGEST_SCALE_M).any(axis=1),
            "zero quaternion": ~self.quats.any(axis=1),
            "non-finite quaternion": ~np.isfinite(self.quats).all(axis=1),
        }

    def require_drawable(self) -> None:
        """Raise where any Gaussian could not be drawn.

        Raises:
            InputError: Names the first cause and its count; `cleaned` removes such Gaussians.
        """
        outside = (self.opacities < 0) | (self.opacities > 1)
        for cause, bad in {**self._faults(), "opacity outside 0..1": outside}.items():
            if bad.any():
                raise InputError(
                    f"a cloud of {len(self)} Gaussians: {np.count_nonzero(bad)} with {cause}, the first at index {np.argmax(bad)}",
                    "build it with GaussianCloud.cleaned, which drops and counts them",
                )

    def take(self, index: npt.ArrayLike | slice) -> GaussianCloud:
        """Return the Gaussians chosen by an index or mask array, in that order, or a view of those
        of a slice.
        """
        i = index if isinstance(index, slice) else np.asarray(index)
        return GaussianCloud(
            self.means[i],
            self.quats[i],
            self.scales[i],
            self.opacities[i],
            self.sh[i],
            antialias_px2=self.antialias_px2,
        )

    def transformed(self, T: F64) -> GaussianCloud:
        """Return the cloud moved by a rigid transform, colours turning with the object.

        Args:
            T: ``(4, 4)`` rigid transform applied to the cloud.

        Raises:
            InputError: ``T`` is not rigid.
        """
        require_rigid(T)
        rotation = np.asarray(T[:3, :3], dtype=np.float64)
        means = self.means.astype(np.float64) @ rotation.T + T[:3, 3]
        quats = quat_multiply(quat_from_matrix(rotation), self.quats.astype(np.float64))
        return replace(self, means=means, quats=quats, sh=rotate_sh(self.sh, rotation))

    def rotations(self) -> F64:
        """Return ``(N, 3, 3)`` float64 rotation matrices, quaternions normalised."""
        q = self.quats.astype(np.float64)
        return matrix_from_quat(q / np.linalg.norm(q, axis=1, keepdims=True))

    @staticmethod
    def concatenate(clouds: Sequence[GaussianCloud]) -> GaussianCloud:
        """Join clouds in the order given (which decides equal depths); lower degrees are padded
        with zero coefficients.

        Raises:
            InputError: They were trained with different antialiasing.
        """
        if not clouds:
            return GaussianCloud.empty()
        filters = {cloud.antialias_px2 for cloud in clouds}
        if len(filters) > 1:
            raise InputError(
                f"clouds of different antialiasing: {sorted(filters)} px^2",
                "draw them as parts of a scene, each with its own",
            )
        size = max(cloud.sh.shape[1] for cloud in clouds)
        rows = []
        for c in clouds:
            sh = np.pad(c.sh, ((0, 0), (0, size - c.sh.shape[1]), (0, 0)))
            rows.append((c.means, c.quats, c.scales, c.opacities, sh))
        columns = [np.concatenate(column) for column in zip(*rows, strict=True)]
        return GaussianCloud(*columns, antialias_px2=filters.pop())


def quat_multiply(a: F64, b: F64) -> F64:
    """Return the Hamilton product of wxyz quaternions ``(..., 4)``: the rotation b followed by
    a.
    """
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def require_rigid(T: npt.ArrayLike, name: str = "a transform") -> None:
    """Raise `InputError` unless ``T`` is a finite ``(4, 4)`` rigid transform (rotation to 1e-5, no
    reflection, no scale).
    """
    m = np.asarray(T, dtype=np.float64)
    fault = None
    if m.shape != (4, 4):
        fault = f"shape {m.shape}"
    elif not np.isfinite(m).all():
        fault = "a value that is not finite"
    elif np.abs(m[:3, :3] @ m[:3, :3].T - np.eye(3)).max() > 1e-5 or np.linalg.det(m[:3, :3]) < 0:
        fault = (
            f"an upper-left block that is no rotation (determinant {np.linalg.det(m[:3, :3]):.6g})"
        )
    elif np.abs(m[3] - [0, 0, 0, 1]).max() > 1e-9:
        fault = f"last row {m[3].tolist()}"
    if fault:
        raise InputError(
            f"{name}: {fault}",
            "give a (4, 4) rotation and translation, metres, column vectors",
        )


def all_rigid(T: F64) -> bool:
    """Return whether all of ``(N, 4, 4)`` pass `require_rigid`; cheap for many."""
    rotation = T[:, :3, :3]
    gram = rotation @ rotation.transpose(0, 2, 1)
    turns = np.all(np.abs(gram - np.eye(3)) <= 1e-5) and np.all(np.linalg.det(rotation) > 0)
    return bool(turns and np.isfinite(T).all() and np.all(np.abs(T[:, 3] - [0, 0, 0, 1]) <= 1e-9))


class GaussianArrays(NamedTuple):
    """Decoded columns of a Gaussian file; values may still be NaN, infinite or unnormalised.

    Attributes:
        means: ``(N, 3)`` positions, file units and axes.
        quats: ``(N, 4)`` wxyz, as stored.
        scales: ``(N, 3)`` linear standard deviations.
        opacities: ``(N,)`` linear, 0..1.
        sh: ``(N, K, 3)`` colour coefficients, constant term first.
        notes: What the file says that was applied, or is not drawn.
        antialias_px2: See `GaussianCloud`.
    """

    means: FloatArray
    quats: FloatArray
    scales: FloatArray
    opacities: FloatArray
    sh: FloatArray
    notes: tuple[str, ...] = ()
    antialias_px2: float = 0.0


def sigmoid(x: FloatArray) -> F64:
    """Return the logistic function in float64, without overflow for large negative input."""
    e = np.exp(-np.abs(np.asarray(x, dtype=np.float64)))
    return np.where(np.asarray(x) >= 0, 1.0 / (1.0 + e), e / (1.0 + e))


def logit(p: FloatArray) -> F64:
    """Return the inverse of `sigmoid` in float64; 0 and 1 give minus and plus infinity."""
    q = np.asarray(p, dtype=np.float64)
    with np.errstate(divide="ignore"):
        return np.log(q) - np.log1p(-q)


def build_cloud(arrays: GaussianArrays) -> tuple[GaussianCloud, CleanReport]:
    """Clean decoded columns into a cloud; bands of harmonics above what can be drawn are left out
    and noted.

    Raises:
        InputError: Shapes disagree.
    """
    k = arrays.sh.shape[1]
    kept = min(k, SH_SIZES[-1])
    cloud, report = GaussianCloud.cleaned(*arrays[:4], arrays.sh[:, :kept])
    notes = arrays.notes
    if arrays.antialias_px2:
        notes += (
            f"trained with antialiasing: drawn so, with a filter of {arrays.antialias_px2} px^2",
        )
    if k > kept:
        left_out = float(np.nanmax(np.abs(arrays.sh[:, kept:]), initial=0.0))
        notes += (
            f"harmonics of degree {SH_SIZES.index(kept) + 1} and above are left out; the largest coefficient is {left_out:.2g}",
        )
    return replace(cloud, antialias_px2=arrays.antialias_px2), replace(report, notes=notes)


def placed_cloud(cloud: GaussianCloud, T_world_file: F64) -> GaussianCloud:
    """Move a cloud by a similarity transform; its colours turn with it."""
    scale = float(np.cbrt(np.linalg.det(T_world_file[:3, :3])))
    rigid = np.asarray(T_world_file, dtype=np.float64).copy()
    rigid[:3, :3] /= scale
    return replace(cloud, means=cloud.means * scale, scales=cloud.scales * scale).transformed(rigid)
