"""What the user knows of the tube."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

TipShape = Literal["ball", "round", "flat", "open"]
TIP_SHAPES: tuple[TipShape, ...] = get_args(TipShape)


@dataclass(frozen=True, slots=True)
class Tip:
    """End of the tube: a ball, the rounded end of the tube itself, a flat cut, or one that is not seen.

    Attributes
    ----------
    shape
        ``ball``, ``round``, ``flat``, or ``open`` where the end is not seen or not to be used: the part that all views
        see is measured then, and its last point stands for the tip.
    diameter_mm
        Diameter of the ball; None for round and flat ends, which have the tube's diameter, and for open ones.
    """

    shape: TipShape = "round"
    diameter_mm: float | None = None

    def __post_init__(self) -> None:
        if self.shape not in TIP_SHAPES:
            raise ValueError(f"tip shape: expected {', '.join(TIP_SHAPES)}, got {self.shape!r}")
        if self.shape == "ball" and not (self.diameter_mm is not None and self.diameter_mm > 0):
            raise ValueError(f"a ball tip needs a positive diameter_mm, got {self.diameter_mm}")

    @property
    def rounded(self) -> bool:
        """Whether the contour of the end is that of a ball or a half ball, whose centre is the tip."""
        return self.shape in ("ball", "round")


@dataclass(frozen=True, slots=True)
class Tube:
    """A slender tube of circular section.

    Attributes
    ----------
    diameter_mm
        Outer diameter; None where it is unknown and has to be estimated from the pictures.
    tip
        The distal end.
    clamped
        True where the centreline leaves the origin of the base frame along its +z axis.
    tapered
        True where the diameter changes along the tube, as it does from tube to tube of a concentric-tube robot: what
        counts then is the middle between both edges. `diameter_mm` is that at the base.
    """

    diameter_mm: float | None = None
    tip: Tip = field(default_factory=Tip)
    clamped: bool = False
    tapered: bool = False

    def __post_init__(self) -> None:
        if self.diameter_mm is not None and not self.diameter_mm > 0:
            raise ValueError(f"diameter_mm: expected a positive number, got {self.diameter_mm}")
