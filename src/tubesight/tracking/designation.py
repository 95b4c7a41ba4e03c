"""Which device is measured: designated once, and kept while others cross it or cover it.

By hand its tip is marked in pictures; after that, and without marks, the last good frames say which device it is. A
device has a base, a length and a tip, and none of them changes from one moment to the next but by its motion. What
contradicts one of them is another device, or a view that followed one, and not measured. Where the tip can be by now
is for the tracker's prediction to say; base and length hold also where nothing was measured for a while.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from tubesight.core import Array, Status
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.shape import Shape
from tubesight.sensor import Reconstruction
from tubesight.vision.view import View

# Good pairs after which a device is known by its base and length; until then any shape may take its place.
_SETTLED = 10
# Base and length may be off by this share of the length: over simulated tubes of all shapes the length stays within
# 0.4 %, and the base of a free tube within 0.4 mm of 150; photographs of real tubes are not as good.
_SHARE = 0.03
# Tubes are pushed, and bases that nothing holds are carried, at up to 100 mm/s. That is followed while frames come; a
# longer gap than a tenth of a second makes no more room, or anything would do after a while.
_MOVED_MM_PER_S, _LONGEST_S = 100.0, 0.1
# A tip marked by hand is some pixels beside the tip, on a thick tube more: so many pixels, or widths.
_MARK_PX, _MARK_WIDTHS = 15.0, 2.0
# A view whose tip is farther from where it was than this many widths, while that of another is not, follows something
# else: tips that move are displaced in all views, but for motions along a line of sight.
_APART_WIDTHS = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Designation:
    """What is known of the device that is measured.

    Attributes
    ----------
    tip_px
        By camera name: (2,) its tip; marked by hand while `count` is zero, later where it was last.
    has_end
        Whether its end is seen: without, its length is that of the part in view and says nothing.
    base_mm, length_mm, time_s
        (3,) where it starts, its length, and when they were last measured; NaN before.
    count
        Pairs that agreed so far.
    """

    tip_px: Mapping[str, Array] = field(default_factory=dict)
    has_end: bool = True
    base_mm: Array = field(default_factory=lambda: np.full(3, np.nan))
    length_mm: float = math.nan
    time_s: float = math.nan
    count: int = 0

    @property
    def settled(self) -> bool:
        """Whether the device is known well enough to refuse others."""
        return self.count >= _SETTLED


def agreed(known: Designation, result: Reconstruction, shape: Shape, curve: Curve3D, time_s: float) -> Designation:
    """Take into account a reconstruction that is of the device."""
    tips = {name: view.tip_px for name, view in result.views.items()}
    base = curve.at(np.zeros(1))[0]
    return replace(
        known, tip_px=tips, base_mm=base, length_mm=shape.length_mm, time_s=time_s, count=min(known.count + 1, _SETTLED)
    )


def contradiction(known: Designation, result: Reconstruction, shape: Shape, curve: Curve3D, time_s: float) -> str:
    """Say why a reconstruction is not of the device; nothing where it may be."""
    if known.count == 0:
        return _off_the_mark(known, result.views)
    if not known.settled:
        return ""
    since_s = min(max(time_s - known.time_s, 0.0), _LONGEST_S)
    room_mm = _SHARE * known.length_mm + _MOVED_MM_PER_S * since_s
    away_mm = float(np.linalg.norm(curve.at(np.zeros(1))[0] - known.base_mm))
    if away_mm > room_mm:
        return f"what was measured starts {away_mm:.0f} mm from the base: another device"
    longer_mm = shape.length_mm - known.length_mm
    if known.has_end and abs(longer_mm) > room_mm:
        word = "longer" if longer_mm > 0 else "shorter"
        return f"what was measured is {abs(longer_mm):.0f} mm {word} than the tube: another device, or part of one"
    return ""


def withheld(result: Reconstruction, why: str) -> Reconstruction:
    """Return a reconstruction of something else: its views stay, its numbers do not."""
    return replace(
        result, status=Status.OTHER_DEVICE, notes=(f"{Status.OTHER_DEVICE.advice} ({why})",), shape=None, curve=None
    )


def followers(known: Designation, views: Mapping[str, View]) -> str:
    """Name the views that follow something else, where others show the tip where it was; else nothing."""
    apart = {
        name: float(np.linalg.norm(view.tip_px - known.tip_px[name])) / float(np.median(view.widths_px))
        for name, view in views.items()
        if name in known.tip_px
    }
    off = [name for name, widths in apart.items() if widths > _APART_WIDTHS]
    return " and ".join(off) if 0 < len(off) < len(apart) else ""


def _off_the_mark(known: Designation, views: Mapping[str, View]) -> str:
    for name, mark in known.tip_px.items():
        if name in views:
            view = views[name]
            off_px = float(np.linalg.norm(view.tip_px - mark))
            if not off_px <= max(_MARK_PX, _MARK_WIDTHS * float(np.median(view.widths_px))):
                return f"the tip found in {name} is {off_px:.0f} px from the one marked: another device"
    return ""
