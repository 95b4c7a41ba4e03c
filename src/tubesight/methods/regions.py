"""Views that keep their picture's signal: what the methods that look into the pictures themselves share."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tubesight.core import Array, Status, Unmeasurable
from tubesight.geometry.rig import Rig
from tubesight.methods.agreement import best_pair
from tubesight.methods.centreline import resampled, way_of
from tubesight.vision.region import RegionView
from tubesight.vision.view import View


def regions(views: Mapping[str, View]) -> dict[str, RegionView]:
    """Return views with their signals, two or more.

    Raises
    ------
    ValueError
        If they were seen by a strategy that does not keep them.
    Unmeasurable
        If there are fewer than two.
    """
    found = {name: view for name, view in views.items() if isinstance(view, RegionView)}
    if len(found) < len(views):
        raise ValueError("this method needs views of `tubesight.vision.region.see_region`")
    if len(found) < 2:
        raise Unmeasurable(Status.TOO_FEW_POINTS, detail="two views are needed")
    return found


def rough_way(views: Mapping[str, View], rig: Rig, count: int) -> Array:
    """Points (N, 3) near the tube: equal shares of the two most different centrelines, triangulated.

    Raises
    ------
    Unmeasurable
        If the centrelines do not meet in front of the cameras.
    """
    share = np.linspace(0.0, 1.0, count)
    points = rig.triangulate({name: resampled(way_of(views[name]), share) for name in best_pair(views, rig)})
    if not np.isfinite(points).all():
        raise Unmeasurable(Status.VIEWS_DISAGREE, detail="the centrelines do not meet in front of the cameras")
    return points
