"""Compiled twins: measuring edges (`edges`). Same names, same numbers.

Lines are rows (x, y) of their origins and directions; a window (low, step, L) gives the places of their samples.
Colours are triples (N, L, 3), as in `kernels`.
"""

from __future__ import annotations

import numpy as np

from tubesight.core import Array
from tubesight.core.kernels import part, short_part
from tubesight.vision import edges
from tubesight.vision.fetch_kernels import fetch_line
from tubesight.vision.line_kernels import Picture, sample_line
from tubesight.vision.math_kernels import Count, median

# Places of a line whose pixels are asked for before: it is a dozen pixels long.
_FETCHED = 3
ROOT_2_PI = float(np.sqrt(2 * np.pi))
LUMA, RED_BLUE = edges.metric(3, 0.0), edges.metric(3, 1.0) - edges.metric(3, 0.0)


@short_part
def clear_of_edge(sigma: float) -> tuple[float, float]:
    """Twin of `edges.clear_of_edge`."""
    return (
        max(edges.INSIDE_PX, edges.INSIDE_SIGMAS * (sigma - edges.SHARP_PX)),
        max(edges.OUTSIDE_PX, edges.OUTSIDE_SIGMAS * sigma),
    )


@short_part
def window(blur: float, depth: float) -> tuple[float, int]:
    """Twin of `edges.window`: the first place and the number of samples."""
    inside, outside = clear_of_edge(blur)
    low = max(-(inside + edges.HIGH_PX + edges.DEEPER_PX + edges.SLACK_PX), -depth)
    return low, int((outside + edges.LOW_PX + edges.SLACK_PX - low) / edges.SPACING_PX) + 2


@part
def colour_profiles(
    picture: Picture, origin: Array, way: Array, every: Count, low: float, step: float, count: int, apart: float
) -> tuple[Array, Array]:
    """Twin of `edges.colour_profiles` on every so many-th line: colours (3 N, L) of the picture and the empty scene.

    The samples are the mean of two lines at a distance to both sides, or of one (0).
    """
    image, scene, colours = picture
    rows = (len(origin) + every - 1) // every
    with_scene = scene.shape[0] > 0
    colour, behind = np.empty((3 * rows, count)), np.empty((3 * rows if with_scene else 0, count))
    at, high = np.empty((4, count)), low + step * (count - 1)
    for n in range(rows):
        m = n * every
        fetch_line(image, (origin[m, 0], origin[m, 1]), (way[m, 0], way[m, 1]), low, high, _FETCHED)
    for n in range(rows):
        m = n * every
        start, direction = (origin[m, 0], origin[m, 1]), (way[m, 0], way[m, 1])
        sample_line(image, start, direction, 0.0, low, step, apart, at, colour, 3 * n)
        if with_scene:
            sample_line(scene, start, direction, 0.0, low, step, apart, at, behind, 3 * n)
            for c in range(3):
                for k in range(count):
                    behind[3 * n + c, k] *= colours[6 + c]
    return colour, behind


@part
def interpolate(rows: Array, n: int, low: float, step: float, place: float) -> float:
    """Twin of `edges.interpolate` for one place on row n of (N, L)."""
    position = (place - low) * (1 / step)
    last = rows.shape[1] - 1
    if not (position >= 0 and position <= last):
        return np.nan
    left = min(int(position), last - 1)
    t = position - left
    return float(rows[n, left] * (1 - t) + rows[n, left + 1] * t)


@part
def mean_between(rows: Array, n: int, low: float, step: float, first: float, last: float) -> float:
    """Twin of `edges._mean_between` for row n of (N, L)."""
    position, gap = (first - low) * (1 / step), (last - first) * (1 / ((edges.PLATEAU_SAMPLES - 1) * step))
    end = rows.shape[1] - 1
    if not (position >= 0 and position + (edges.PLATEAU_SAMPLES - 1) * gap <= end):
        return np.nan
    total: float = 0.0
    for k in range(edges.PLATEAU_SAMPLES):
        at = position + k * gap
        left = np.uint64(min(np.int64(at), end - 1))
        t = at - left
        total += rows[n, left] * (1 - t) + rows[n, left + np.uint64(1)] * t
    return total / edges.PLATEAU_SAMPLES


