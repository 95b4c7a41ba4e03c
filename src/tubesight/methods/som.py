"""A chain of neurons drawn onto silhouettes, after Croom, Rucker, Romano & Webster (2010).

A self-organising map in its stereo form: pixels of the silhouettes of all pictures are drawn at random in turn; the
neuron b whose projection is nearest to the pixel wins, and it and its neighbours i on the chain move towards the
pixel's ray by ``a(t) exp(-(i - b)^2 / (2 s(t)^2))``, both annealed. What is left is a chain in the middle of all
silhouettes.

Reconstructed here: the chain starts as a straight one between the ends of the centrelines, which stands for the initial
guess that the original is given, and each neuron moves to the foot of its own perpendicular on the ray, so that the
chain is not drawn together along the line of sight. The ends of the chain shrink back from those of the tube, as those
of every such map do: it has no tip of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from tubesight.core import Array, Status, Tube, Unmeasurable
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.polyline import lengths_along
from tubesight.geometry.rig import Rig
from tubesight.geometry.splines import smoothing
from tubesight.methods.agreement import reprojection_rms_px, triangulate_tip
from tubesight.methods.regions import regions, rough_way
from tubesight.vision.view import View

# Neurons of the chain: 5 mm apart on a tube of 150 mm, which follows bends of 30 mm radius to 0.1 mm.
_NEURONS = 31
# Pixels drawn: some hundred for each neuron.
_DRAWS = 12_000
# Annealing of the step and of the neighbourhood (neurons), geometric from first to last.
_STEP, _REACH = (0.5, 0.02), (6.0, 0.8)
# Deviation of a neuron at the end, as a share of the tube's radius: the last step times half a width.
_SD_RADII = 0.05
# Largest rms, px and as a share of the tube's width: the chain lies in the silhouettes but for its ends, or it has been
# caught elsewhere.
_OFF_PX, _OFF_WIDTHS = 4.0, 0.3
_SEED = 0


class _Sight(NamedTuple):
    """One camera: rotation (3, 3) and translation (3,) into it, its centre (3,), and its silhouette's rays (N, 2)."""

    rotation: Array
    translation: Array
    centre: Array
    plane: Array


def solve(views: Mapping[str, View], rig: Rig, tube: Tube) -> Curve3D:
    """Draw the chain onto the silhouettes and smooth it.

    Raises
    ------
    Unmeasurable
        If there are not two views, their tips do not meet, or the chain ends elsewhere than in the silhouettes.
    """
    # Silhouettes alone tell badly whether the pictures are of one tube.
    triangulate_tip(views, rig)
    seen = regions(views)
    sights = []
    for name, view in seen.items():
        pose = rig.camera_from_base[name]
        rays = rig.cameras[name].unproject(view.pixels())[:, :2]
        sights.append(_Sight(pose.rotation, pose.translation_mm, rig.centre_mm(name), rays))
    ends = rough_way(views, rig, 5)[[0, -1]]
    share = np.linspace(0.0, 1.0, _NEURONS)[:, None]
    chain = draw_chain((1 - share) * ends[0] + share * ends[1], sights)
    place = lengths_along(chain)
    widths = {name: float(np.median(view.widths_px)) for name, view in seen.items()}
    if not (np.isfinite(place).all() and np.diff(place).min() > 0):
        raise Unmeasurable(Status.NEAR_DEGENERATE, detail="neurons of the chain fell together")
    first = next(iter(seen))
    depth = float(rig.camera_from_base[first].apply(chain)[:, 2].mean())
    radius = widths[first] / 2 * depth / rig.cameras[first].focal_px
    curve = smoothing(chain, place, np.full(_NEURONS, _SD_RADII * radius))
    rms = reprojection_rms_px(curve, views, rig)
    if not rms <= max(_OFF_PX, _OFF_WIDTHS * min(widths.values())):
        raise Unmeasurable(Status.RESIDUAL_TOO_LARGE, detail=f"rms {rms:.0f} px: the chain missed a part of the tube")
    return curve


def draw_chain(chain: Array, sights: list[_Sight]) -> Array:
    """Draw a chain (N, 3) onto the rays of the sights, in turn."""
    rng = np.random.default_rng(_SEED)
    chain = chain.copy()
    index = np.arange(len(chain))
    steps, reaches = (np.geomspace(*span, _DRAWS) for span in (_STEP, _REACH))
    drawn = rng.random(_DRAWS)
    for k in range(_DRAWS):
        sight = sights[k % len(sights)]
        pixel = sight.plane[int(drawn[k] * len(sight.plane))]
        local = chain @ sight.rotation.T + sight.translation
        off = local[:, :2] / local[:, 2:] - pixel
        best = int((off * off).sum(1).argmin())
        near = steps[k] * np.exp(-0.5 * ((index - best) / reaches[k]) ** 2)
        way = sight.rotation.T @ np.array([pixel[0], pixel[1], 1.0])
        way /= np.sqrt(way @ way)
        from_centre = chain - sight.centre
        foot = (from_centre @ way)[:, None] * way
        chain += near[:, None] * (foot - from_centre)
    return chain
