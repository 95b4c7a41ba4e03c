"""Compiled twins: samples along a line, and their likeness to tube (`signal`). Same names, same numbers.

Colours are triples; a gray picture has (gray, 0, 0). The colours of a `tubesight.vision.signal.Signal` are eleven
numbers: tube, cloth, gain, and how far both forgive shading. Points and ways are pairs of numbers. What is called often
gets no slices of arrays: counting references to them takes longer than the work.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tubesight.core import Array, Image
from tubesight.core.kernels import part
from tubesight.vision.signal import LINEAR_LIGHT, NOISE, SHADING_CLOTH

Numbers = tuple[float, ...]

# Rows of the scratch of one scan: six of samples (colours of the picture and of the empty scene), their likeness to
# tube, the same smoothed, and places, drops and slopes of its falls, for both sides of a tube.
SHARE, SMOOTH, FALLS, WORK_ROWS = 6, 7, 8, 15


class Picture(NamedTuple):
    """A picture (H, W, C), the empty scene (or nothing: no rows), and the numbers of the colours."""

    image: Image
    behind: Image
    colours: Numbers


@part
def find_pixels(last: Numbers, origin: Numbers, way: Numbers, bend: float, low: float, step: float, at: Array) -> None:
    """Pixels before the samples of a line: columns, rows and weights of the next ones, in the last rows of `at`.

    The line bends to the left by so much per pixel; `last` are the last places in the picture. Outside the weights are
    NaN.
    """
    (x0, y0), (dx, dy), (right, bottom) = origin, way, last
    column, row, u, v = len(at) - 4, len(at) - 3, len(at) - 2, len(at) - 1
    # The last pixel has no next one.
    last_column, last_row = max(right - 1, 0.0), max(bottom - 1, 0.0)
    for k in range(at.shape[1]):
        a = low + step * k
        off = bend * a * a / 2
        x, y = x0 + a * dx + off * dy, y0 + a * dy - off * dx
        inside = (x >= 0.0) & (y >= 0.0) & (x <= right) & (y <= bottom)
        left, top = min(np.floor(x), last_column), min(np.floor(y), last_row)
        at[column, k], at[row, k] = (left, top) if inside else (0.0, 0.0)
        at[u, k], at[v, k] = (x - left, y - top) if inside else (np.nan, np.nan)


@part
def sample_line(
    image: Image,
    origin: Numbers,
    way: Numbers,
    bend: float,
    low: float,
    step: float,
    apart: float,
    at: Array,
    out: Array,
    row: int,
) -> None:
    """Twin of `signal.sample` along a line, into three rows of `out` (.., L) from `row` on; `at` is scratch.

    The samples are the mean of two lines at a distance to both sides, or of one (0). NaN outside the picture, and never
    a look outside of it.
    """
    height, width, channels = image.shape
    count, scratch = out.shape[1], len(at) - 4
    for c in range(3):
        for k in range(count):
            out[row + c, k] = 0.0 if image.size > 0 else np.nan
    if image.size == 0:
        return
    # Unsigned: an index that may be negative costs a comparison each time.
    next_column, next_row = np.uint64(width > 1), np.uint64(height > 1)
    lines = 2 if apart > 0 else 1
    for line in range(lines):
        aside = apart * (1 - 2 * line)
        start = origin[0] - aside * way[1], origin[1] + aside * way[0]
        find_pixels((width - 1.0, height - 1.0), start, way, bend, low, step, at)
        for k in range(count):
            left, top = np.uint64(np.int64(at[scratch, k])), np.uint64(np.int64(at[scratch + 1, k]))
            right, below, u, v = left + next_column, top + next_row, at[scratch + 2, k], at[scratch + 3, k]
            a = LINEAR_LIGHT[image[top, left, 0]] * (1 - u) + LINEAR_LIGHT[image[top, right, 0]] * u
            b = LINEAR_LIGHT[image[below, left, 0]] * (1 - u) + LINEAR_LIGHT[image[below, right, 0]] * u
            out[row, k] += (a * (1 - v) + b * v) / lines
            if channels >= 3:
                a = LINEAR_LIGHT[image[top, left, 1]] * (1 - u) + LINEAR_LIGHT[image[top, right, 1]] * u
                b = LINEAR_LIGHT[image[below, left, 1]] * (1 - u) + LINEAR_LIGHT[image[below, right, 1]] * u
                out[row + 1, k] += (a * (1 - v) + b * v) / lines
                a = LINEAR_LIGHT[image[top, left, 2]] * (1 - u) + LINEAR_LIGHT[image[top, right, 2]] * u
                b = LINEAR_LIGHT[image[below, left, 2]] * (1 - u) + LINEAR_LIGHT[image[below, right, 2]] * u
                out[row + 2, k] += (a * (1 - v) + b * v) / lines


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

    The line bends to the left by so much per pixel; `lines` are the number of parallel lines, and their distance from
    each other.
    """
    image, behind, colours = picture
    with_scene, count = behind.shape[0] > 0, work.shape[1]
    for k in range(count):
        work[SHARE, k] = 0.0
    for line in range(int(lines[0])):
        off = (line - (lines[0] - 1) / 2) * lines[1]
        start = origin[0] + off * way[1], origin[1] - off * way[0]
        sample_line(image, start, way, bend, low, step, 0.0, work, work, 0)
        if with_scene:
            sample_line(behind, start, way, bend, low, step, 0.0, work, work, 3)
        likeness(colours, work, count, with_scene)
    if lines[0] > 1:
        for k in range(count):
            work[SHARE, k] /= lines[0]
