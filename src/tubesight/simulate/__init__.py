"""Ground truth: phantoms, optics and sensor noise, independent of the reconstruction it judges."""

from tubesight.simulate.boards import render_board_pair
from tubesight.simulate.cover import Cover, cover
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
from tubesight.simulate.variants import VARIANTS, Stage, stage

__all__ = [
    "VARIANTS",
    "Arc",
    "Cover",
    "CurvaturePolynomial",
    "EllipseArc",
    "Helix",
    "Phantom",
    "Pieces",
    "Placed",
    "Scene",
    "Stage",
    "board_views",
    "cover",
    "render",
    "render_background",
    "render_board_pair",
    "render_pair",
    "rig_around",
    "stage",
    "straight",
    "truth",
]
