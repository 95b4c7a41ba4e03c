"""What one camera saw of the tube."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from tubesight.core import Array, Mask, readonly

T = TypeVar("T")


def _of_own(cls: type[T], values: tuple[Any, ...]) -> T:
    """Fill the slots of a frozen class; arrays become read-only."""
    made = object.__new__(cls)
    for name, value in zip(cls.__slots__, values, strict=True):  # type: ignore[attr-defined]
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
        object.__setattr__(made, name, value)
    return made


@dataclass(frozen=True, slots=True, eq=False)
class TipView:
    """The end of the tube in one picture.

    Attributes
    ----------
    axis
        (3,) unit ray of the camera through the tip: centre of the ball or of the rounded end, middle of a flat face.
    px
        (2,) the same as a pixel.
    angle_rad
        Half the angle under which the ball or rounded end is seen; NaN for a flat end.
    contour_px
        (K, 2) edge points it rests on.
    rms_px, doubt_px
        Their root mean square distance from the model, and how far they all may be off.
    """

    axis: Array
    px: Array
    angle_rad: float
    contour_px: Array
    rms_px: float
    doubt_px: float

    @classmethod
    def of_own(cls, *values: Any) -> TipView:
        """Make one of arrays that nobody else holds and whose shapes are right: they are not copied."""
        return _of_own(cls, values)

    def __post_init__(self) -> None:
        for name, shape in (("axis", (3,)), ("px", (2,)), ("contour_px", (None, 2))):
            object.__setattr__(self, name, readonly(getattr(self, name), shape, name))


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Edges, centreline and tip of the tube in one picture, in order from the base.

    Attributes
    ----------
    camera
        Name.
    edges_px
        (N, 2, 2) left and right edge of each scan (left of the way from base to tip, y down), sub-pixel.
    edge_rays
        (N, 2, 3) the same as undistorted unit rays.
    rays
        (N, 3) centreline as ``v = (x, y, 1)``: the bisector of the two unit edge rays.
    centreline_px
        (N, 2) the same as pixels.
    base
        (3,) ray ``v = (x, y, 1)`` of the place where the tube starts: the projected clamp, or where its edges begin.
    tip
        The end of the tube.
    edge_sd_px
        (2,) roughness of the left and right row of edges: robust deviation of an edge from its neighbours' line.
    edge_doubt_px
        (2,) how far the whole row may be off (`tubesight.vision.edges.Edges`).
    blur_px
        Measured width of the edges as the sigma of a Gaussian, median.
    segmenter
        Which segmenter was chosen and why, one sentence.
    notes
        Cautions: gaps bridged and the like.
    """

    camera: str
    edges_px: Array
    edge_rays: Array
    rays: Array
    centreline_px: Array
    base: Array
    tip: TipView
    edge_sd_px: Array
    edge_doubt_px: Array
    blur_px: float
    segmenter: str
    notes: tuple[str, ...] = ()

    @classmethod
    def of_own(cls, *values: Any) -> View:
        """Make one of arrays that nobody else holds and whose shapes are right: they are not copied."""
        return _of_own(cls, values)

    def __post_init__(self) -> None:
        n = len(self.edges_px)
        shapes = {
            "edges_px": (n, 2, 2),
            "edge_rays": (n, 2, 3),
            "rays": (n, 3),
            "centreline_px": (n, 2),
            "base": (3,),
            "edge_sd_px": (2,),
            "edge_doubt_px": (2,),
        }
        for name, shape in shapes.items():
            object.__setattr__(self, name, readonly(getattr(self, name), shape, name))

    @property
    def tip_px(self) -> Array:
        """(2,) the tip as a pixel."""
        return self.tip.px

    @property
    def widths_px(self) -> Array:
        """(N,) distance between the two edges of each scan."""
        return np.asarray(np.linalg.norm(self.edges_px[:, 0] - self.edges_px[:, 1], axis=-1))

    def scans(self, keep: Mask, **changes: Any) -> View:
        """Return the same view with some of its scans (N,), and with other changes."""
        rows = ("edges_px", "edge_rays", "rays", "centreline_px")
        return replace(self, **{name: getattr(self, name)[keep] for name in rows}, **changes)
