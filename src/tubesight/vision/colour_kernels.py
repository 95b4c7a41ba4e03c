"""Compiled twins: learning the colours of tube and background (`silhouette`). Same names, same numbers."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array, Image
from tubesight.core.kernels import part, short_part
from tubesight.vision import silhouette
from tubesight.vision.line_kernels import Numbers, sample_line
from tubesight.vision.math_kernels import median
from tubesight.vision.signal import LINEAR_LIGHT, NOISE, SHADING_CLOTH, SHADING_TUBE

reason = part(silhouette.reason)


@part
def middle_colour(
    image: Image, start: Numbers, way: Numbers, width: float, offsets: Array, count: int, colour: Array
) -> None:
    """Twin of `silhouette._middle_colour` beside the first piece of a tube at the first `count` offsets, in widths."""
    n = silhouette.ALONG_COUNT
    values, some, found = np.empty((3, n * count)), np.empty((3, n)), np.int64(0)
    for i in range(count):
        first_piece(image, start, way, width, offsets[i] * width, some)
        for k in range(n):
            if not np.isnan(some[0, k]):
                for c in range(3):
                    values[c, found] = some[c, k]
                found += 1
    for c in range(3):
        colour[c] = median(values[c], found) if found >= silhouette.SAMPLES_MIN else np.nan


@part
def first_piece(image: Image, start: Numbers, way: Numbers, width: float, offset: float, out: Array) -> None:
    """Sample (3, L) along the first piece of a tube, so far to its left."""
    low, high = silhouette.ALONG_WIDTHS
    step = (high - low) * width / (silhouette.ALONG_COUNT - 1)
    origin = start[0] + offset * way[1], start[1] - offset * way[0]
    sample_line(image, origin, way, 0.0, low * width, step, 0.0, np.empty((4, out.shape[1])), out, 0)


@part
def brightness(image: Image, behind: Image, colours: Array) -> None:
    """Twin of `silhouette._gain`; writes the third row of (3, 3)."""
    height, width, channels = image.shape
    n = silhouette.GAIN_GRID
    values = np.empty(n * n)
    for c in range(channels):
        found = np.int64(0)
        for i in range(n):
            row = (2 * i + 1) * height // (2 * n)
            for j in range(n):
                column = (2 * j + 1) * width // (2 * n)
                empty = LINEAR_LIGHT[behind[row, column, c]]
                if empty > silhouette.LIT[0] and empty < silhouette.LIT[1]:
                    values[found] = LINEAR_LIGHT[image[row, column, c]] / empty
                    found += 1
        if found > silhouette.GAIN_MIN_COUNT:
            colours[2, c] = median(values, found)


@part
def difference(image: Image, behind: Image, gain: Array, start: Numbers, way: Numbers, width: float) -> float:
    """Median of what a picture and its background (times a gain) differ by inside of the first piece of a tube."""
    n, along = silhouette.INSIDE_COUNT, silhouette.ALONG_COUNT
    values, found, now, empty = np.empty(along * n), np.int64(0), np.empty((3, along)), np.empty((3, along))
    for i in range(n):
        offset = (-1 + 2 * i / (n - 1)) * silhouette.INSIDE_WIDTHS * width
        first_piece(image, start, way, width, offset, now)
        first_piece(behind, start, way, width, offset, empty)
        for k in range(along):
            off = 0.0
            for c in range(3):
                off = max(off, abs(now[c, k] - empty[c, k] * gain[c]))
            if not np.isnan(now[0, k]):
                values[found] = off
                found += 1
    return median(values, found) if found > 0 else np.nan


@part
def learn(image: Image, behind: Image, start: Numbers, way: Numbers, width: float) -> tuple[Array, float]:
    """Twin of `silhouette.learn`: tube, cloth and gain (3, 3), and the difference."""
    inside, beside = silhouette.INSIDE_COUNT, silhouette.BESIDE_COUNT
    colours, offsets = np.ones((3, 3)), np.empty(2 * beside)
    for i in range(inside):
        offsets[i] = (-1 + 2 * i / (inside - 1)) * silhouette.INSIDE_WIDTHS
    middle_colour(image, start, way, width, offsets, inside, colours[0])
    low, high = silhouette.BESIDE_WIDTHS
    for i in range(beside):
        offsets[i] = low + i * (high - low) / (beside - 1)
        offsets[beside + i] = -offsets[i]
    middle_colour(image, start, way, width, offsets, 2 * beside, colours[1])
    if behind.shape[0] == 0:
        return colours, np.nan
    brightness(image, behind, colours)
    return colours, difference(image, behind, colours[2], start, way, width)


@short_part
def forgiven(colours: Array, row: int, shading: float) -> float:
    """How far deviations along the colour in a row are forgiven as shading (`signal`)."""
    square = colours[row, 0] ** 2 + colours[row, 1] ** 2 + colours[row, 2] ** 2
    return float(shading * shading / (NOISE * NOISE + shading * shading * square))


@part
def numbers_of(colours: Array, channels: int) -> Numbers:
    """Twin of `Signal.numbers` for colours (3, 3)."""
    for c in range(channels, 3):
        colours[:, c] = 0.0
    t, b, g = colours
    forgiving = forgiven(colours, 0, SHADING_TUBE), forgiven(colours, 1, SHADING_CLOTH)
    return t[0], t[1], t[2], b[0], b[1], b[2], g[0], g[1], g[2], forgiving[0], forgiving[1]


@part
def segmenter(colours: Array, difference: float, channels: int, with_scene: bool) -> int:
    """Twin of `silhouette.signal_of`: which of its `REASONS` holds, or -1 where nothing stands out."""
    contrast = 0.0
    for c in range(channels):
        if not (np.isfinite(colours[0, c]) and np.isfinite(colours[1, c])):
            return -1
        contrast = max(contrast, abs(colours[0, c] - colours[1, c]))
    if with_scene:
        return 0 if difference >= silhouette.CONTRAST_MIN else -1
    return reason(colours[0, :channels], colours[1, :channels]) if contrast >= silhouette.CONTRAST_MIN else -1
