"""Least squares with two or three unknowns."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array


def solve(design: Array, right: Array, weight: Array | None = None) -> Array:
    """Least squares by the normal equations: ``(A^T W A) x = A^T W b``.

    Parameters
    ----------
    design, right, weight
        A (N, K) with columns of similar size, b (N,) or (N, M), and the diagonal of W (N,).

    Returns
    -------
    Array
        (K,) or (K, M); NaN where the equations are singular.
    """
    weighted = design if weight is None else design * weight[:, None]
    try:
        return np.asarray(np.linalg.solve(weighted.T @ design, weighted.T @ right))
    except np.linalg.LinAlgError:
        return np.full((design.shape[1], *right.shape[1:]), np.nan)
