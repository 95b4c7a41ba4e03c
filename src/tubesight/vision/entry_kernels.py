"""Where Python enters the compiled stages: flat arguments of fixed types, so that each is compiled once.

Pictures may be any views (`Picture.image` of any strides, writeable or not); other arrays are contiguous.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import types

from tubesight.core import Array, Image
from tubesight.core.kernels import compiled
from tubesight.vision import colour_kernels, kernels, ray_kernels, scan_kernels, see_kernels, tip_kernels
from tubesight.vision.line_kernels import Numbers, Picture
from tubesight.vision.ray_kernels import Optics

Pair = tuple[float, float]

IMAGE = types.Array(types.uint8, 3, "A", readonly=True)
LIST, ROWS, EDGES = (types.Array(types.float64, n, "C") for n in (1, 2, 3))
NUMBER, FLAG = types.float64, types.boolean
TUPLE: Any = types.UniTuple
PLACE = TUPLE(NUMBER, 2)
PICTURE = (IMAGE, IMAGE, TUPLE(NUMBER, 11))
OPTICS = (TUPLE(NUMBER, 5), TUPLE(NUMBER, 8), FLAG)


class Entry:
    """A function that is compiled for arguments of these types, and no others, when it is first called.

    Attributes
    ----------
    ready
        Whether it is compiled.
    """

    def __init__(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        self._dispatcher: Any = compiled(function)
        self._arguments = arguments
        self.ready = False

    def __call__(self, *arguments: Any) -> Any:
        """Call it."""
        if not self.ready:
            self._dispatcher.compile(self._arguments)
            self._dispatcher.disable_compile()
            self.ready = True
        return self._dispatcher(*arguments)


def entry(*arguments: Any) -> Callable[[Callable[..., Any]], Entry]:
    """Make an `Entry` of a function."""
    return lambda function: Entry(function, arguments)


@entry(IMAGE, IMAGE, PLACE, PLACE, NUMBER)
def learn(  # noqa: D103
    image: Image, behind: Image, start: Numbers, way: Numbers, width: float
) -> tuple[Array, float]:
    return colour_kernels.learn(image, behind, start, way, width)


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
) -> tuple[Array, float, float, float, float]:
    return scan_kernels.measure(Picture(image, behind, colours), middles, widths)


@entry(*PICTURE, ROWS, LIST, NUMBER)
def find_end(  # noqa: D103
    image: Image, behind: Image, colours: Numbers, middles: Array, widths: Array, reach: float
) -> tuple[int, Numbers, Numbers, float]:
    return kernels.find_end(Picture(image, behind, colours), middles, widths, reach)


@entry(*PICTURE, PLACE, PLACE, NUMBER, NUMBER, NUMBER, NUMBER, FLAG)
def ball(  # noqa: D103
    image: Image,
    behind: Image,
    colours: Numbers,
    centre: Numbers,
    way: Numbers,
    radius: float,
    half: float,
    blur: float,
    outwards: float,
    careful: bool,
) -> tip_kernels.Found:
    return tip_kernels.ball(Picture(image, behind, colours), centre, way, radius, half, blur, outwards, careful)


@entry(*PICTURE, PLACE, PLACE, NUMBER, NUMBER, NUMBER)
def round_end(  # noqa: D103
    image: Image,
    behind: Image,
    colours: Numbers,
    centre: Numbers,
    way: Numbers,
    radius: float,
    blur: float,
    outwards: float,
) -> tip_kernels.Found:
    return tip_kernels.round_end(Picture(image, behind, colours), centre, way, radius, blur, outwards)


@entry(*PICTURE, PLACE, PLACE, NUMBER, NUMBER, NUMBER)
def face(  # noqa: D103
    image: Image,
    behind: Image,
    colours: Numbers,
    end: Numbers,
    way: Numbers,
    width: float,
    blur: float,
    outwards: float,
) -> tip_kernels.Found:
    return tip_kernels.face(Picture(image, behind, colours), end, way, width, blur, outwards)


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


@entry(IMAGE, IMAGE, PLACE, PLACE, NUMBER, *OPTICS, NUMBER, types.int64, NUMBER)
def see_from_base(  # noqa: D103
    image: Image,
    behind: Image,
    start: Pair,
    way: Numbers,
    width: float,
    matrix: Numbers,
    k: Numbers,
    equidistant: bool,
    focal: float,
    shape: int,
    ratio: float,
) -> see_kernels.Seen:
    return see_kernels.see_from_base(
        image, behind, start, way, width, Optics(matrix, k, equidistant), focal, shape, ratio
    )