@part
def running_median(rows: Array, row: int) -> None:
    """Twin of `edges._running_median` for one row of (R, N), in place, without a branch that depends on the values."""
    count, half = rows.shape[1], edges.NEIGHBOURS
    near, inf = np.empty(count + 2 * half), np.inf
    for k in range(count + 2 * half):
        m = abs(k - half)
        m = 2 * (count - 1) - m if m >= count else m
        value = rows[row, max(m, 0)]
        near[k] = value if m >= 0 and value == value else inf
    for n in range(count):
        a, b, c, d, e = near[n], near[n + 1], near[n + 2], near[n + 3], near[n + 4]
        found = int(a < inf) + int(b < inf) + int(c < inf) + int(d < inf) + int(e < inf)
        # The smallest three of five in order; what is missing comes last.
        a, b = min(a, b), max(a, b)
        d, e = min(d, e), max(d, e)
        c, e = min(c, e), max(c, e)
        c, d = min(c, d), max(c, d)
        b, e = min(b, e), max(b, e)
        a, d = min(a, d), max(a, d)
        a, c = min(a, c), max(a, c)
        b, d = min(b, d), max(b, d)
        b, c = min(b, c), max(b, c)
        lower = a if found <= 2 else (b if found <= 4 else c)
        upper = a if found <= 1 else (b if found <= 3 else c)
        rows[row, n] = 0.5 * (lower + upper) if found > 0 else np.nan


@part
def both_sides(colour: Array, low: float, step: float, edge: Array, sigma: float, gray: bool) -> tuple[Array, Array]:
    """Twin of `edges.both_sides`: colours (3, N) of tube and cloth."""
    inside, outside = clear_of_edge(sigma)
    rows, channels = len(colour) // 3, 1 if gray else 3
    tube, cloth = np.zeros((3, rows)), np.zeros((3, rows))
    for n in range(rows):
        e = edge[n]
        for c in range(channels):
            tube[c, n] = mean_between(colour, 3 * n + c, low, step, e - inside - edges.HIGH_PX, e - inside)
            cloth[c, n] = mean_between(colour, 3 * n + c, low, step, e + outside, e + outside + edges.LOW_PX)
    for c in range(channels):
        running_median(tube, c)
        running_median(cloth, c)
    return tube, cloth


@part
def local_share(
    colour: Array, behind: Array, tube: Array, cloth: Array, chroma: float, gray: bool, share: Array
) -> None:
    """Twin of `edges.local_share`; writes the share (N, L)."""
    rows, count = share.shape
    scene, weight = len(behind) > 0, chroma * chroma
    r = g = b = wr = wg = wb = 0.0
    for n in range(rows):
        for k in range(count):
            if k == 0 or scene:
                r, g, b = cloth[0, n], cloth[1, n], cloth[2, n]
                if scene:
                    r, g, b = behind[3 * n, k], behind[3 * n + 1, k], behind[3 * n + 2, k]
                u, v, w = tube[0, n] - r, tube[1, n] - g, tube[2, n] - b
                wr, wg, wb = u, v, w
                if not gray:
                    wr = wg = wb = 0.0
                    for d, off in ((0, u), (1, v), (2, w)):
                        wr += (LUMA[0, d] + weight * RED_BLUE[0, d]) * off
                        wg += (LUMA[1, d] + weight * RED_BLUE[1, d]) * off
                        wb += (LUMA[2, d] + weight * RED_BLUE[2, d]) * off
                power = max(wr * u + wg * v + wb * w, edges.POWER_MIN)
                wr, wg, wb = wr / power, wg / power, wb / power
            share[n, k] = (
                (colour[3 * n, k] - r) * wr + (colour[3 * n + 1, k] - g) * wg + (colour[3 * n + 2, k] - b) * wb
            )


