"""How much of a pixel is tube: 0 on the background, 1 on the tube, linear in the covered share.

All segmenters are one formula: with the colours T of the tube and B of the background in linear light, a pixel I that is tube
to the share a is ``I = a T + (1 - a) B``, so ``a = w . (I - B) / w . (T - B)`` for any direction w. Fisher's discriminant
``w = M^-1 (T - B)`` takes the direction in which shading and shadows, which scale colours, matter least. Segmenters differ in
where B comes from: a picture of the empty scene, or the surroundings of the tube.

This signal finds the tube; edges are measured with the colours just inside and outside of each (`edges.local_share`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tubesight.core import Array, Image, readonly

# sRGB to linear light (IEC 61966-2-1) for the 256 levels of a picture.
_LEVELS = np.arange(256) / 255.0
LINEAR_LIGHT = np.where(_LEVELS <= 0.04045, _LEVELS / 12.92, ((_LEVELS + 0.055) / 1.055) ** 2.4).astype(np.float32)
# Shadows and shading scale a colour by about this share; noise of a picture in linear light.
_SHADING = 0.3
_NOISE = 0.01


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
    height, width = image.shape[:2]
    x, y = points_px[..., 0], points_px[..., 1]
    inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
    column, row = np.minimum(x.astype(np.intp), width - 2), np.minimum(y.astype(np.intp), height - 2)
    u, v = (x - column)[..., None], (y - row)[..., None]

    def corner(r: int, c: int) -> Array:
        values = LINEAR_LIGHT[image[row + r, column + c]]
        return values[..., None] if image.ndim == 2 else values

    top = corner(0, 0) * (1 - u) + corner(0, 1) * u
    bottom = corner(1, 0) * (1 - u) + corner(1, 1) * u
    return np.where(inside[..., None], top * (1 - v) + bottom * v, np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class Signal:
    """Share of tube at points of one picture.

    Attributes
    ----------
    image
        The picture.
    tube, cloth
        (C,) colours in linear light; `cloth` stands for the background where there is no picture of it.
    background
        The scene without the tube, or None.
    gain
        (C,) brightness of the picture over that of the background picture.
    why
        Which segmenter this is and why, one sentence.
    """

    image: Image
    tube: Array
    cloth: Array
    background: Image | None
    gain: Array
    why: str

    def __post_init__(self) -> None:
        for name in ("tube", "cloth", "gain"):
            object.__setattr__(self, name, readonly(getattr(self, name), (None,), name))

    def colours(self, points_px: Array) -> tuple[Array, Array | None]:
        """Colours (..., C) at points (..., 2) and, where there is a picture of it, of the background behind them."""
        return sample(self.image, points_px), None if self.background is None else sample(self.background, points_px) * self.gain

    def __call__(self, points_px: Array) -> Array:
        """Share of tube (...) at points (..., 2); NaN outside the picture."""
        colour, behind = self.colours(points_px)
        behind = self.cloth if behind is None else behind
        contrast = self.tube - behind
        weight = _discriminant(contrast, np.broadcast_to(self.tube, contrast.shape), behind)
        # Where the background has the tube's own colour the share is not observable: it tends to 0, not to noise.
        floor = _discriminant_floor(weight, contrast)
        return np.asarray(((colour - behind) * weight).sum(-1) / floor)


def _discriminant(contrast: Array, tube: Array, behind: Array) -> Array:
    """Fisher's direction ``M^-1 (T - B)``, ``M = noise^2 I + (shading T)(shading T)^T + (shading B)(shading B)^T``."""
    if contrast.shape[-1] == 1:
        return contrast
    spread = np.stack([tube, np.broadcast_to(behind, tube.shape)], -1) * (_SHADING / _NOISE)
    # Woodbury: (I + S S^T)^-1 c = c - S (I + S^T S)^-1 S^T c, a 2 x 2 system per point.
    gram = np.einsum("...ci,...cj->...ij", spread, spread) + np.eye(2)
    right = np.einsum("...ci,...c->...i", spread, contrast)
    return np.asarray(contrast - np.einsum("...ci,...i->...c", spread, np.linalg.solve(gram, right[..., None])[..., 0]))


def _discriminant_floor(weight: Array, contrast: Array) -> Array:
    power = (weight * contrast).sum(-1)
    return np.asarray(power + _NOISE**2)
