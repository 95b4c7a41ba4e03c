"""Compiled twins: sampling, the walk along the tube, and its end (`signal`, `falls`, `pairs`, `walker`, `ending`).

Same names, same numbers. Colours are triples; a gray picture has (gray, 0, 0). The colours of a
`tubesight.vision.signal.Signal` are eleven numbers: tube, cloth, gain, and how far both forgive shading. Points and
ways are pairs of numbers. What is called often gets no slices of arrays: counting references to them takes longer than
the work.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tubesight.core import Array, Image
from tubesight.core.kernels import part, short_part
from tubesight.vision import ending, falls, pairs, walker
from tubesight.vision.math_kernels import Count, length, median, parabola
from tubesight.vision.signal import LINEAR_LIGHT, NOISE, SHADING_CLOTH

Numbers = tuple[float, ...]

# Rows of the scratch of one scan: six of samples (colours of the picture and of the empty scene), their likeness to
# tube, the same smoothed, and places, drops and slopes of its falls, for both sides of a tube.
SHARE, SMOOTH, FALLS, WORK_ROWS = 6, 7, 8, 14


class Picture(NamedTuple):
    """A picture (H, W, C), the empty scene (or nothing: no rows), and the numbers of the colours."""

    image: Image
    behind: Image
    colours: Numbers


@part
def find_pixels(
    last: Numbers, origin: Numbers, way: Numbers, bend: float, low: float, step: float, shift: float, at: Array
) -> None:
    """Pixels before the samples of a line: columns, rows and weights of the next ones, in the last rows of `at`.

    Each sample is first moved across the way to a row or column of pixels (`signal.sample_across`). The line bends to
    the left by so much per pixel; `last` are the last places in the picture. Outside the weight is NaN.
    """
    (x0, y0), (dx, dy), (right, bottom) = origin, way, last
    column, row, weight = len(at) - 3, len(at) - 2, len(at) - 1
    on_rows = abs(dx) >= abs(dy)
    lean = dy / dx if on_rows else dx / dy
    # The last pixel has no next one.
    last_column, last_row = (max(right - 1, 0.0), bottom) if on_rows else (right, max(bottom - 1, 0.0))
    for k in range(at.shape[1]):
        a = low + step * k
        off = bend * a * a / 2
        x, y = x0 + a * dx + off * dy, y0 + a * dy - off * dx
        across = y if on_rows else x
        line = np.floor(across + shift)
        moved = (line - across) * lean
        x, y = (x - moved, line) if on_rows else (line, y - moved)
        inside = (x >= 0.0) & (y >= 0.0) & (x <= right) & (y <= bottom)
        left, top = min(np.floor(x), last_column), min(np.floor(y), last_row)
        at[column, k], at[row, k] = (left, top) if inside else (0.0, 0.0)
        at[weight, k] = (x - left) + (y - top) if inside else np.nan


@part
def sample_line(
    image: Image,
    origin: Numbers,
    way: Numbers,
    bend: float,
    low: float,
    step: float,
    lines: int,
    at: Array,
    out: Array,
    row: int,
) -> None:
    """Twin of `signal.sample_across` along a line, into three rows of `out` (.., L) from `row` on; `at` is scratch.

    NaN outside the picture, and never a look outside of it.
    """
    height, width, channels = image.shape
    count, scratch = out.shape[1], len(at) - 3
    on_rows = abs(way[0]) >= abs(way[1])
    # Unsigned: an index that may be negative costs a comparison each time.
    next_column, next_row = np.uint64(on_rows and width > 1), np.uint64(not on_rows and height > 1)
    for c in range(3):
        for k in range(count):
            out[row + c, k] = 0.0 if image.size > 0 else np.nan
    for line in range(lines if image.size > 0 else 0):
        shift = line + (1 - lines / 2)
        find_pixels((width - 1.0, height - 1.0), origin, way, bend, low, step, shift, at)
        for k in range(count):
            left, top = np.uint64(np.int64(at[scratch, k])), np.uint64(np.int64(at[scratch + 1, k]))
            right, below, v = left + next_column, top + next_row, at[scratch + 2, k]
            u = 1 - v
            out[row, k] += LINEAR_LIGHT[image[top, left, 0]] * u + LINEAR_LIGHT[image[below, right, 0]] * v
            if channels >= 3:
                out[row + 1, k] += LINEAR_LIGHT[image[top, left, 1]] * u + LINEAR_LIGHT[image[below, right, 1]] * v
                out[row + 2, k] += LINEAR_LIGHT[image[top, left, 2]] * u + LINEAR_LIGHT[image[below, right, 2]] * v
    if lines > 1:
        for c in range(3):
            for k in range(count):
                out[row + c, k] /= lines


@part
def likeness(colours: Numbers, work: Array, count: int, with_scene: bool) -> None:
    """Likeness to tube of samples in the rows of `work`; added to the row `SHARE`."""
    t0, t1, t2, c0, c1, c2, g0, g1, g2, tube_forgives, cloth_forgives = colours
    noise, shading = NOISE * NOISE, SHADING_CLOTH * SHADING_CLOTH
    if with_scene:
        for k in range(count):
            u, v, w = work[0, k] - t0, work[1, k] - t1, work[2, k] - t2
            along = u * t0 + v * t1 + w * t2
            from_tube = u * u + v * v + w * w - along * along * tube_forgives
            r, g, b = work[3, k] * g0, work[4, k] * g1, work[5, k] * g2
            forgives = shading / (noise + shading * (r * r + g * g + b * b))
            u, v, w = work[0, k] - r, work[1, k] - g, work[2, k] - b
            along = u * r + v * g + w * b
            from_cloth = u * u + v * v + w * w - along * along * forgives
            work[SHARE, k] += from_cloth / (from_tube + from_cloth + noise)
    else:
        for k in range(count):
            u, v, w = work[0, k] - t0, work[1, k] - t1, work[2, k] - t2
            along = u * t0 + v * t1 + w * t2
            from_tube = u * u + v * v + w * w - along * along * tube_forgives
            u, v, w = work[0, k] - c0, work[1, k] - c1, work[2, k] - c2
            along = u * c0 + v * c1 + w * c2
            from_cloth = u * u + v * v + w * w - along * along * cloth_forgives
            work[SHARE, k] += from_cloth / (from_tube + from_cloth + noise)


@part
def profile(
    picture: Picture, origin: Numbers, way: Numbers, bend: float, low: float, step: float, lines: Numbers, work: Array
) -> None:
    """Likeness (L,) along a line, as `edges.profiles` gives it, in the row `SHARE` of `work`.

    The line bends to the left by so much per pixel; `lines` are the number of parallel lines, their distance from
    each other, and the number of neighbouring pixels that are averaged.
    """
    image, behind, colours = picture
    with_scene, count = behind.shape[0] > 0, work.shape[1]
    for k in range(count):
        work[SHARE, k] = 0.0
    for line in range(int(lines[0])):
        off = (line - (lines[0] - 1) / 2) * lines[1]
        start = origin[0] + off * way[1], origin[1] - off * way[0]
        sample_line(image, start, way, bend, low, step, int(lines[2]), work, work, 0)
        if with_scene:
            sample_line(behind, start, way, bend, low, step, int(lines[2]), work, work, 3)
        likeness(colours, work, count, with_scene)
    if lines[0] > 1:
        for k in range(count):
            work[SHARE, k] /= lines[0]


@short_part
def spacing(width_px: float) -> float:
    """Twin of `falls.spacing`."""
    return min(max(width_px / falls.SAMPLES_PER_WIDTH, falls.SPACING_MIN_PX), falls.SPACING_MAX_PX)


@short_part
def reach_of(width_px: float) -> float:
    """Twin of `falls.reach_of`."""
    return min(falls.REACH_PX, falls.REACH_WIDTHS * width_px)


@part
def find_falls(work: Array, low: float, step: float, reach_px: float, side: int) -> int:
    """Twin of `falls.falls` for the row `SHARE` of `work`: the number of peaks, and of each its place, drop and slope.

    They are written to the rows from `FALLS` on, another three for the other side.
    """
    last, first = work.shape[1] - 1, FALLS + 3 * side
    for k in range(last + 1):
        if np.isnan(work[SHARE, k]):
            work[SHARE, k] = 0.0
    for k in range(last + 1):
        outer = work[SHARE, max(k - 2, 0)] + work[SHARE, min(k + 2, last)]
        inner = work[SHARE, max(k - 1, 0)] + work[SHARE, min(k + 1, last)]
        work[SMOOTH, k] = (outer + 4 * inner + 6 * work[SHARE, k]) / 16
    reach = int(reach_px / step)
    found = 0
    before, here = 0.0, (work[SMOOTH, 0] - work[SMOOTH, 2]) / (2 * step)
    for k in range(1, last):
        after = (work[SMOOTH, k] - work[SMOOTH, k + 2]) / (2 * step) if k + 2 <= last else 0.0
        if here > before and here >= after and here > 0:
            offset = 0.5 * (before - after) / (before - 2 * here + after)
            work[first, found] = low + step * k + step * offset
            work[first + 1, found] = work[SMOOTH, max(k - reach, 0)] - work[SMOOTH, min(k + reach, last)]
            work[first + 2, found] = here
            found += 1
        before, here = here, after
    return found


@part
def nearest_fall(work: Array, low: float, step: float, drop_min: float) -> float:
    """Twin of `falls.nearest_fall` for the row `SHARE` of `work`."""
    found = find_falls(work, low, step, falls.REACH_PX, 0)
    steepest, best, nearest = 0.0, np.nan, np.inf
    for k in range(found):
        steepest = max(steepest, work[FALLS + 2, k])
    for k in range(found):
        off = abs(work[FALLS, k])
        if work[FALLS + 2, k] >= 0.5 * steepest and work[FALLS + 1, k] > drop_min and off < nearest:
            best, nearest = work[FALLS, k], off
    return best


@part
def best_pair(
    picture: Picture, middle: Numbers, way: Numbers, width: float, known_width: bool, low: float, high: float
) -> tuple[float, float, float, bool]:
    """Twin of `pairs._best_pair`."""
    step = spacing(width)
    work = np.empty((WORK_ROWS, int((high - low) / step) + 2))
    peaks, other_peaks, seen = 0, 0, False
    for side in range(2):
        sign = 1.0 - 2 * side
        profile(picture, middle, (sign * way[1], -sign * way[0]), 0.0, low, step, (1.0, 0.0, 1.0), work)
        for k in range(work.shape[1]):
            seen |= work[SHARE, k] > pairs.SHARE_SEEN
        peaks, other_peaks = other_peaks, find_falls(work, low, step, reach_of(width), side)
    best, left, right = -np.inf, 0.0, 0.0
    for i in range(peaks):
        for j in range(other_peaks):
            a, b = work[FALLS, i], work[FALLS + 3, j]
            one, other = work[FALLS + 1, i], work[FALLS + 4, j]
            if one > pairs.DROP_MIN and other > pairs.DROP_MIN and a + b > pairs.WIDTH_MIN_PX:
                off = (a - b) / 2 / (pairs.MIDDLE_OFF * width + pairs.OFF_PX)
                score = min(one, 1.0) + min(other, 1.0) - off * off
                if known_width:
                    off = (a + b - width) / (pairs.WIDTH_OFF * width + pairs.OFF_PX)
                    score -= off * off
                if score > best:
                    best, left, right = score, a, b
    return best, left, right, seen


@short_part
def wide(width: float, known_width: bool) -> tuple[float, float]:
    """Twin of `pairs.wide`."""
    if not known_width:
        reach = width * (0.5 + pairs.MARGIN_WIDTHS) + pairs.MARGIN_PX
        return -reach, reach
    most = np.sqrt(2.0)
    off = most * (pairs.MIDDLE_OFF * width + pairs.OFF_PX) + most / 2 * (pairs.WIDTH_OFF * width + pairs.OFF_PX)
    return width / 2 - off - pairs.END_PX, width / 2 + off + pairs.END_PX


@part
def find_pair(
    picture: Picture, middle: Numbers, way: Numbers, width: float, known_width: bool
) -> tuple[float, float, float]:
    """Twin of `pairs.find_pair`: middle and width, NaN where there is none."""
    near, half = pairs.NEAR_WIDTHS * width + pairs.NEAR_PX, width / 2
    score, left, right, seen = -np.inf, 0.0, 0.0, True
    for turn in range(0 if known_width else 1, 2):
        low, high = wide(width, known_width) if turn else (half - near, half + near)
        score, left, right, seen = best_pair(picture, middle, way, width, known_width, low, high)
        if not score < pairs.SCORE_SURE or not seen:
            break
    if not score >= 0:
        return np.nan, np.nan, np.nan
    off = (left - right) / 2
    return middle[0] + way[1] * off, middle[1] - way[0] * off, left + right


@part
def predict(scans: Array, count: Count, place: float, start: Numbers, way: Numbers) -> tuple[Numbers, Numbers]:
    """Twin of `walker._predict`; the scans (N, 4) are x, y, width and place."""
    if count < 3:
        x, y, since = start[0], start[1], 0.0
        if count > 0:
            x, y, since = scans[count - 1, 0], scans[count - 1, 1], scans[count - 1, 3]
        return (x + way[0] * (place - since), y + way[1] * (place - since)), way
    used = min(count, walker.HISTORY)
    first = count - used
    unit = (scans[count - 1, 3] - scans[first, 3]) / used
    t = np.empty(used)
    for k in range(used):
        t[k] = (scans[first + k, 3] - place) / unit
    c = parabola(scans, first, t, walker.FADE, 2 if used >= 5 else 1)
    size = np.sqrt(c[1, 0] * c[1, 0] + c[1, 1] * c[1, 1])
    return (c[0, 0], c[0, 1]), (c[1, 0] / size, c[1, 1] / size)


@short_part
def last_width(scans: Array, count: Count) -> float:
    """Median width of the last of `count` scans (N, 4)."""
    used = min(count, walker.WIDTHS)
    values = np.empty(used)
    for k in range(used):
        values[k] = scans[count - used + k, 2]
    return median(values, used)


@part
def walk(
    picture: Picture, start: tuple[float, float], direction: Numbers, width_px: float, from_base: bool
) -> tuple[Array, Array, Array]:
    """Twin of `walker.walk`, `walker.walk_from_base` (nothing without a start): middles (N, 2), widths (N,), gaps."""
    scans, gaps = np.empty((walker.MAX_STEPS, 4)), np.empty(walker.MAX_STEPS)
    count = gap_count = np.int64(0)
    x, y, size = start[0], start[1], width_px
    if from_base:
        for k in range(pairs.FIRST_COUNT):
            place = (pairs.FIRST_WIDTHS + k * pairs.FIRST_STEP) * width_px
            middle: Numbers = (start[0] + place * direction[0], start[1] + place * direction[1])
            x, y, size = find_pair(picture, middle, direction, width_px, True)
            if not np.isnan(size):
                break
    start = x, y
    width_px = size
    step = min(max(walker.STEP_WIDTHS * width_px, walker.STEP_MIN_PX), walker.STEP_MAX_PX)
    place, stride, waiting, alone = 0.0, step, 0.0, False
    for _ in range(0 if np.isnan(size) else walker.MAX_STEPS):
        middle, way = predict(scans, count, place, start, direction)
        width = last_width(scans, count) if count > 0 else width_px
        x, y, size = find_pair(picture, middle, way, width, True)
        if not np.isnan(size):
            scans[count, 0], scans[count, 1], scans[count, 2], scans[count, 3] = x, y, size, place
            count += 1
            alone = waiting > 0
            if alone:
                gaps[gap_count] = waiting / width
                gap_count += 1
            stride, waiting = step, 0.0
        elif waiting == 0 and stride == step and count > 0:
            stride = step / 2
            place -= step
        else:
            if alone:
                count -= 1
                gap_count -= 1
                alone = False
            stride = step
            waiting = place - (scans[count - 1, 3] if count > 0 else 0.0)
            if waiting > max(walker.GAP_WIDTHS * width, walker.GAP_MIN_PX):
                break
        place += stride
    middles, widths = np.empty((count, 2)), np.empty(count)
    for k in range(count):
        middles[k, 0], middles[k, 1], widths[k] = scans[k, 0], scans[k, 1], scans[k, 2]
    return middles, widths, gaps[:gap_count]


@part
def last_way(middles: Array) -> tuple[Numbers, Numbers, float]:
    """Twin of `ending.last_way`."""
    last = len(middles) - 1
    used = min(last + 1, ending.LAST)
    t, scale = np.empty(used), 1e-9
    for k in range(used):
        n = last + 1 - used + k
        t[k] = -length(middles[n, 0] - middles[last, 0], middles[n, 1] - middles[last, 1])
        scale = max(scale, -t[k])
    for k in range(used):
        t[k] /= scale
    order = 2 if used >= 6 else 1
    c = parabola(middles, last + 1 - used, t, np.inf, order)
    size = np.sqrt(c[1, 0] * c[1, 0] + c[1, 1] * c[1, 1])
    way = (c[1, 0] / size, c[1, 1] / size)
    bend = 2 * (c[2, 0] * way[1] - c[2, 1] * way[0]) / (scale * scale) if order == 2 else 0.0
    return (c[0, 0], c[0, 1]), way, bend


@part
def end_of_tube(
    picture: Picture, start: Numbers, way: Numbers, bend: float, width: float, reach: float
) -> tuple[int, float]:
    """Twin of `ending.end_of_tube`."""
    step, border = spacing(width), ending.BORDER_PX
    count = int((reach + width) / step) + 2
    height, columns, _ = picture.image.shape
    before, known, level, some = np.empty(count), np.int64(0), np.nan, np.empty((WORK_ROWS, ending.CHUNK))
    quiet = max(int(ending.QUIET_WIDTHS * width / step), ending.QUIET_SAMPLES)
    silent = unseen = 0
    for k in range(count):
        a = -width + step * k
        if k % ending.CHUNK == 0:
            profile(picture, start, way, bend, a, step, (float(ending.LINES), ending.SPREAD * width, 1.0), some)
        share = some[SHARE, k % ending.CHUNK]
        if a <= 0:
            if not np.isnan(share):
                before[known] = share
                known += 1
            continue
        if np.isnan(level):
            if known == 0:
                return ending.BORDER, np.nan
            level = median(before, known) * ending.SHARE
        # The last `quiet` samples, from one at `first` on, decide whether the tube ended there.
        silent = 0 if share >= level else silent + 1
        unseen = quiet if np.isnan(share) else max(unseen - 1, 0)
        first = -width + step * (k - quiet + 1)
        if not first > 0:
            continue
        if unseen > 0:
            sideways = bend * first * first / 2
            x, y = start[0] + first * way[0] + sideways * way[1], start[1] + first * way[1] - sideways * way[0]
            if not (border <= x <= columns - 1 - border and border <= y <= height - 1 - border):
                return ending.BORDER, np.nan
        elif silent >= quiet:
            return ending.FOUND, first
    return ending.NO_END, np.nan


@part
def find_end(
    picture: Picture, middles: Array, widths: Array, reach_widths: float
) -> tuple[int, Numbers, Numbers, float]:
    """Twin of `ending.find_end`: outcome, place, unit way and width."""
    start, way, bend = last_way(middles)
    last = np.empty(min(len(widths), ending.WIDTHS))
    for k in range(len(last)):
        last[k] = widths[len(widths) - len(last) + k]
    width = median(last, len(last))
    outcome, end = end_of_tube(picture, start, way, bend, width, reach_widths * width)
    hx, hy = way[0] + bend * end * way[1], way[1] - bend * end * way[0]
    size, sideways = np.sqrt(hx * hx + hy * hy), bend * end * end / 2
    place = start[0] + end * way[0] + sideways * way[1], start[1] + end * way[1] - sideways * way[0]
    return outcome, place, (hx / size, hy / size), width
