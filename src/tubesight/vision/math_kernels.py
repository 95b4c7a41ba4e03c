"""Compiled mathematics: medians and small least squares (`fitting`)."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array
from tubesight.core.kernels import part, short_part

# What starts as `np.int64(0)` instead of 0 is compiled once: for 0 itself numba compiles what is called with it again.
Count = int | np.int64


@short_part
def length(x: float, y: float) -> float:
    """Length of a vector of pixels: no overflow is to be feared, and `np.hypot` takes five times longer."""
    return float(np.sqrt(x * x + y * y))


@part
def median(values: Array, count: Count) -> float:
    """Median of the first `count` values, which are reordered (Hoare's selection)."""
    middle = count // 2
    low, high = 0, count - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            break
    if count % 2 == 1:
        return float(values[middle])
    below = -np.inf
    for k in range(middle):
        below = max(below, values[k])
    return float(0.5 * (values[middle] + below))


@part
def solve(normal: Array, right: Array) -> None:
    """Solve small equations (K, K), (K, M) in place into `right` (Gauss-Jordan); NaN where they are singular."""
    size, columns = right.shape
    for i in range(size):
        pivot = i
        for j in range(i + 1, size):
            if abs(normal[j, i]) > abs(normal[pivot, i]):
                pivot = j
        if not abs(normal[pivot, i]) > 0:
            for j in range(size):
                for k in range(columns):
                    right[j, k] = np.nan
            return
        for j in range(size):
            normal[i, j], normal[pivot, j] = normal[pivot, j], normal[i, j]
        for j in range(columns):
            right[i, j], right[pivot, j] = right[pivot, j], right[i, j]
        for row in range(size):
            if row != i:
                factor = normal[row, i] / normal[i, i]
                for j in range(i, size):
                    normal[row, j] -= factor * normal[i, j]
                for j in range(columns):
                    right[row, j] -= factor * right[i, j]
    for i in range(size):
        for j in range(columns):
            right[i, j] /= normal[i, i]


@part
def parabola(places: Array, first: Count, t: Array, fade: float, order: int) -> Array:
    """Coefficients (order + 1, 2) of a polynomial through the places (N, >= 2) from `first` on at the parameters t.

    Weights are ``exp(2 t / fade)``.
    """
    normal, right = np.zeros((order + 1, order + 1)), np.zeros((order + 1, 2))
    for k in range(len(t)):
        weight = np.exp(2 * t[k] / fade)
        power = weight
        for i in range(order + 1):
            right[i, 0] += power * places[first + k, 0]
            right[i, 1] += power * places[first + k, 1]
            other = power
            for j in range(order + 1):
                normal[i, j] += other
                other *= t[k]
            power *= t[k]
    solve(normal, right)
    return right
