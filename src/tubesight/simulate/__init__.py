"""Ground truth: phantoms, optics and sensor noise, independent of the reconstruction it judges."""

from tubesight.simulate.boards import render_board_pair
from tubesight.simulate.phantom import (
    Arc,
    CurvaturePolynomial,
    EllipseArc,
    Helix,
    Phantom,
    Pieces,
    Placed,
    straight,
    truth,
)
from tubesight.simulate.render import render, render_background, render_pair
from tubesight.simulate.rigs import board_views, rig_around
from tubesight.simulate.scene import Scene

__all__ = [
    "Arc",
    "CurvaturePolynomial",
    "EllipseArc",
    "Helix",
    "Phantom",
    "Pieces",
    "Placed",
    "Scene",
    "board_views",
    "render",
    "render_background",
    "render_board_pair",
    "render_pair",
    "rig_around",
    "straight",
    "truth",
]
