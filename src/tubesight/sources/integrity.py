"""Whether pixels that came straight from a sensor are one whole new picture."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum

import numpy as np

from tubesight.core import Image

# Rows that are looked at: a tear that leaves more than 1/64 of the picture old is seen.
_ROWS = 64
#: Pictures to compare with: a driver fills so many buffers in turn; what is not filled anew is what one held before.
BUFFERS = 4


class Wholeness(StrEnum):
    """How a picture compares with those before."""

    NEW = "new"
    REPEATED = "repeated"
    TORN = "torn"


def sampled(image: Image) -> Image:
    """Return the rows (64, ...) that are compared."""
    rows = np.linspace(0, len(image) - 1, _ROWS).astype(int)
    return np.ascontiguousarray(image[rows].reshape(_ROWS, -1))


def wholeness(now: Image, before: Iterable[Image]) -> Wholeness:
    """Compare a picture with the last ones that arrived, whole or torn, row by row.

    A sensor's noise makes no two rows alike: rows equal to those of a picture before, or all of one level where they
    were not, were not filled anew. Where all are equal, the picture is an old one. Rows of one level throughout
    (saturated, or covered) say nothing and are left out. For pixels as the sensor gave them alone: a lossy code does
    make equal rows.

    Parameters
    ----------
    now, before
        Rows of the picture, and of the last that arrived and the last whole one, by `sampled`.
    """
    torn = False
    for old in before:
        telling = (old != old[:, :1]).any(1)
        if old.shape != now.shape or not telling.any():
            continue
        same = (now == old).all(1)
        if same[telling].all():
            return Wholeness.REPEATED
        torn = torn or bool((same | (now == now[:, :1]).all(1))[telling].any())
    return Wholeness.TORN if torn else Wholeness.NEW
