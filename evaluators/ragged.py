"""Rows of different lengths, laid end to end in one array."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.types import I64, Bool


def pairs_of(flags: Bool) -> tuple[I64, I64]:
    """Return the rows and columns of the set flags ``(N, M)``, in order; several times as fast as `numpy.nonzero` where few are set."""
    row, column = np.divmod(np.flatnonzero(flags), flags.shape[1])
    return np.asarray(row), np.asarray(column)


def spans(first: I64, last: I64) -> tuple[I64, I64]:
    """Return for spans ``(N,)`` of an array, each from ``first`` to before ``last``, the span and the place of all their members.

    >>> [one.tolist() for one in spans(np.array([5, 0]), np.array([7, 3]))]
    [[0, 0, 1, 1, 1], [5, 6, 0, 1, 2]]
    """
    n = last - first
    span = np.repeat(np.arange(len(n)), n)
    return span, np.arange(len(span)) - np.repeat(np.cumsum(n) - n - first, n)
