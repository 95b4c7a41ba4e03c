"""``plan.yaml``: the cameras one has, the tube, where it will move, and where cameras may stand."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from tubesight.apps.planning.information import Errors
from tubesight.apps.planning.placement import Camera, Rules, Sector
from tubesight.apps.planning.workspace import Workspace
from tubesight.core import InputError, Tip, Tube
from tubesight.files.safe import Strict, load_yaml, refuse

# Written by `tubesight plan --example`; its values are the defaults.
EXAMPLE = """\
# What `tubesight plan` reads. Every key may be left out; these are the defaults.
tube:
  diameter_mm: 12.0
  length_mm: 160.0
  tip: {shape: ball, diameter_mm: 16.0}  # ball or round
workspace:                    # the shapes to be measured: circular bends of a clamped tube
  bending_deg: [0, 90]
  orientation_deg: [0, 360]
cameras:
  count: 2
  size_px: [1920, 1080]
  view_deg: 81.0              # across the picture's width; or focal_px
  portrait: false             # true: the long side of the picture along the tube
placement:                    # seen from the middle of the workspace
  distance_mm: [250, 400]
  azimuth_deg: [0, 360]       # about the base's z, from its x
  elevation_deg: [0, 0]       # above 0 on the side of the clamp (-z)
  apart_deg: 20               # least angle between the lines of sight of any two cameras
  forbidden: []               # directions, e.g. {azimuth_deg: [80, 120], elevation_deg: [-90, 90]}
  margin_px: 20               # that the tube keeps from the border of a picture
errors:                       # standard deviations
  noise_px: 0.06              # of each edge by itself
  shading_px: 0.05            # of a row of edges, by light and compression
  bias_px: 0.1                # of all edges of a picture, by blur and gamma
  clamp_mm: 0.03
  clamp_deg: 0.03
  calibration_px: 0.1         # by which each camera points beside where the calibration says
"""

_Range = tuple[float, float]
_Size = Annotated[int, Field(ge=64, le=16384)]


class _TipFile(Strict):
    shape: Literal["ball", "round"] = "ball"
    diameter_mm: PositiveFloat | None = None


class _TubeFile(Strict):
    diameter_mm: PositiveFloat = 12.0
    length_mm: PositiveFloat = 160.0
    tip: _TipFile = _TipFile(diameter_mm=16.0)


class _WorkspaceFile(Strict):
    bending_deg: _Range = (0.0, 90.0)
    orientation_deg: _Range = (0.0, 360.0)


class _CamerasFile(Strict):
    count: Annotated[int, Field(ge=2, le=6)] = 2
    size_px: tuple[_Size, _Size] = (1920, 1080)
    view_deg: Annotated[float, Field(gt=1, lt=150)] | None = None
    focal_px: PositiveFloat | None = None
    portrait: bool = False


class _SectorFile(Strict):
    azimuth_deg: _Range = (0.0, 360.0)
    elevation_deg: _Range = (-90.0, 90.0)


class _PlacementFile(Strict):
    distance_mm: tuple[PositiveFloat, PositiveFloat] = (250.0, 400.0)
    azimuth_deg: _Range = (0.0, 360.0)
    elevation_deg: _Range = (0.0, 0.0)
    apart_deg: Annotated[float, Field(ge=0, lt=180)] = 20.0
    forbidden: Annotated[tuple[_SectorFile, ...], Field(max_length=50)] = ()
    margin_px: NonNegativeFloat = 20.0


class _ErrorsFile(Strict):
    noise_px: PositiveFloat = 0.06
    shading_px: NonNegativeFloat = 0.05
    bias_px: NonNegativeFloat = 0.1
    clamp_mm: PositiveFloat = 0.03
    clamp_deg: PositiveFloat = 0.03
    calibration_px: NonNegativeFloat = 0.1


class _PlanFile(Strict):
    tube: _TubeFile = _TubeFile()
    workspace: _WorkspaceFile = _WorkspaceFile()
    cameras: _CamerasFile = _CamerasFile()
    placement: _PlacementFile = _PlacementFile()
    errors: _ErrorsFile = _ErrorsFile()


@dataclass(frozen=True, slots=True)
class Task:
    """What is to be planned.

    Attributes
    ----------
    calibration_px
        Deviation of the direction of each camera that is to be placed, in pixels of its picture.
    """

    tube: Tube
    workspace: Workspace
    count: int
    camera: Camera
    rules: Rules
    errors: Errors
    calibration_px: float


def load_plan(path: Path | None) -> Task:
    """Read ``plan.yaml``, or take its defaults where there is none.

    Raises
    ------
    InputError
        If the file does not describe a plan.
    """
    file = _PlanFile() if path is None else load_yaml(path, _PlanFile)
    where = Path("plan.yaml") if path is None else path
    if file.cameras.view_deg is not None and file.cameras.focal_px is not None:
        raise InputError(f"{where}: cameras: view_deg and focal_px say the same; remove one")
    for section, ranges in (
        ("workspace", file.workspace),
        ("placement", file.placement),
        *((f"placement.forbidden.{k}", sector) for k, sector in enumerate(file.placement.forbidden)),
    ):
        _check_ranges(where, section, ranges)
    width = file.cameras.size_px[0]
    view = np.radians(file.cameras.view_deg or 81.0)
    focal = file.cameras.focal_px or width / 2 / float(np.tan(view / 2))
    p, e, w = file.placement, file.errors, file.workspace
    try:
        tip = Tip(file.tube.tip.shape, file.tube.tip.diameter_mm if file.tube.tip.shape == "ball" else None)
        tube = Tube(file.tube.diameter_mm, tip, clamped=True)
        if tip.diameter_mm is not None and tip.diameter_mm < file.tube.diameter_mm:
            raise ValueError("tube.tip.diameter_mm: a ball is not thinner than its tube; write 'shape: round'")
        if file.tube.length_mm < 2 * max(file.tube.diameter_mm, tip.diameter_mm or 0.0):
            raise ValueError("tube.length_mm: a tube is at least twice as long as it is thick")
        return Task(
            tube,
            Workspace(file.tube.length_mm, w.bending_deg, w.orientation_deg),
            file.cameras.count,
            Camera(file.cameras.size_px, focal, file.cameras.portrait),
            Rules(
                p.distance_mm,
                Sector(p.azimuth_deg, p.elevation_deg),
                p.apart_deg,
                tuple(Sector(s.azimuth_deg, s.elevation_deg) for s in p.forbidden),
                p.margin_px,
            ),
            Errors(e.noise_px, e.shading_px, e.bias_px, e.clamp_mm, float(np.radians(e.clamp_deg))),
            e.calibration_px,
        )
    except ValueError as error:
        refuse(where, error)


_LIMITS = {
    "bending_deg": (0, 175),
    "orientation_deg": (-360, 720),
    "azimuth_deg": (-360, 720),
    "elevation_deg": (-90, 90),
    "distance_mm": (1, 100_000),
}


def _check_ranges(path: Path, section: str, file: Strict) -> None:
    """Refuse ranges that run backwards, beyond what the quantity can be, or more than once around."""
    for name, value in file:
        if name not in _LIMITS:
            continue
        low, high = value
        least, most = _LIMITS[name]
        if not (least <= low <= high <= most):
            raise InputError(
                f"{path}: {section}.{name}: expected two ascending numbers from {least} to {most}, "
                f"got [{low:g}, {high:g}]"
            )
        if name in ("orientation_deg", "azimuth_deg") and high - low > 360:
            raise InputError(f"{path}: {section}.{name}: [{low:g}, {high:g}] is more than once around; write [0, 360]")
