"""Bands painted on the tube, found by their colour; the tube itself is seen as if they were not there.

Near a band each pixel is a mixture of three colours in linear light: band B, tube T and background C. Its shares
(b, t, c) solve ``b B + t T + c C = I``, whatever the light is: shading scales all three. Where ``b / (b + t + c)``
exceeds a half there is band. The band's part of each pixel is then replaced by tube, ``I + b (T - B)``, and the picture
that this leaves goes the way of every other.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import NamedTuple

import cv2
import numpy as np

from tubesight.core import Array, Image, Mask, Status, Tube, Unmeasurable, readonly
from tubesight.geometry.camera import Camera
from tubesight.geometry.polyline import lengths_along, place_along, points_at
from tubesight.vision.see import Start, see
from tubesight.vision.signal import LINEAR_LIGHT
from tubesight.vision.silhouette import learn
from tubesight.vision.view import View

# Share of a pixel that is band above which it counts as one, and above which it is nothing else.
_BAND, _PURE = 0.5, 0.85
# Light of a band, over that of its colour in full light, below which it is a dark mixture of anything.
_LIT_MIN = 0.04
# Smallest sine of the angle between the band's colour and the plane of the other two: below it noise is band.
_APART_MIN = 0.15
# Fewest pixels of a band, and how far they are painted over beyond its half level: blur ends there.
_PIXELS_MIN, _HALO_PX = 6, 3
# The tube's colour beside the bands is taken from this far, in halos.
_BESIDE_HALOS = 4
# Colours this alike (cosine in linear light) are one in different light; every so many pixels tell the background's.
_ALIKE, _COARSE = 0.97, 8
# A band is looked for on this share of the tube's width, and crosses this share of it at least. What is so near (px) to
# this share of the tip's contour covers the tip, and what reaches as near to its middle belongs to it.
_ON_TUBE, _ACROSS, _TIP_PX, _TIP_SHARE = 0.9, 0.5, 2, 0.5
# Fewest pixels from which the bow of a band is measured, and the least bow that they have to span for it.
_BOW_PIXELS, _BOW_SPAN = 16, 0.2
# Pixels nearer to the tube's edge than this share of its radius tell nothing of the bow but the edge.
_INSIDE = 0.98


@dataclass(frozen=True, slots=True, eq=False)
class BandView(View):
    """A view of a tube with bands.

    Attributes
    ----------
    bands_px
        (K, 2) where the centreline passes the middle of each band, in order from the base.
    tip_marked
        Whether the last band covers the tip; it is then where the tip is.
    """

    bands_px: Array = field(default_factory=lambda: np.zeros((0, 2)))
    tip_marked: bool = False

    def __post_init__(self) -> None:
        View.__post_init__(self)
        object.__setattr__(self, "bands_px", readonly(self.bands_px, (None, 2), "bands_px"))


@dataclass(frozen=True, slots=True)
class Bands:
    """Seeing a tube with bands, as a vision strategy.

    Attributes
    ----------
    band_bgr
        Colour of the bands, 8-bit sRGB; it may not be a mixture of the tube's and the background's.
    """

    band_bgr: tuple[float, float, float] = (45.0, 40.0, 200.0)

    def __call__(
        self,
        name: str,
        image: Image,
        background: Image | None,
        camera: Camera,
        tube: Tube,
        start: Start | None,
        base_px: Array | None = None,
    ) -> BandView:
        """See the tube and its bands in one picture; parameters as those of `tubesight.vision.see.see`.

        Raises
        ------
        Unmeasurable
            If the picture has no colour, no band is found, or the tube is not.
        """
        if image.ndim != 3:
            raise Unmeasurable(Status.BAD_IMAGE, detail="bands are found by their colour; the picture is gray")
        light = LINEAR_LIGHT[image]
        band = LINEAR_LIGHT[np.rint(np.array(self.band_bgr)).astype(np.intp)]
        if start is not None:
            tube_colour, cloth, _, _ = learn(image, None, start.px, start.way, start.width_px)
        else:
            tube_colour, cloth = _beside(light, band)
        colours = _observed(light, np.stack([band, tube_colour, cloth]))
        parts = _parts(light, colours)
        band_share = _share(parts)
        painted = _painted_over(image, light, parts, band_share, colours)
        view = see(name, painted, background, camera, tube, start, base_px)
        return _with_bands(view, band_share)


def _beside(light: Array, band: Array) -> tuple[Array, Array]:
    """Colours of tube and background of a picture whose tube may lie anywhere, from what surrounds the bands' colour.

    The background is the picture's median; the tube's is the median of what is neither, beside the bands.
    """
    cloth = np.median(light[::_COARSE, ::_COARSE].reshape(-1, 3), axis=0)
    bands = _likeness(light, band) > _ALIKE
    near = _grown(bands, _BESIDE_HALOS * _HALO_PX) & ~_grown(bands, _HALO_PX)
    other = light[near]
    other = other[(_likeness(other, cloth) < _ALIKE) & (_likeness(other, band) < _ALIKE)]
    if len(other) < _PIXELS_MIN:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="no band of the announced colour on a tube")
    return np.median(other, axis=0), cloth


def _likeness(light: Array, colour: Array) -> Array:
    """Cosine (...) between colours (..., 3) and one of them, which does not depend on how well they are lit."""
    size = np.linalg.norm(light, axis=-1) * np.linalg.norm(colour)
    return np.asarray(np.divide(light @ colour, size, out=np.zeros(size.shape), where=size > 0))


def _parts(light: Array, colours: Array) -> Array:
    """Parts (H, W, 3) of band, tube and background that add up to each pixel; colours are rows (3, 3).

    Raises
    ------
    Unmeasurable
        If the band's colour is a mixture of the other two.
    """
    across = np.cross(colours[1], colours[2])
    size = np.linalg.norm(across) * np.linalg.norm(colours[0])
    apart = abs(float(colours[0] @ across)) / size if size > 0 else 0.0
    if not apart >= _APART_MIN:
        raise Unmeasurable(
            Status.TUBE_NOT_FOUND, detail="the bands' colour cannot be told from those of tube and background"
        )
    return np.asarray(light @ np.linalg.inv(colours))


def _share(parts: Array) -> Array:
    """Share (H, W) of each pixel that is band, 0 to 1; zero where it is too dark to tell."""
    positive = np.maximum(parts, 0.0)
    share = positive[..., 0] / np.maximum(positive.sum(-1), 1e-9)
    return np.where(positive[..., 0] > _LIT_MIN * (share > _BAND), share, 0.0)


def _observed(light: Array, colours: Array) -> Array:
    """Colours as they are in this picture's light: band and tube from the pixels of the bands and beside them."""
    share = _share(_parts(light, colours))
    pure = share > _PURE
    if pure.sum() < _PIXELS_MIN:
        raise Unmeasurable(Status.TOO_FEW_POINTS, detail="no band of the announced colour")
    near = _grown(share > _BAND, _BESIDE_HALOS * _HALO_PX) & ~_grown(share > _BAND, _HALO_PX)
    parts = np.maximum(_parts(light, colours), 0.0)
    white = near & (parts[..., 1] > _PURE * parts.sum(-1))
    tube = np.median(light[white], axis=0) if white.sum() >= _PIXELS_MIN else colours[1]
    return np.stack([np.median(light[pure], axis=0), tube, colours[2]])


