"""A view that keeps what it was made from: the signal of its picture, and the region that the tube covers."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property

import cv2
import numpy as np

from tubesight.core import Array, Image, Mask, Tube
from tubesight.geometry.camera import Camera
from tubesight.vision.see import Start, see
from tubesight.vision.signal import TUBE, Signal
from tubesight.vision.silhouette import choose
from tubesight.vision.view import View

# The region is looked for within this many widths of what the view found of the tube.
_ROOM_WIDTHS = 1.5
# The colours are learned at this share of the tube's way: nearer the base its holder throws a shadow.
_COLOURS_AT = 0.25


@dataclass(frozen=True, eq=False)
class RegionView(View):
    """A view with its picture's signal.

    Attributes
    ----------
    signal
        Likeness of any point of the picture to tube.
    """

    signal: Signal = field(kw_only=True)

    @cached_property
    def mask(self) -> Mask:
        """(H, W) what the tube covers in the picture."""
        height, width = self.signal.image.shape[:2]
        found = np.vstack([self.edges_px.reshape(-1, 2), self.tip.contour_px])
        room = _ROOM_WIDTHS * float(np.median(self.widths_px))
        left, top = np.clip(np.floor(found.min(0) - room), 0, (width, height)).astype(int)
        right, bottom = np.clip(np.ceil(found.max(0) + room) + 1, 0, (width, height)).astype(int)
        columns, rows = np.meshgrid(np.arange(left, right), np.arange(top, bottom))
        tube = self.signal(np.stack([columns, rows], -1).astype(float)) > TUBE
        _, labels = cv2.connectedComponents(tube.astype(np.uint8), connectivity=4)
        x, y = (np.rint(self.centreline_px) - (left, top)).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < labels.shape[1]) & (y < labels.shape[0])
        own = np.bincount(labels[y[inside], x[inside]], minlength=2)
        mask = np.zeros((height, width), bool)
        mask[top:bottom, left:right] = labels == 1 + int(own[1:].argmax())
        return mask

    def pixels(self) -> Array:
        """(N, 2) the pixels of the mask."""
        y, x = np.nonzero(self.mask)
        return np.stack([x, y], -1).astype(float)


def see_region(
    name: str,
    image: Image,
    background: Image | None,
    camera: Camera,
    tube: Tube,
    start: Start | None,
    base_px: Array | None = None,
) -> RegionView:
    """See the tube in one picture and keep its signal; parameters as those of `tubesight.vision.see.see`."""
    view = see(name, image, background, camera, tube, start, base_px)
    k = int(_COLOURS_AT * len(view.centreline_px))
    ahead = view.centreline_px[min(k + 3, len(view.centreline_px) - 1)] - view.centreline_px[k]
    way = ahead / np.linalg.norm(ahead)
    signal = choose(image, background, view.centreline_px[k], way, float(np.median(view.widths_px)))
    return RegionView(**{f.name: getattr(view, f.name) for f in fields(View)}, signal=signal)
