"""Two ordered rows of places matched as a whole: the cheapest monotone way through their square."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array, Indices
from tubesight.core.kernels import COMPILED


def monotone_way(cost: Array, skip: float) -> Indices:
    """Cheapest monotone way through a matrix of costs, from its first to its last corner (Sakoe & Chiba 1978).

    A step to the next place of both rows counts the cost there twice, a step along one row alone once and `skip`: ways
    of all shapes have the same weight, and ties go to the diagonal.

    Parameters
    ----------
    cost
        (N, M) of matching place i with place j, finite.

    Returns
    -------
    Indices
        (K, 2) matched places, both columns ascending.
    """
    if not COMPILED:
        return cheapest_way(cost, skip)
    # Its twin imports this module's types.
    from tubesight.geometry import matching_kernels

    return matching_kernels.cheapest_way(np.array(cost, dtype=np.float64, order="C"), float(skip))


def cheapest_way(cost: Array, skip: float) -> Indices:
    """`monotone_way` in NumPy: readable, and the judge of its compiled twin."""
    n, m = cost.shape
    total = np.full((n + 1, m + 1), np.inf)
    total[0, 0] = 0.0
    # Cells of one antidiagonal do not depend on each other.
    for k in range(n + m - 1):
        i = np.arange(max(0, k - m + 1), min(n, k + 1))
        j = k - i
        alone = np.minimum(total[i, j + 1], total[i + 1, j]) + cost[i, j] + skip
        total[i + 1, j + 1] = np.minimum(total[i, j] + 2 * cost[i, j], alone)
    i, j = n - 1, m - 1
    way = [(i, j)]
    while i or j:
        alone = cost[i, j] + skip
        options = (total[i, j] + 2 * cost[i, j], total[i, j + 1] + alone, total[i + 1, j] + alone)
        step = int(np.argmin(options))
        i, j = i - (step != 2), j - (step != 1)
        way.append((i, j))
    return np.array(way[::-1], dtype=np.int64)
