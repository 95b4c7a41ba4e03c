"""Bands on the tube in space: what the methods that need markers share."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tubesight.core import Array, Status, Tube, Unmeasurable
from tubesight.geometry.rig import Rig
from tubesight.methods.agreement import base_of
from tubesight.vision.bands import BandView
from tubesight.vision.view import View

# Rays of one band that miss each other by more than this share of the tube's width are of different bands.
_MISS_WIDTHS = 0.35


def banded(views: Mapping[str, View]) -> dict[str, BandView]:
    """Return views with their bands.

    Raises
    ------
    ValueError
        If they were seen by a strategy that does not look for bands.
    """
    found = {name: view for name, view in views.items() if isinstance(view, BandView)}
    if len(found) < len(views):
        raise ValueError("this method needs views of `tubesight.vision.bands.Bands`")
    return found


def triangulate_bands(views: Mapping[str, View], rig: Rig) -> Array:
    """Middle (K, 3) of each band: the i-th of one view is the i-th of the other.

    Raises
    ------
    Unmeasurable
        If there are not two views, they show different numbers of bands, or the rays of a band do not meet.
    """
    seen = banded(views)
    if len(seen) < 2:
        raise Unmeasurable(Status.TOO_FEW_POINTS, detail="two views are needed")
    counts = {name: len(view.bands_px) for name, view in seen.items()}
    if len(set(counts.values())) > 1:
        told = ", ".join(f"{n} in {name}" for name, n in counts.items())
        raise Unmeasurable(Status.VIEWS_DISAGREE, detail=f"bands: {told}")
    points = rig.triangulate({name: rig.cameras[name].unproject(view.bands_px) for name, view in seen.items()})
    for name, view in seen.items():
        miss = np.linalg.norm(rig.project(name, points) - view.bands_px, axis=1) / float(np.median(view.widths_px))
        k = int(np.nan_to_num(miss, nan=np.inf).argmax())
        if not miss[k] <= _MISS_WIDTHS:
            raise Unmeasurable(
                Status.VIEWS_DISAGREE, name, f"the rays of band {k + 1} miss each other by {miss[k]:.1f} widths"
            )
    return points


def base_point(views: Mapping[str, View], rig: Rig, tube: Tube) -> Array | None:
    """Place (3,) where the tube starts: the clamp, or where the views see its base; None where they do not."""
    return np.zeros(3) if tube.clamped else base_of(views, rig)
