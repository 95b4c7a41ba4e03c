"""Compiled twins: the walk along the tube, and its end (`falls`, `pairs`, `walker`, `ending`)."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array, Image
from tubesight.core.kernels import part, short_part
from tubesight.vision import ending, falls, pairs, walker
from tubesight.vision.fetch_kernels import fetch_line
from tubesight.vision.line_kernels import FALLS, SHARE, SMOOTH, WORK_ROWS, Numbers, Picture, profile
from tubesight.vision.math_kernels import Count, length, median, parabola

# Places on each side of a scan whose pixels are asked for one scan before: every third pixel.
_FETCHED = 6


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
        profile(picture, middle, (sign * way[1], -sign * way[0]), 0.0, low, step, (1.0, 0.0), work)
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
def fetch_ahead(image: Image, middle: Numbers, way: Numbers, width: float) -> None:
    """Ask for the pixels of a scan across the tube, near its edges."""
    near, half = pairs.NEAR_WIDTHS * width + pairs.NEAR_PX, width / 2
    for side in range(2):
        sign = 1.0 - 2 * side
        fetch_line(image, middle, (sign * way[1], -sign * way[0]), half - near, half + near, _FETCHED)


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
        fetch_ahead(picture.image, (middle[0] + step * way[0], middle[1] + step * way[1]), way, width)
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
            profile(picture, start, way, bend, a, step, (float(ending.LINES), ending.SPREAD * width), some)
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