def _grown(mask: Mask, px: int) -> Mask:
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * px + 1, 2 * px + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0)


def _painted_over(image: Image, light: Array, parts: Array, share: Array, colours: Array) -> Image:
    """Picture with tube in the place of its bands."""
    near = _grown(share > _BAND, _HALO_PX)
    mixed = light[near] + np.maximum(parts[near][:, :1], 0.0) * (colours[1] - colours[0])
    painted = image.copy()
    painted[near] = np.searchsorted((LINEAR_LIGHT[1:] + LINEAR_LIGHT[:-1]) / 2, mixed).astype(np.uint8)
    return painted


class _Way(NamedTuple):
    """Centreline of a view, continued by a width before its start and to the tip: points, arc lengths and widths."""

    px: Array
    chord: Array
    widths: Array


def _way(view: View) -> _Way:
    line, widths = view.centreline_px, view.widths_px
    first, last = line[0] - line[1], view.tip.px - line[-1]
    px = [line[:1] + first / np.linalg.norm(first) * widths[0], line]
    if last @ (line[-1] - line[-2]) > 0:
        px.append(view.tip.px[None])
    points = np.concatenate(px)
    chord = lengths_along(points)
    return _Way(points, chord, np.append(widths[:1], np.append(widths, widths[-1:]))[: len(points)])


def _tube_mask(way: _Way, shape: tuple[int, ...]) -> Mask:
    """Pixels (H, W) of the tube along its middle."""
    mask = np.zeros(shape, np.uint8)
    ends = np.rint(way.px).astype(int).tolist()
    for start, end, width in zip(ends[:-1], ends[1:], way.widths.tolist(), strict=False):
        cv2.line(mask, start, end, 1, max(round(_ON_TUBE * width), 1))
    return mask > 0