@part
def half_level(
    share: Array, n: int, low: float, step: float, position: float, high: float, sigma: float, rise: float
) -> tuple[float, float]:
    """Twin of `edges._half_level` for row n of (N, L), with the plateau inside: crossing and fall."""
    inside, outside = clear_of_edge(sigma)
    ground = mean_between(share, n, low, step, position + outside, position + outside + edges.LOW_PX)
    drop = high - rise * (inside + edges.HIGH_PX / 2) - ground
    if not drop > 0:
        return np.nan, np.nan
    level = ground + drop / 2 + rise * sigma / ROOT_2_PI
    return crossing(share, n, low, step, position, max(2.0, 2.5 * sigma), level), drop


@part
def crossing(share: Array, n: int, low: float, step: float, position: float, reach: float, level: float) -> float:
    """Twin of `edges._crossing` for row n of (N, L)."""
    best, nearest = np.nan, np.inf
    first = max(int((position - reach - low) / step) - 1, 0)
    last = min(int((position + reach - low) / step) + 2, share.shape[1] - 1)
    for k in range(np.uint64(first), np.uint64(last)):
        above, below = share[n, k] - level, share[n, k + np.uint64(1)] - level
        if (above >= 0) & (below < 0):
            place = low + step * k + step * above / (above - below)
            off = abs(place - position)
            if off <= reach and off < nearest:
                best, nearest = place, off
    return best


@part
def apart(a: Array, b: Array) -> float:
    """Twin of `edges._apart`."""
    off, found = np.empty(len(a)), np.int64(0)
    for n in range(len(a)):
        if np.isfinite(a[n]) and np.isfinite(b[n]):
            off[found] = a[n] - b[n]
            found += 1
    return abs(median(off, found)) if found > 0 and found >= 0.3 * len(a) else 1.0


@part
def scatter(position: Array) -> float:
    """Twin of `edges._scatter`."""
    found, values = np.int64(0), np.empty(len(position))
    for n in range(len(position)):
        if np.isfinite(position[n]):
            values[found] = position[n]
            found += 1
    if found < 5:
        return np.inf
    for n in range(found - 2):
        values[n] = abs(values[n + 2] - 2 * values[n + 1] + values[n])
    return median(values, found - 2) + (len(position) - found) / len(position)


@part
def measure_way(
    share: Array, low: float, step: float, guess: Array, blur: float, passes: int, position: Array, drop: Array
) -> None:
    """Twin of `edges._measure`: writes positions and drops (N,)."""
    rows = len(share)
    inside, _ = clear_of_edge(blur)
    rise, high = np.empty((1, rows)), np.empty(rows)
    for n in range(rows):
        position[n] = guess[n]
    for _ in range(passes):
        for n in range(rows):
            first = position[n] - inside
            deep = first - edges.DEEPER_PX
            high[n] = mean_between(share, n, low, step, first - edges.HIGH_PX, first)
            rise[0, n] = (mean_between(share, n, low, step, deep - edges.HIGH_PX, deep) - high[n]) / edges.DEEPER_PX
        running_median(rise, 0)
        for n in range(rows):
            r = 0.0 if np.isnan(rise[0, n]) else min(max(rise[0, n], -edges.RISE_MAX), edges.RISE_MAX)
            position[n], drop[n] = half_level(share, n, low, step, position[n], high[n], blur, r)


@part
def doubt_of(share: Array, low: float, step: float, position: Array, blur: float) -> float:
    """Twin of the doubt in `edges._measure`: what taking shading for none would move the row by."""
    inside, _ = clear_of_edge(blur)
    flat = np.empty(len(share))
    for n in range(len(share)):
        first = position[n] - inside
        top = mean_between(share, n, low, step, first - edges.HIGH_PX, first)
        flat[n], _ = half_level(share, n, low, step, position[n], top, blur, 0.0)
    return edges.RISE_DOUBT * apart(position, flat)


