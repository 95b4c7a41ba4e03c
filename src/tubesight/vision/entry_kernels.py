"""Where Python enters the compiled stages: flat arguments of fixed types, so that each is compiled once.

Pictures may be any views (`Picture.image` of any strides, writeable or not); other arrays are contiguous.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import types

from tubesight.core import Array, Image
from tubesight.core.kernels import compiled, part, short_part
from tubesight.vision import kernels, ray_kernels, scan_kernels, silhouette, tip_kernels
from tubesight.vision.kernels import Numbers, Picture, light
from tubesight.vision.math_kernels import median
from tubesight.vision.ray_kernels import Optics
from tubesight.vision.signal import LINEAR_LIGHT

Pair = tuple[float, float]

IMAGE = types.Array(types.uint8, 3, "A", readonly=True)
LIST, ROWS, EDGES = (types.Array(types.float64, n, "C") for n in (1, 2, 3))
NUMBER, FLAG = types.float64, types.boolean
TUPLE: Any = types.UniTuple
PLACE = TUPLE(NUMBER, 2)
PICTURE = (IMAGE, IMAGE, TUPLE(NUMBER, 11))
OPTICS = (TUPLE(NUMBER, 5), TUPLE(NUMBER, 8), FLAG)


class Entry:
    """A function that is compiled for arguments of these types, and no others, when it is first called."""

    def __init__(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        self._dispatcher: Any = compiled(function)
        self._arguments = arguments
        self._ready = False

    def __call__(self, *arguments: Any) -> Any:
        """Call it."""
        if not self._ready:
            self._dispatcher.compile(self._arguments)
            self._dispatcher.disable_compile()
            self._ready = True
        return self._dispatcher(*arguments)


def entry(*arguments: Any) -> Callable[[Callable[..., Any]], Entry]:
    """Make an `Entry` of a function."""
    return lambda function: Entry(function, arguments)


@part
def middle_colour(
    image: Image, start: Numbers, way: Numbers, width: float, offsets: Array, count: int, colour: Array
) -> None:
    """Twin of `silhouette._middle_colour` beside the first piece of a tube at the first `count` offsets, in widths."""
    values, found = np.empty((3, silhouette.ALONG_COUNT * count)), np.int64(0)
    for k in range(silhouette.ALONG_COUNT):
        s = along_first(k) * width
        for i in range(count):
            offset = offsets[i] * width
            a, b, c = light(image, start[0] + s * way[0] + offset * way[1], start[1] + s * way[1] - offset * way[0])
            if not np.isnan(a):
                values[0, found], values[1, found], values[2, found] = a, b, c
                found += 1
    for c in range(3):
        colour[c] = median(values[c], found) if found >= silhouette.SAMPLES_MIN else np.nan


@short_part
def along_first(k: int) -> float:
    """Places of samples along the first piece of a tube, widths."""
    low, high = silhouette.ALONG_WIDTHS
    return low + k * (high - low) / (silhouette.ALONG_COUNT - 1)


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
    n = silhouette.INSIDE_COUNT
    values, found = np.empty(silhouette.ALONG_COUNT * n), np.int64(0)
    for k in range(silhouette.ALONG_COUNT):
        s = along_first(k) * width
        for i in range(n):
            offset = (-1 + 2 * i / (n - 1)) * silhouette.INSIDE_WIDTHS * width
            x, y = start[0] + s * way[0] + offset * way[1], start[1] + s * way[1] - offset * way[0]
            a, b, c = light(image, x, y)
            p, q, r = light(behind, x, y)
            off = max(abs(a - p * gain[0]), max(abs(b - q * gain[1]), abs(c - r * gain[2])))
            if not np.isnan(a):
                values[found] = off
                found += 1
    return median(values, found) if found > 0 else np.nan


@entry(IMAGE, IMAGE, PLACE, PLACE, NUMBER)
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


@entry(*PICTURE, PLACE, PLACE, NUMBER, FLAG)
def find_pair(  # noqa: D103
    image: Image, behind: Image, colours: Numbers, middle: Numbers, way: Numbers, width: float, known: bool
) -> Numbers:
    return kernels.find_pair(Picture(image, behind, colours), middle, way, width, known)


@entry(*PICTURE, PLACE, PLACE, NUMBER, FLAG)
def walk(  # noqa: D103
    image: Image, behind: Image, colours: Numbers, start: Pair, way: Numbers, width: float, from_base: bool
) -> tuple[Array, Array, Array]:
    return kernels.walk(Picture(image, behind, colours), start, way, width, from_base)


@entry(*PICTURE, ROWS, LIST)
def measure(  # noqa: D103
    image: Image, behind: Image, colours: Numbers, middles: Array, widths: Array
) -> tuple[Array, float, float, float]:
    return scan_kernels.measure(Picture(image, behind, colours), middles, widths)


@entry(*PICTURE, ROWS, LIST, NUMBER)
def find_end(  # noqa: D103
    image: Image, behind: Image, colours: Numbers, middles: Array, widths: Array, reach: float
) -> tuple[int, Numbers, Numbers, float]:
    return kernels.find_end(Picture(image, behind, colours), middles, widths, reach)


@entry(*PICTURE, PLACE, PLACE, NUMBER, NUMBER, NUMBER, FLAG)
def ball(  # noqa: D103
    image: Image,
    behind: Image,
    colours: Numbers,
    centre: Numbers,
    way: Numbers,
    radius: float,
    half: float,
    blur: float,
    careful: bool,
) -> tip_kernels.Found:
    return tip_kernels.ball(Picture(image, behind, colours), centre, way, radius, half, blur, careful)


@entry(*PICTURE, PLACE, PLACE, NUMBER, NUMBER)
def round_end(  # noqa: D103
    image: Image, behind: Image, colours: Numbers, centre: Numbers, way: Numbers, radius: float, blur: float
) -> tip_kernels.Found:
    return tip_kernels.round_end(Picture(image, behind, colours), centre, way, radius, blur)


@entry(*PICTURE, PLACE, PLACE, NUMBER, NUMBER)
def face(  # noqa: D103
    image: Image, behind: Image, colours: Numbers, end: Numbers, way: Numbers, width: float, blur: float
) -> tip_kernels.Found:
    return tip_kernels.face(Picture(image, behind, colours), end, way, width, blur)


@entry(*OPTICS, NUMBER, ROWS)
def tangent_cone(  # noqa: D103
    matrix: Numbers, k: Numbers, equidistant: bool, focal: float, contour: Array
) -> tuple[Numbers, Array]:
    return ray_kernels.tangent_cone(Optics(matrix, k, equidistant), focal, contour)


@entry(*OPTICS, EDGES, PLACE, PLACE, NUMBER, NUMBER, PLACE)
def tube_rays(  # noqa: D103
    matrix: Numbers,
    k: Numbers,
    equidistant: bool,
    edges: Array,
    heading: Numbers,
    tip: Numbers,
    near: float,
    room: float,
    base: Numbers,
) -> tuple[Array, Array, Array, Array, Numbers, Array]:
    return ray_kernels.tube_rays(Optics(matrix, k, equidistant), edges, heading, tip, near, room, base)
