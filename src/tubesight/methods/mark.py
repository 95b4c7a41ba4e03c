"""A base marked by hand: the tube starts there, whatever is seen of it before."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tubesight.core import Array, Status, Tube, Unmeasurable
from tubesight.geometry.polyline import lengths_along, place_along, points_at
from tubesight.geometry.rig import Rig
from tubesight.vision.view import View

# Places clicked by hand are a few pixels off, on a thick tube more: rays that miss each other by more than this, and
# by more than half a width, are of different places.
_MISS_PX, _MISS_WIDTHS = 8.0, 0.5
# A mark farther beside the tube than this many widths is not of it.
_BESIDE_WIDTHS = 1.5
# Fewest scans that have to be left between the mark and the tip.
_SCANS_MIN = 8


def from_mark(views: Mapping[str, View], rig: Rig, marks_px: Mapping[str, Array]) -> dict[str, View]:
    """Let every view start at a base that is marked in two or more of them.

    The marks are triangulated; in each view the foot of that point on the centreline becomes the base, and scans before
    it are left out.

    Parameters
    ----------
    marks_px
        By camera name: (2,) pixel of the base. With a single mark the views are returned as they are.

    Raises
    ------
    Unmeasurable
        If the marks are of different places, or not on the tube.
    """
    marks = {n: rig.cameras[n].unproject(px)[None] for n, px in marks_px.items() if n in views}
    if len(marks) < 2:
        return dict(views)
    base: Array = rig.triangulate(marks)[0]
    for name in marks:
        miss = float(np.linalg.norm(rig.project(name, base) - marks_px[name]))
        if not miss <= max(_MISS_PX, _MISS_WIDTHS * float(np.median(views[name].widths_px))):
            raise Unmeasurable(Status.VIEWS_DISAGREE, name, f"the marks of the base miss each other by {miss:.0f} px")
    return {name: _cut(view, rig.project(name, base), rig) for name, view in views.items()}


def marked_width_px(name: str, rig: Rig, tube: Tube, marks_px: Mapping[str, Array]) -> float | None:
    """Width of the tube in one picture at a base marked in two or more; None where it or the diameter is not known."""
    marks = {n: rig.cameras[n].unproject(px)[None] for n, px in marks_px.items()}
    if len(marks) < 2 or tube.diameter_mm is None:
        return None
    depth = float(rig.camera_from_base[name].apply(rig.triangulate(marks)[0])[2])
    return tube.diameter_mm * rig.cameras[name].focal_px / depth if depth > 0 else None


def _cut(view: View, base_px: Array, rig: Rig) -> View:
    """Leave out what a view shows before the foot of the base on its centreline."""
    place, off = place_along(view.centreline_px, base_px[None])
    chord = lengths_along(view.centreline_px)
    width = float(np.median(view.widths_px))
    if not (np.isfinite(base_px).all() and (off[0] <= _BESIDE_WIDTHS * width or place[0] < 0)):
        raise Unmeasurable(Status.BASE_HIDDEN, view.camera, f"the mark is {off[0]:.0f} px beside the tube")
    keep = chord >= place[0]
    if keep.sum() < _SCANS_MIN:
        raise Unmeasurable(Status.TOO_FEW_POINTS, view.camera, "the mark is at the tip; does it mark the base?")
    foot = base_px
    if 0 <= place[0] <= chord[-1]:
        foot = points_at(view.centreline_px, chord, place[0])
    return view.scans(keep, base=rig.cameras[view.camera].unproject(foot))