def _tip_marked(view: View, band: Mask) -> bool:
    """Whether the tip has the bands' colour: most of its contour runs along pixels of it."""
    rim = np.rint(view.tip.contour_px).astype(np.intp)
    rim = rim[((rim >= 0) & (rim < band.shape[::-1])).all(1)]
    return bool(len(rim)) and float(np.mean(_grown(band, _TIP_PX)[rim[:, 1], rim[:, 0]])) > _TIP_SHARE


def _with_bands(view: View, share: Array) -> BandView:
    """Add to a view the bands that lie on its tube.

    A ball has the bands' colour too, and may touch the last of them in the picture: what is beside the tube does not
    count, nor what reaches the tip.
    """
    band, way = share > _BAND, _way(view)
    tube, tip_marked = _tube_mask(way, band.shape), _tip_marked(view, band)
    count, labels, stats, _ = cv2.connectedComponentsWithStats((band & tube).astype(np.uint8), connectivity=4)
    found: list[tuple[float, Array]] = []
    for k in range(1, count):
        if stats[k, cv2.CC_STAT_AREA] < _PIXELS_MIN:
            continue
        px, weight = _pixels(labels == k, stats[k], share)
        if tip_marked and place_along(way.px, px[weight > _BAND])[0].max() >= way.chord[-1] - _TIP_PX:
            continue
        own = tube[px[:, 1].astype(int), px[:, 0].astype(int)]
        place = _place(way, px[own], weight[own])
        if place is not None:
            found.append(place)
    bands = [px for _, px in sorted(found, key=lambda each: each[0])]
    if tip_marked:
        bands.append(view.tip.px)
    if not bands:
        raise Unmeasurable(Status.TOO_FEW_POINTS, detail="no band on the tube")
    values = {f.name: getattr(view, f.name) for f in fields(View)}
    return BandView(**values, bands_px=np.stack(bands), tip_marked=tip_marked)


def _pixels(mask: Mask, box: Array, share: Array) -> tuple[Array, Array]:
    """Pixels (N, 2) of a band and of its soft border, with their shares (N,)."""
    left, top, width, height = (int(box[k]) for k in range(4))
    rows = slice(max(top - _HALO_PX, 0), top + height + _HALO_PX)
    columns = slice(max(left - _HALO_PX, 0), left + width + _HALO_PX)
    y, x = np.nonzero(_grown(mask[rows, columns], _HALO_PX - 1))
    px = np.stack([x + columns.start, y + rows.start], -1)
    return px.astype(float), share[px[:, 1], px[:, 0]]


def _place(way: _Way, px: Array, weight: Array) -> tuple[float, Array] | None:
    """Where the centreline passes the middle of a band: its place along it, and the pixel; None where it does not.

    A band lies in a plane across the tube. Where the tube leans towards the camera, the band's front is bowed along the
    tube by ``depth sqrt(1 - u^2)``, u across it from -1 to 1; at the edges of the tube it is where the centreline is.
    """
    place, off = place_along(way.px, px)
    middle = float(np.average(place, weights=weight))
    k = min(max(int(np.searchsorted(way.chord, middle)), 1), len(way.chord) - 1)
    step = way.px[k] - way.px[k - 1]
    across = (px @ [-step[1], step[0]])[weight > _BAND] / np.linalg.norm(step)
    if np.ptp(across) < _ACROSS * way.widths[k]:
        return None
    widths = np.interp(place, way.chord, way.widths)
    bow = np.sqrt(np.maximum(1 - (2 * off / widths) ** 2, 1 - _INSIDE**2))
    if len(px) >= _BOW_PIXELS and np.ptp(bow) > _BOW_SPAN:
        root = np.sqrt(weight)
        solution = np.linalg.lstsq(np.stack([root, root * bow], 1), root * place, rcond=None)[0]
        middle = float(solution[0])
    return middle, _at(way.px, way.chord, middle)


def _at(line: Array, chord: Array, place: float) -> Array:
    """Point (2,) of a polyline at an arc length, continued straight past its ends."""
    point = points_at(line, chord, np.array(place))
    if place < 0:
        point = line[0] + place * (line[1] - line[0]) / chord[1]
    elif place > chord[-1]:
        point = line[-1] + (place - chord[-1]) * (line[-1] - line[-2]) / (chord[-1] - chord[-2])
    return np.asarray(point)
