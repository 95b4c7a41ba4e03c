"""Checked, read-only float64 arrays: what every frozen type of the package holds."""

from __future__ import annotations

from typing import TypeGuard

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8]
Indices = NDArray[np.int64]

_FLOAT = np.dtype(np.float64)


def sealed(array: Array) -> Array:
    """Make a fresh array read-only, in place: what `readonly` takes without a copy."""
    array.flags.writeable = False
    return array


def _is_sealed(values: ArrayLike) -> TypeGuard[Array]:
    """Whether values are a read-only float64 array in C order that owns its memory."""
    if type(values) is not np.ndarray or values.dtype is not _FLOAT or values.base is not None:
        return False
    flags = values.flags
    return not flags.writeable and bool(flags.c_contiguous)


def readonly(values: ArrayLike, shape: tuple[int | None, ...], name: str) -> Array:
    """Copy `values` to a read-only float64 array and check its shape; one that is `sealed` already is not copied.

    The array is laid out in C order, so that compiled code meets one type of it.

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
    array = values if _is_sealed(values) else np.array(values, dtype=np.float64, order="C")
    fits = array.ndim == len(shape) and all(want in (None, got) for want, got in zip(shape, array.shape, strict=True))
    if not fits:
        wanted = "(" + ", ".join("N" if n is None else str(n) for n in shape) + ")"
        raise ValueError(f"{name}: expected shape {wanted}, got {array.shape}")
    array.flags.writeable = False
    return array
