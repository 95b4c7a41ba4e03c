"""How much a pixel looks like tube rather than background, from 0 to 1, in linear light.

All segmenters are one formula: with the colours T of the tube and B of the background, a pixel I belongs to the nearer
of the two, distances measured in the deviations that noise and shading (which scales a colour) give each of them:
``share = d_B^2 / (d_T^2 + d_B^2 + 1)``, ``d_X^2 = (I - X)^T (noise^2 I + shading^2 X X^T)^-1 (I - X)``. Segmenters
differ in where B comes from: a picture of the empty scene, or the surroundings of the tube. A third colour belongs to
neither and counts as background as soon as it is farther from T.

This signal finds the tube; edges are measured with the colours just inside and outside of each (`edges.local_share`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeVar

import cv2
import numpy as np

from tubesight.core import Array, Image, readonly

# sRGB to linear light (IEC 61966-2-1) for the 256 levels of a picture.
_LEVELS = np.arange(256) / 255.0
LINEAR_LIGHT = np.where(_LEVELS <= 0.04045, _LEVELS / 12.92, ((_LEVELS + 0.055) / 1.055) ** 2.4)
# Noise and texture of a picture in linear light; shares by which shading scales the colour of a tube (round, so lit
# from dark to bright) and shadows that of a background.
NOISE = 0.02
SHADING_TUBE, SHADING_CLOTH = 0.35, 0.25
# Likeness above which a place is tube.
TUBE = 0.5


def planes(image: Image) -> Image:
    """View a picture (H, W) or (H, W, C), of any strides, as (H, W, C) without copying it."""
    return image[:, :, None] if image.ndim == 2 else image


def sample(image: Image, points_px: Array) -> Array:
    """Bilinear samples in linear light.

    Parameters
    ----------
    image
        (H, W) or (H, W, C), 8 bit, any strides.
    points_px
        (..., 2); NaN is returned outside the picture.

    Returns
    -------
    Array
        (..., C) with C = 1 for gray.
    """
    image = planes(image)
    height, width, channels = image.shape
    x, y = points_px[..., 0], points_px[..., 1]
    inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    if not inside.any():
        return np.full((*x.shape, channels), np.nan)
    x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
    column, row = x.astype(np.intp), y.astype(np.intp)
    # On the last column and row the weight of the neighbour is zero: it is read from the same place.
    right, below = np.minimum(column + 1, width - 1), np.minimum(row + 1, height - 1)
    u, v = (x - column)[..., None], (y - row)[..., None]
    top = LINEAR_LIGHT[image[row, column]] * (1 - u) + LINEAR_LIGHT[image[row, right]] * u
    bottom = LINEAR_LIGHT[image[below, column]] * (1 - u) + LINEAR_LIGHT[image[below, right]] * u
    return np.where(inside[..., None], top * (1 - v) + bottom * v, np.nan)


F = TypeVar("F", float, Array)
ALL = slice(None)


@dataclass(frozen=True, slots=True, eq=False)
class Signal:
    """Likeness to tube at points of one picture.

    Attributes
    ----------
    image
        (H, W, C) the picture.
    tube, cloth
        (C,) colours in linear light; `cloth` stands for the background where there is no picture of it.
    background
        (H, W, C) the scene without the tube, or None.
    gain
        (C,) brightness of the picture over that of the background picture.
    why
        Which segmenter this is and why, one sentence.
    numbers
        Tube, cloth and gain as triples in a row, filled up with zeros, and how far tube and cloth forgive shading.
    """

    image: Image
    tube: Array
    cloth: Array
    background: Image | None
    gain: Array
    why: str
    numbers: tuple[float, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "image", planes(self.image))
        if self.background is not None:
            object.__setattr__(self, "background", planes(self.background))
        for name in ("tube", "cloth", "gain"):
            object.__setattr__(self, name, readonly(getattr(self, name), (None,), name))
        triples = [[*getattr(self, name).tolist(), 0.0, 0.0][:3] for name in ("tube", "cloth", "gain")]
        squares = [sum(c * c for c in triple) for triple in triples[:2]]
        forgiven = [_forgiven(square, s) for square, s in zip(squares, (SHADING_TUBE, SHADING_CLOTH), strict=True)]
        object.__setattr__(self, "numbers", (*triples[0], *triples[1], *triples[2], *forgiven))

    def colours(self, points_px: Array) -> tuple[Array, Array | None]:
        """Colours (..., C) at points (..., 2) and, where there is a picture of it, of the background behind them."""
        return sample(self.image, points_px), None if self.background is None else sample(
            self.background, points_px
        ) * self.gain

    def __call__(self, points_px: Array) -> Array:
        """Likeness to tube (...) at points (..., 2); NaN outside the picture."""
        return self._share(*self.colours(points_px))

    def picture(self, size_px: tuple[int, int], rows: slice = ALL, columns: slice = ALL) -> Array:
        """Likeness to tube (H, W) of the picture shrunk to a size (W, H), or of a part of that."""

        def light(image: Image) -> Array:
            small = planes(np.asarray(cv2.resize(image, size_px, interpolation=cv2.INTER_AREA), np.uint8))
            return LINEAR_LIGHT[small[rows, columns]]

        return self._share(light(self.image), None if self.background is None else light(self.background) * self.gain)

    def _share(self, colour: Array, behind: Array | None) -> Array:
        behind = self.cloth if behind is None else behind
        from_tube = _distance(colour - self.tube, self.tube, SHADING_TUBE)
        from_cloth = _distance(colour - behind, behind, SHADING_CLOTH)
        return from_cloth / (from_tube + from_cloth + 1.0)


def _distance(off: Array, colour: Array, shading: float) -> Array:
    """Squared Mahalanobis distance (...) of deviations (..., C) from a colour (Sherman-Morrison)."""
    along = (off * colour).sum(-1) ** 2 * _forgiven((colour * colour).sum(-1), shading)
    return np.asarray(((off * off).sum(-1) - along) / NOISE**2)


def _forgiven(square: F, shading: float) -> F:
    """How far squared deviations along a colour, whose square this is, are forgiven as shading."""
    return shading**2 / (NOISE**2 + shading**2 * square)
