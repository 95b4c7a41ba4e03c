"""Checked, read-only float64 arrays: what every frozen type of the package holds."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8]


def readonly(values: ArrayLike, shape: tuple[int | None, ...], name: str) -> Array:
    """Copy `values` to a read-only float64 array and check its shape.

    Parameters
    ----------
    values
        Anything NumPy can turn into numbers.
    shape
        The shape expected; ``None`` stands for any extent.
    name
        What the array is called in the error message.

    Raises
    ------
    ValueError
        If the shape differs; the message gives both.
    """
    array = np.array(values, dtype=np.float64)
    fits = array.ndim == len(shape) and all(want in (None, got) for want, got in zip(shape, array.shape, strict=True))
    if not fits:
        wanted = "(" + ", ".join("N" if n is None else str(n) for n in shape) + ")"
        raise ValueError(f"{name}: expected shape {wanted}, got {array.shape}")
    array.flags.writeable = False
    return array
