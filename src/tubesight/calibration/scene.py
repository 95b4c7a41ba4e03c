"""What a bundle adjustment moves and what holds it: scenes, observations, free parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from tubesight.core import Array, readonly
from tubesight.geometry.camera import Camera
from tubesight.geometry.lens import LENSES
from tubesight.geometry.pose import Pose

POSE = ("rx", "ry", "rz", "tx", "ty", "tz")
# Coefficients of the brown lens that a calibration can free, in the lens's order.
BROWN = LENSES["brown"].coefficients
# Elements of the camera matrix that a parameter moves.
_PLACES = {
    "f": ((0, 0), (1, 1)),
    "fx": ((0, 0),),
    "fy": ((1, 1),),
    "cx": ((0, 2),),
    "cy": ((1, 2),),
    "skew": ((0, 1),),
}


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Known points seen in one picture.

    Attributes
    ----------
    camera
        Name of the camera.
    view
        Name of the frame the points are given in; views share their pose between cameras.
    points_mm
        (N, 3), frame of the view.
    px
        (N, 2)
    sd_px
        Standard deviation of a coordinate relative to that of the other observations.
    """

    camera: str
    view: str
    points_mm: Array
    px: Array
    sd_px: float = 1.0

    def __post_init__(self) -> None:
        points = readonly(self.points_mm, (None, 3), "points_mm")
        object.__setattr__(self, "points_mm", points)
        object.__setattr__(self, "px", readonly(self.px, (len(points), 2), "px"))


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What a bundle adjustment moves.

    Attributes
    ----------
    cameras, camera_from_base
        By camera name.
    base_from_view
        By name of the view; a view is a board's or, once registered, the base frame itself.
    """

    cameras: Mapping[str, Camera]
    camera_from_base: Mapping[str, Pose]
    base_from_view: Mapping[str, Pose]

    def __post_init__(self) -> None:
        for name in ("cameras", "camera_from_base", "base_from_view"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    def project(self, observation: Observation) -> Array:
        """Pixels (N, 2) at which the points of an observation should appear."""
        pose = self.camera_from_base[observation.camera] @ self.base_from_view[observation.view]
        return self.cameras[observation.camera].project(pose.apply(observation.points_mm))


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What is known of a view's pose before any picture: it is near the identity.

    Attributes
    ----------
    pivot_mm
        (3,): point of the view's frame about which rotation and translation are independent.
    sd_rad, sd_mm
        Standard deviations of each component, divided by that of a pixel coordinate.
    """

    view: str
    pivot_mm: Array
    sd_rad: float
    sd_mm: float


@dataclass(frozen=True, slots=True)
class Free:
    """What may move: names of lens parameters by camera, cameras whose pose moves, views whose pose moves."""

    lens: Mapping[str, tuple[str, ...]]
    cameras: tuple[str, ...] = ()
    views: tuple[str, ...] = ()

    @property
    def rig_names(self) -> tuple[str, ...]:
        """Names of the rig's free parameters, ``camera.parameter``, in the order of the Jacobian's first columns."""
        names: list[str] = []
        for camera in dict.fromkeys([*self.lens, *self.cameras]):
            names += [f"{camera}.{p}" for p in self.lens.get(camera, ())]
            names += [f"{camera}.{p}" for p in POSE] if camera in self.cameras else []
        return tuple(names)

    @property
    def count(self) -> int:
        """Number of parameters."""
        return len(self.rig_names) + 6 * len(self.views)


def rms(residuals_px: Sequence[Array]) -> float:
    """Root mean square length of residuals (N, 2)."""
    return float(np.sqrt(np.mean(np.concatenate([(r**2).sum(1) for r in residuals_px])))) if residuals_px else 0.0


def with_lens(camera: Camera, change: Mapping[str, float]) -> Camera:
    """Add changes to lens parameters (``f`` moves both focal lengths); focal lengths stay positive."""
    matrix, distortion = camera.matrix.copy(), camera.distortion.copy()
    for name, step in change.items():
        for place in _PLACES.get(name, ()):
            matrix[place] += step
        if name in BROWN:
            distortion[BROWN.index(name)] += step
    for i in (0, 1):
        # A step of the solver may overshoot; it is then taken back.
        matrix[i, i] = max(matrix[i, i], 1.0)
    return Camera(matrix, camera.size_px, distortion, camera.lens)
