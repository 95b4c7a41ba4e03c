"""Compiled twin of `tubesight.geometry.matching.cheapest_way`."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array, Indices
from tubesight.core.kernels import compiled


@compiled
def cheapest_way(cost: Array, skip: float) -> Indices:
    """Twin of `tubesight.geometry.matching.cheapest_way`."""
    n, m = cost.shape
    total = np.full((n + 1, m + 1), np.inf)
    total[0, 0] = 0.0
    for i in range(n):
        for j in range(m):
            alone = min(total[i, j + 1], total[i + 1, j]) + cost[i, j] + skip
            total[i + 1, j + 1] = min(total[i, j] + 2 * cost[i, j], alone)
    way = np.empty((n + m - 1, 2), np.int64)
    i, j, k = n - 1, m - 1, n + m - 2
    way[k, 0], way[k, 1] = i, j
    while i > 0 or j > 0:
        alone = cost[i, j] + skip
        both, one, other = total[i, j] + 2 * cost[i, j], total[i, j + 1] + alone, total[i + 1, j] + alone
        if both <= one and both <= other:
            i, j = i - 1, j - 1
        elif one <= other:
            i -= 1
        else:
            j -= 1
        k -= 1
        way[k, 0], way[k, 1] = i, j
    return way[k:].copy()
