"""``scene.yaml``: what `tubesight simulate` photographs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from tubesight.apps.simulate import DatasetPlan
from tubesight.core import Board, Tip, Tube
from tubesight.files.rig import load_rig
from tubesight.files.safe import Strict, load_yaml, refuse
from tubesight.simulate import (
    Arc,
    CurvaturePolynomial,
    EllipseArc,
    Helix,
    Phantom,
    Pieces,
    Scene,
    rig_around,
    straight,
)

_Level = Annotated[float, Field(ge=0, le=255)]
_Colour = tuple[_Level, _Level, _Level]
_Share = Annotated[float, Field(ge=0, le=1)]


class _Straight(Strict):
    kind: Literal["straight"]
    length_mm: PositiveFloat

    def phantom(self) -> Phantom:
        return straight(self.length_mm)


class _Bend(Strict):
    theta_deg: float
    phi_deg: float = 0.0
    length_mm: PositiveFloat

    def phantom(self) -> Arc:
        return Arc(np.radians(self.theta_deg), np.radians(self.phi_deg), self.length_mm)


class _Arc(_Bend):
    kind: Literal["circle"]


class _Ellipse(Strict):
    kind: Literal["ellipse"]
    theta_deg: float
    ratio: PositiveFloat
    phi_deg: float = 0.0
    length_mm: PositiveFloat

    def phantom(self) -> Phantom:
        return EllipseArc(np.radians(self.theta_deg), self.ratio, np.radians(self.phi_deg), self.length_mm)


class _Segments(Strict):
    kind: Literal["segments"]
    segments: Annotated[list[_Bend], Field(min_length=1, max_length=20)]

    def phantom(self) -> Phantom:
        return Pieces(tuple(piece.phantom() for piece in self.segments))


class _Polynomial(Strict):
    kind: Literal["polynomial"]
    curvature_per_mm: Annotated[list[float], Field(min_length=1, max_length=10)]
    phi_deg: float = 0.0
    length_mm: PositiveFloat

    def phantom(self) -> Phantom:
        return CurvaturePolynomial(tuple(self.curvature_per_mm), np.radians(self.phi_deg), self.length_mm)


class _Helix(Strict):
    kind: Literal["helix"]
    curvature_per_mm: PositiveFloat
    torsion_per_mm: float
    phi_deg: float = 0.0
    length_mm: PositiveFloat

    def phantom(self) -> Phantom:
        return Helix(self.curvature_per_mm, self.torsion_per_mm, np.radians(self.phi_deg), self.length_mm)


_Shape = Annotated[
    _Straight | _Arc | _Ellipse | _Segments | _Polynomial | _Helix,
    Field(discriminator="kind"),
]


class _RigAround(Strict):
    angle_deg: Annotated[float, Field(gt=0, lt=180)] = 90.0
    distance_mm: PositiveFloat = 310.0
    focal_px: PositiveFloat | None = None
    size_px: tuple[Annotated[int, Field(ge=64, le=8192)], Annotated[int, Field(ge=64, le=8192)]] = (1920, 1080)
    elevation_deg: Annotated[float, Field(gt=-80, lt=80)] = 0.0
    names: Annotated[tuple[str, ...], Field(min_length=1, max_length=8)] = ("left", "right")


class _TipFile(Strict):
    shape: Literal["ball", "round", "flat"] = "ball"
    diameter_mm: PositiveFloat | None = None


class _TubeFile(Strict):
    diameter_mm: PositiveFloat = 12.0
    tip: _TipFile = _TipFile(shape="ball", diameter_mm=16.0)


class _BoardFile(Strict):
    type: Literal["chessboard", "charuco"] = "chessboard"
    squares: tuple[PositiveInt, PositiveInt] = (10, 7)
    square_mm: PositiveFloat = 13.0
    marker_mm: PositiveFloat | None = None
    dictionary: str | None = None


class _Look(Strict):
    """The fields of `Scene` that a file sets; the others keep their defaults."""

    tube_bgr: _Colour | None = None
    cloth_bgr: _Colour | None = None
    specular: NonNegativeFloat | None = None
    light: tuple[float, float, float] | None = None
    ambient: _Share | None = None
    holder_diameter_mm: NonNegativeFloat | None = None
    shadow: _Share | None = None
    texture: _Share | None = None
    gradient: _Share | None = None
    vignetting: _Share | None = None
    clutter: Annotated[int, Field(ge=0, le=500)] | None = None
    blur_px: Annotated[float, Field(ge=0, le=20)] | None = None
    noise_levels: Annotated[float, Field(ge=0, le=100)] | None = None


class _SceneFile(Strict):
    shapes: Annotated[dict[str, _Shape], Field(min_length=1, max_length=10_000)]
    rig: _RigAround | str = _RigAround()
    tube: _TubeFile = _TubeFile()
    board: _BoardFile = _BoardFile()
    board_views: Annotated[int, Field(ge=0, le=200)] = 14
    seed: Annotated[int, Field(ge=0)] = 0
    look: _Look = _Look()


def load_scene(path: Path) -> DatasetPlan:
    """Read ``scene.yaml``; raise `InputError` where it does not describe a scene.

    Keys: ``shapes`` (by name; ``kind`` is ``straight``, ``circle``, ``ellipse``, ``segments``, ``polynomial`` or
    ``helix``), ``rig`` (a rig file's name, or ``angle_deg``, ``distance_mm`` ...), ``tube``, ``board``,
    ``board_views``, ``look`` (the fields of `tubesight.simulate.Scene`), ``seed``.
    """
    file = load_yaml(path, _SceneFile)
    try:
        rig = load_rig(path.parent / file.rig).rig if isinstance(file.rig, str) else rig_around(**file.rig.model_dump())
        board = Board(**file.board.model_dump())
        tip = Tip(file.tube.tip.shape, file.tube.tip.diameter_mm)
        return DatasetPlan(
            phantoms={name: shape.phantom() for name, shape in file.shapes.items()},
            rig=rig,
            tube=Tube(file.tube.diameter_mm, tip, clamped=True),
            board=board,
            scene=Scene(**file.look.model_dump(exclude_none=True), seed=file.seed),
            board_views=file.board_views,
            board_seed=file.seed,
        )
    except ValueError as error:
        refuse(path, error)
