"""What a method is: a way to see the tube in a picture with a way to turn the views into a curve."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from tubesight.core import Array, Image, Tube
from tubesight.geometry.camera import Camera
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.rig import Rig
from tubesight.vision.see import Start, see
from tubesight.vision.view import View

# (camera name, picture, background, camera, tube, start, base pixel) -> View; see `tubesight.vision.see.see`.
Vision = Callable[[str, Image, Image | None, Camera, Tube, Start | None, Array | None], View]


@dataclass(frozen=True, slots=True)
class Method:
    """A registered method: a vision strategy with a solver.

    Attributes
    ----------
    name, summary, citation
        Name on the command line, one sentence, and where it is from.
    traits
        A row of table 2 of Dalvand et al. 2016: what it needs and what it gives.
    solve
        ``(views, rig, tube) -> Curve3D``; raises `Unmeasurable` where the views do not give a curve.
    see
        The vision strategy: one picture to one `View`; raises `Unmeasurable` where the tube is not seen.
    whole
        Whether views of the whole silhouette (`tubesight.methods.whole`) are tried where what `see` gives leads to no
        curve: it follows shapes that cross themselves or are partly hidden.
    solve_again
        ``(views, rig, tube, family) -> Curve3D``: the same, told of which family the curve was a moment ago (its
        `Curve3D.model`); None for methods to which that means nothing.
    given
        What it is given beyond two calibrated pictures: ``markers``, ``length``, ``initial guess``, ``8 views`` ...
    scene
        The variant of a simulated scene that shows all this (`tubesight.simulate.stage`); ``plain`` where the pictures
        of any two cameras will do.
    """

    name: str
    summary: str
    citation: str
    traits: Mapping[str, str]
    solve: Callable[[Mapping[str, View], Rig, Tube], Curve3D]
    see: Vision = see
    whole: bool = False
    solve_again: Callable[[Mapping[str, View], Rig, Tube, str], Curve3D] | None = None
    given: tuple[str, ...] = ()
    scene: str = "plain"