@part
def measure_edges(
    colour: Array, behind: Array, low: float, step: float, guess: Array, blur: float, gray: bool
) -> tuple[Array, Array, float]:
    """Twin of `edges.measure_edges`: positions and drops (N,), and the doubt."""
    rows, count = len(colour) // 3, colour.shape[1]
    position, drop, share = np.empty(rows), np.empty(rows), np.empty((rows, count))
    tube, cloth = both_sides(colour, low, step, guess, blur, gray)
    local_share(colour, behind, tube, cloth, 1.0 if gray else edges.CHROMA[0], gray, share)
    measure_way(share, low, step, guess, blur, edges.PASSES, position, drop)
    if gray:
        return position, drop, doubt_of(share, low, step, position, blur)
    rough, second = scatter(position), np.empty((rows, count))
    help_needed = rough > edges.SMOOTH_PX
    other, other_drop = np.empty(rows), np.empty(rows)
    local_share(colour, behind, tube, cloth, edges.CHROMA[1], gray, second)
    start, passes = (guess, edges.PASSES) if help_needed else (position, 1)
    measure_way(second, low, step, start, blur, passes, other, other_drop)
    if help_needed and scatter(other) < rough:
        return other, other_drop, doubt_of(second, low, step, other, blur) + apart(other, position)
    return position, drop, doubt_of(share, low, step, position, blur) + apart(position, other)


@part
def blur_and_displacement(
    colour: Array, behind: Array, low: float, step: float, depth: float, gray: bool
) -> tuple[float, float]:
    """Twin of `edges.blur_and_displacement`."""
    rows = len(colour) // 3
    share = np.empty((rows, colour.shape[1]))
    tube, cloth = both_sides(colour, low, step, np.zeros(rows), edges.SIGMA_FIRST_PX, gray)
    local_share(colour, behind, tube, cloth, 1.0, gray, share)
    return blur_of(share, low, step, depth), displacement(share, low, step)


@part
def displacement(share: Array, low: float, step: float) -> float:
    """Twin of `edges._displacement`."""
    rows = len(share)
    places, found = np.empty(rows), np.int64(0)
    for n in range(rows):
        high = mean_between(share, n, low, step, -edges.NEAR_PX[1], -edges.NEAR_PX[0])
        level = (high + mean_between(share, n, low, step, edges.BEYOND_PX[0], edges.BEYOND_PX[1])) / 2
        place = crossing(share, n, low, step, 0.0, edges.BEYOND_PX[0], level)
        if np.isfinite(place):
            places[found] = place
            found += 1
    return median(places, found) if 2 * found > rows else 0.0


@part
def blur_of(share: Array, low: float, step: float, depth: float) -> float:
    """Twin of `edges._blur`."""
    rows = len(share)
    sigmas, found = np.empty(rows), np.int64(0)
    far = min(edges.FAR_PX, edges.FAR_SHARE * depth)
    for n in range(rows):
        fall = mean_between(share, n, low, step, -far - 1.0, -far)
        fall -= mean_between(share, n, low, step, far, far + 1.0)
        steepest = -np.inf
        for k in range(9):
            a = -2.5 + 0.5 * k
            steep = interpolate(share, n, low, step, a) - interpolate(share, n, low, step, a + 1.0)
            if np.isnan(steep):
                steepest = np.nan
                break
            steepest = max(steepest, steep)
        sigma = fall / (ROOT_2_PI * steepest)
        if np.isfinite(sigma) and sigma > 0:
            sigmas[found] = sigma
            found += 1
    if found == 0:
        return edges.SIGMA_FIRST_PX
    return min(max(median(sigmas, found), edges.SIGMA_RANGE_PX[0]), edges.SIGMA_RANGE_PX[1])
