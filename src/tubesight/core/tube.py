"""What the user knows of the tube."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

TipShape = Literal["ball", "round", "flat"]


@dataclass(frozen=True, slots=True)
class Tip:
    """End of the tube: a ball, the rounded end of the tube itself, or a flat cut.

    Attributes
    ----------
    shape
        ``ball``, ``round`` or ``flat``.
    diameter_mm
        Diameter of the ball; None for round and flat ends, which have the tube's diameter.
    """

    shape: TipShape = "round"
    diameter_mm: float | None = None

    def __post_init__(self) -> None:
        if self.shape not in ("ball", "round", "flat"):
            raise ValueError(f"tip shape: expected ball, round or flat, got {self.shape!r}")
        if self.shape == "ball" and not (self.diameter_mm is not None and self.diameter_mm > 0):
            raise ValueError(f"a ball tip needs a positive diameter_mm, got {self.diameter_mm}")


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
    """

    diameter_mm: float | None = None
    tip: Tip = field(default_factory=Tip)
    clamped: bool = False

    def __post_init__(self) -> None:
        if self.diameter_mm is not None and not self.diameter_mm > 0:
            raise ValueError(f"diameter_mm: expected a positive number, got {self.diameter_mm}")
