"""Compiled twin of `walker.measure`: scans along a followed tube. Same names, same numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tubesight.core import Array, Mask
from tubesight.core.kernels import part
from tubesight.vision import edges, walker
from tubesight.vision.edge_kernels import blur_and_displacement, colour_profiles, measure_edges, running_median, window
from tubesight.vision.line_kernels import Picture
from tubesight.vision.math_kernels import Count, length, median
from tubesight.vision.pairs import DROP_MIN

Rows = NDArray[np.int64]


@part
def scans_along(places: Array, widths: Array) -> tuple[Array, Array, Array, int]:
    """Twin of `walker._scans`: middles and unit ways (N, 2), half widths (N,), and how many of the rows are used."""
    last = len(places) - 1
    chord, steps, slope = np.zeros(last + 1), np.empty(last), np.empty((last + 1, 2))
    for k in range(last):
        steps[k] = max(length(places[k + 1, 0] - places[k, 0], places[k + 1, 1] - places[k, 1]), 1e-9)
        chord[k + 1] = chord[k] + steps[k]
    for k in range(last + 1):
        a, b = max(k - 1, 0), min(k + 1, last)
        for i in range(2):
            slope[k, i] = (places[b, i] - places[a, i]) / (chord[b] - chord[a])
    count = max(min(int(chord[last] / walker.FINE_STEP_PX) + 1, walker.SCANS), 2)
    longest = walker.GAP_STEPS * median(steps.copy(), last)
    middle, way, half = np.empty((count, 2)), np.empty((count, 2)), np.empty(count)
    k = used = 0
    for n in range(count):
        s = n * (chord[last] / (count - 1))
        while k < last - 1 and chord[k + 1] <= s:
            k += 1
        if not steps[k] <= longest:
            continue
        h = steps[k]
        t = (s - chord[k]) / h
        for i in range(2):
            a, b, p, q = places[k, i], places[k + 1, i], slope[k, i] * h, slope[k + 1, i] * h
            square, cube = 3 * (b - a) - 2 * p - q, 2 * (a - b) + p + q
            middle[used, i] = a + t * (p + t * (square + t * cube))
            way[used, i] = p + t * (2 * square + 3 * t * cube)
        size = length(way[used, 0], way[used, 1])
        way[used, 0] /= size
        way[used, 1] /= size
        half[used] = (widths[k] * (1 - t) + widths[k + 1] * t) / 2
        used += 1
    return middle, way, half, used


@part
def in_line(offset: Array, side: Count, keep: Mask, rows: Rows) -> None:
    """Twin of `walker._in_line` for one row of (2, N); clears `keep` (K,) where an edge is out of line."""
    count, few = len(rows), len(rows) <= walker.LINE_NEIGHBOURS
    off, values, running = np.empty(count), np.empty(count), np.empty((1, count))
    for n in range(count):
        values[n] = running[0, n] = offset[side, rows[n]]
    if few:
        running[0, :] = median(values, np.int64(count)) if count > 0 else 0.0
    else:
        running_median(running, 0)
    for n in range(count):
        off[n] = abs(offset[side, rows[n]] - running[0, n])
    for n in range(count):
        values[n] = off[n]
    limit = max(walker.LINE_PX, walker.LINE_SIGMAS * median(values, np.int64(count))) if count > 0 else 0.0
    for n in range(count):
        keep[n] = keep[n] and off[n] <= limit


@part
def put(middle: Array, ways: Array, sides: Array, origin: Array) -> None:
    """Write where the lines of both sides begin: so far (2, N) from the middles on their ways (2, N, 2)."""
    for side in range(2):
        for n in range(sides.shape[1]):
            for i in range(2):
                origin[side, n, i] = middle[n, i] + ways[side, n, i] * sides[side, n]


@part
def measure(picture: Picture, middles: Array, widths: Array) -> tuple[Array, float, float, float, float]:
    """Twin of `walker.measure`: edges (N, 2, 2), blur, the doubts of both rows, and how far outwards they were."""
    middle, way, half, rows = scans_along(middles, widths)
    if rows == 0:
        return np.empty((0, 2, 2)), edges.SIGMA_FIRST_PX, 1.0, 1.0, 0.0
    gray, step, every = picture.image.shape[2] < 3, edges.SPACING_PX, walker.BLUR_EVERY
    ways, sides, depth = np.empty((2, rows, 2)), np.empty((2, rows)), np.inf
    for n in range(rows):
        depth = min(depth, half[n])
        for side in range(2):
            sign = 1.0 - 2 * side
            ways[side, n, 0], ways[side, n, 1] = sign * way[n, 1], -sign * way[n, 0]
            sides[side, n] = half[n]
    origin, off, outwards = np.empty((2, rows, 2)), np.empty(2), 0.0
    low, blur = -edges.FAR_PX - 1.0, np.inf
    count = int(-2 * low / step) + 2
    for again in range(2):
        put(middle, ways, sides, origin)
        for side in range(2):
            lines = colour_profiles(picture, origin[side], ways[side], every, low, step, count, edges.LINE_PX)
            sigma, off[side] = blur_and_displacement(lines[0], lines[1], low, step, depth, gray)
            blur = min(blur, sigma)
        if again > 0 or not (off[0] + off[1]) / 2 > walker.WALK_OFF_PX:
            break
        outwards, blur = (off[0] + off[1]) / 2, np.inf
        for side in range(2):
            for n in range(rows):
                sides[side, n] += off[side]
    low, count = window(blur, depth)
    offset, doubt, good = np.empty((2, rows)), np.empty(2), np.ones(rows, dtype=np.bool_)
    for side in range(2):
        lines = colour_profiles(picture, origin[side], ways[side], np.int64(1), low, step, count, edges.LINE_PX)
        position, drop, doubt[side] = measure_edges(lines[0], lines[1], low, step, np.zeros(rows), blur, gray)
        for n in range(rows):
            offset[side, n] = position[n] + sides[side, n]
            good[n] = good[n] and np.isfinite(position[n]) and drop[n] > DROP_MIN
    index, used = np.empty(rows, dtype=np.int64), 0
    for n in range(rows):
        if good[n]:
            index[used] = n
            used += 1
    index = index[:used]
    keep = np.ones(used, dtype=np.bool_)
    for side in range(2):
        in_line(offset, side, keep, index)
    found, used = np.empty((len(index), 2, 2)), 0
    for k in range(len(index)):
        if keep[k]:
            n = index[k]
            for side in range(2):
                for i in range(2):
                    found[used, side, i] = middle[n, i] + ways[side, n, i] * offset[side, n]
            used += 1
    return found[:used], blur, doubt[0], doubt[1], outwards
