"""The Frechet distance against closed forms and against scipy's matrix square root, singular
covariances included.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import linalg

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.lab.learned_metrics.frechet import frechet_distance, halves


def by_square_root(a: np.ndarray, b: np.ndarray, ridge: float = 0.0) -> float:
    """Heusel et al. 2017 by scipy: the plain definition, for regular covariances."""
    s1, s2 = np.cov(a, rowvar=False), np.cov(b, rowvar=False)
    eye = ridge * np.eye(a.shape[1])
    root = linalg.sqrtm((s1 + eye) @ (s2 + eye))
    return float(((a.mean(0) - b.mean(0)) ** 2).sum() + np.trace(s1 + s2) - 2 * np.trace(root).real)


def by_symmetric_roots(a: np.ndarray, b: np.ndarray) -> float:
    """The same through eigenvalues of ``S1^(1/2) S2 S1^(1/2)``, which also holds where covariances
    are singular.
    """
    s1, s2 = np.cov(a, rowvar=False), np.cov(b, rowvar=False)
    values, vectors = np.linalg.eigh(s1)
    root = (vectors * np.sqrt(values.clip(min=0))) @ vectors.T
    inner = np.linalg.eigvalsh(root @ s2 @ root).clip(min=0)
    return float(
        ((a.mean(0) - b.mean(0)) ** 2).sum() + np.trace(s1 + s2) - 2 * np.sqrt(inner).sum()
    )


def draw(seed: int, n: int, d: int, scale: float = 1.0, shift: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return scale * rng.standard_normal((n, d)) @ np.diag(1 / np.arange(1, d + 1)) + shift


def test_against_scipy_where_covariances_are_regular() -> None:
    a, b = draw(0, 300, 12), draw(1, 200, 12, 1.4, 0.3)
    assert frechet_distance(a, b) == pytest.approx(by_square_root(a, b), rel=1e-9)
    assert frechet_distance(a, b, ridge=1e-3) == pytest.approx(by_square_root(a, b, 1e-3), rel=1e-9)


@pytest.mark.parametrize(("n1", "n2", "d"), [(5, 7, 24), (24, 5, 24), (2, 2, 8)])
def test_with_fewer_vectors_than_dimensions(n1: int, n2: int, d: int) -> None:
    a, b = draw(2, n1, d), draw(3, n2, d, 0.7, -0.2)
    assert frechet_distance(a, b) == pytest.approx(by_symmetric_roots(a, b), rel=1e-6)
    tiny = by_square_root(a, b, 1e-9)
    assert frechet_distance(a, b) == pytest.approx(tiny, rel=1e-3)


def test_a_constant_feature_and_repeated_vectors_are_no_trouble() -> None:
    a, b = draw(4, 40, 6), draw(5, 40, 6)
    a[:, 2], b[:, 2] = 1.0, 3.0  # no variance: only the means differ there
    without = frechet_distance(np.delete(a, 2, 1), np.delete(b, 2, 1))
    assert frechet_distance(a, b) == pytest.approx(without + 4.0, rel=1e-9)
    same = np.tile(a[:1], (5, 1))
    assert frechet_distance(same, same + 2.0) == pytest.approx(4.0 * 6)


def test_closed_form_for_diagonal_gaussians() -> None:
    grid = np.array([-1.0, 1.0])
    a = np.stack(np.meshgrid(2 * grid, 3 * grid), axis=-1).reshape(-1, 2)
    b = np.stack(np.meshgrid(5 * grid + 1, 1 * grid), axis=-1).reshape(-1, 2)
    n = 4 / 3  # variance over n - 1 of four points at plus and minus one
    assert frechet_distance(a, b) == pytest.approx(1.0 + n * ((2 - 5) ** 2 + (3 - 1) ** 2))


def test_zero_on_itself_symmetric_and_unchanged_by_rotation() -> None:
    a, b = draw(6, 30, 10), draw(7, 25, 10, 1.2)
    turn = linalg.qr(draw(8, 10, 10))[0]
    assert frechet_distance(a, a) == pytest.approx(0.0, abs=1e-9)
    assert frechet_distance(a, b) == pytest.approx(frechet_distance(b, a), rel=1e-10)
    assert frechet_distance(a @ turn, b @ turn) == pytest.approx(frechet_distance(a, b), rel=1e-9)


def test_what_cannot_be_compared_is_refused() -> None:
    a = draw(9, 10, 4)
    for bad in (a[:1], a[:, :3], np.where(a > 1, np.nan, a) * np.nan):
        with pytest.raises(EvaluatorError, match="Frechet"):
            frechet_distance(a, bad)


def test_halves_need_four_clips() -> None:
    clips = [draw(i, 5, 3) for i in range(4)]
    assert halves(clips[:3]) is None
    assert halves(clips) == pytest.approx(
        frechet_distance(np.concatenate(clips[::2]), np.concatenate(clips[1::2]))
    )
