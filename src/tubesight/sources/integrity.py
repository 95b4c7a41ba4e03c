"""Whether pixels that came straight from a sensor are one whole new picture."""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from tubesight.core import Image

# Rows that are looked at: a tear that leaves more than 1/64 of the picture old is seen.
_ROWS = 64


class Wholeness(StrEnum):
    """What a picture is compared with the one before."""

    NEW = "new"
    REPEATED = "repeated"
    TORN = "torn"


def wholeness(image: Image, before: Image | None) -> Wholeness:
    """Compare a picture with the one before it, row by row.

    A sensor's noise makes no two rows alike: rows equal to those of the picture before, or all of one level where they
    were not, were never filled. Where all are equal, the picture is the old one. Rows of one level throughout
    (saturated, or covered) say nothing and are left out. For pixels as the sensor gave them alone: a lossy code does
    make equal rows.

    Parameters
    ----------
    before
        The last whole picture; None where there is none.
    """
    if before is None or before.shape != image.shape:
        return Wholeness.NEW
    rows = np.linspace(0, len(image) - 1, _ROWS).astype(int)
    now, old = image[rows].reshape(_ROWS, -1), before[rows].reshape(_ROWS, -1)
    telling = (old != old[:, :1]).any(1)
    if not telling.any():
        return Wholeness.NEW
    stale = ((now == old).all(1) | (now == now[:, :1]).all(1))[telling]
    if (now == old)[telling].all():
        return Wholeness.REPEATED
    return Wholeness.TORN if stale.any() else Wholeness.NEW
