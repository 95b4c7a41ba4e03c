"""Telling the processor which pixels are read next.

A picture that a camera has just written lies in memory, not in the cache: each line of 64 bytes of it that a scan meets
first takes as long to come as fifty samples to compute. Told early enough, many of them come at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from tubesight.core import Image
from tubesight.core.kernels import part
from tubesight.vision.line_kernels import Numbers

# Arguments of LLVM's prefetch: to be read, to be kept, data.
_READ, _KEEP, _DATA = 0, 3, 1


def _fetch(_: Any, image: Any, row: Any, column: Any) -> Any:
    """Ask for a pixel of a picture; nothing waits for it, and its place is not checked."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        down, right = (builder.extract_value(array.strides, axis) for axis in range(2))
        offset = builder.add(builder.mul(arguments[1], down), builder.mul(arguments[2], right))
        address, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        place = builder.gep(builder.bitcast(array.data, address), [offset])
        kind = ir.FunctionType(ir.VoidType(), [address, number, number, number])
        prefetch = builder.module.declare_intrinsic("llvm.prefetch", [address], kind)
        builder.call(prefetch, [place, *(number(hint) for hint in (_READ, _KEEP, _DATA))])
        return context.get_dummy_value()

    return types.none(image, types.intp, types.intp), generate


fetch = cast("Callable[[Image, int, int], None]", intrinsic(_fetch))


@part
def fetch_line(image: Image, origin: Numbers, way: Numbers, low: float, high: float, places: int) -> None:
    """Ask for the pixels at some places evenly spread along a line, and for those below them."""
    bottom, right = image.shape[0] - 2, image.shape[1] - 2
    for k in range(places):
        a = low + (high - low) * k / (places - 1)
        x, y = origin[0] + a * way[0], origin[1] + a * way[1]
        if 0.0 <= x <= right and 0.0 <= y <= bottom:
            row, column = int(y), int(x)
            fetch(image, row, column)
            fetch(image, row + 1, column)
