"""Tubes of known shape, photographed as each rival needs them, and how far its curve is off."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tubesight.core import FramePair, Tip, Tube
from tubesight.geometry.polyline import place_along
from tubesight.geometry.rig import Rig
from tubesight.methods import METHODS
from tubesight.sensor import Reconstruction, ShapeSensor
from tubesight.simulate import Arc, CurvaturePolynomial, Helix, Phantom, Pieces, Scene, render_pair, rig_around, stage

RIG = rig_around(90.0, size_px=(1280, 720))
# What a pixel is worth at the tube: 310 mm over a focal length of 743 px.
MM_PER_PX = 310.0 / 743.0

BALL = Tube(12.0, Tip("ball", 16.0), clamped=True)
THIN = Tube(4.0, Tip("round"), clamped=True)
ARC = Arc(np.radians(40), np.radians(30), 150.0)
S_SHAPE = Pieces((Arc(np.radians(40), np.radians(20), 75.0), Arc(np.radians(45), np.radians(200), 75.0)))
SPATIAL = Pieces(tuple(Arc(np.radians(a), np.radians(phi), 50.0) for a, phi in ((40, 20), (35, 120), (30, 250))))
POLYNOMIAL = CurvaturePolynomial((0.004, 0.003, -0.002), np.radians(60), 150.0)
HELIX = Helix(0.008, 0.01, np.radians(10), 150.0)
# Its bend sharpens so much that its halves are not mirror images.
HOOK = CurvaturePolynomial((0.008, 0.012), np.radians(60), 150.0)


@dataclass(frozen=True)
class Outcome:
    """What a method made of a tube.

    Attributes
    ----------
    found
        The reconstruction.
    tip_mm, mean_mm
        Distance of the tip from the true one, and mean distance of the true centreline from the curve.
    """

    found: Reconstruction
    tip_mm: float
    mean_mm: float


@lru_cache(maxsize=48)
def photograph(phantom: Phantom, tube: Tube, variant: str, rig: Rig = RIG) -> tuple[Rig, FramePair]:
    """Photograph a tube as a variant of a scene shows it."""
    staged = stage(variant, rig, phantom, Scene())
    return staged.rig, render_pair(staged.rig, phantom, tube, staged.scene)


def outcome(name: str, phantom: Phantom, tube: Tube = BALL, variant: str | None = None, rig: Rig = RIG) -> Outcome:
    """Photograph a tube as a method needs it and let the method measure it."""
    seen_by, pair = photograph(phantom, tube, variant or METHODS[name].scene, rig)
    return compared(ShapeSensor(seen_by, tube, name)(pair), phantom)


def compared(found: Reconstruction, phantom: Phantom) -> Outcome:
    """Compare what was found with the truth."""
    if found.curve is None:
        return Outcome(found, float("nan"), float("nan"))
    truth = phantom.at(np.linspace(0.0, phantom.length_mm, 200))
    curve = found.curve.at(np.linspace(0.0, found.curve.length_mm, 400))
    _, off = place_along(curve, truth)
    return Outcome(found, float(np.linalg.norm(curve[-1] - truth[-1])), float(np.mean(off)))
