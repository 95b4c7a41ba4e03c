"""Views made from outlines: what a method is given when the pictures have been looked at, without any pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tubesight.apps.planning.information import Errors, clamped_anyhow, noisy
from tubesight.core import Array, Tube
from tubesight.geometry.camera import Camera
from tubesight.geometry.rig import Rig
from tubesight.simulate.outlines import Outline, outline, stations
from tubesight.simulate.phantom import Arc, Phantom
from tubesight.vision.rays import tangent_cone, tube_rays
from tubesight.vision.view import TipView, View

# Blur of the pictures that were not taken; no method looks at it.
_BLUR_PX = 0.8


def view_of(seen: Outline, name: str, camera: Camera, errors: Errors) -> View:
    """Undistort the edges of an outline and fit its tip, as is done for those of a picture."""
    heading = seen.edges_px[-1].mean(0) - seen.edges_px[-2].mean(0)
    heading = heading / np.linalg.norm(heading)
    tube = tube_rays(camera, seen.edges_px, heading, seen.tip_px, 0.0, 0.0, seen.base_px)
    axis, px, contour_px, angle_rad, rms_px = tangent_cone(camera, seen.contour_px)
    doubt = np.full(2, errors.shading_px)
    tip = TipView(axis, px, angle_rad, contour_px, rms_px, errors.shading_px)
    edges_px, edge_rays, rays, centreline_px, base, edge_sd_px = tube
    return View(
        name, edges_px, edge_rays, rays, centreline_px, base, tip, edge_sd_px, doubt, _BLUR_PX, "simulated edges"
    )


def exact_views(phantom: Phantom, rig: Rig, tube: Tube) -> dict[str, Outline]:
    """Outlines of a tube in all cameras of a rig."""
    seen = stations(phantom, tube)
    return {name: outline(seen, rig.cameras[name], rig.camera_from_base[name], tube) for name in rig.names}


@dataclass(frozen=True, slots=True, eq=False)
class Draw:
    """One draw of everything that errs: the tube as it is, and the views that a method is given of it."""

    tube_as_it_is: Phantom
    views: dict[str, View]


def draw(phantom: Arc, rig: Rig, tube: Tube, errors: Errors, rng: np.random.Generator) -> Draw:
    """Draw edges, clamp and calibration with their errors.

    The rig that a method is to use is `rig`; the pictures are taken by one that differs from it by a draw of the
    calibration's covariance.
    """
    there = clamped_anyhow(phantom, errors, rng)
    seen = exact_views(there, drawn_rig(rig, rng), tube)
    views = {name: view_of(noisy(seen[name], errors, rng), name, rig.cameras[name], errors) for name in rig.names}
    return Draw(there, views)


def drawn_rig(rig: Rig, rng: np.random.Generator) -> Rig:
    """Draw a rig from the covariance of the calibration; the rig itself where it has none."""
    if rig.covariance is None:
        return rig
    values, vectors = np.linalg.eigh(rig.covariance.matrix)
    moved: Array = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.normal(size=len(values)))
    there = rig
    for name, delta in zip(rig.covariance.names, moved.tolist(), strict=True):
        there = there.perturbed(name, delta)
    return replace(there, covariance=rig.covariance)
