"""The shapes that are to be measured, and how well a rig measures them all."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from tubesight.apps.planning.information import Errors, information
from tubesight.apps.planning.prediction import Deviations, combine
from tubesight.core import Array, Tube
from tubesight.geometry.rig import Rig
from tubesight.simulate.phantom import Arc

# What is predicted, with the unit of the tables.
QUANTITIES: Mapping[str, str] = {"tip": "mm", "bending": "deg", "orientation": "deg", "length": "mm"}


@dataclass(frozen=True, slots=True)
class Workspace:
    """Circular bends of a clamped tube.

    Attributes
    ----------
    bending_deg, orientation_deg
        From, to.
    """

    length_mm: float
    bending_deg: tuple[float, float]
    orientation_deg: tuple[float, float]

    def grid(self, bendings: int, orientations: int) -> tuple[Array, Array]:
        """Bendings and orientations in degrees, evenly spread; a whole turn does not come back to its start."""
        low, high = self.orientation_deg
        whole = high - low >= 360
        bending = np.unique(np.linspace(*self.bending_deg, bendings))
        return bending, np.unique(np.linspace(low, high, orientations, endpoint=not whole))

    def poses(self, bendings: int, orientations: int) -> list[Arc]:
        """Tubes on the grid, one for a straight one."""
        bending, orientation = self.grid(bendings, orientations)
        return [
            Arc(float(np.radians(b)), float(np.radians(o)), self.length_mm)
            for b in bending
            for o in (orientation if b > 0 else orientation[:1])
        ]


@dataclass(frozen=True, slots=True)
class Pose:
    """One pose of the workspace: what a rig sees of it, and its predicted deviations.

    Attributes
    ----------
    unseen_by
        Cameras that do not see all of the tube.
    """

    bending_deg: float
    orientation_deg: float
    unseen_by: tuple[str, ...]
    deviations: Deviations

    def row(self) -> dict[str, Any]:
        """Row of ``plan.csv``."""
        d = self.deviations
        return {
            "bending_deg": self.bending_deg,
            "orientation_deg": self.orientation_deg,
            "unseen_by": " ".join(self.unseen_by),
            **{f"{name}_sd_{unit}": self.of(name) for name, unit in QUANTITIES.items()},
            **{f"tip_{axis}_sd_mm": asdict(d)[f"tip_{axis}_mm"] for axis in "xyz"},
        }

    def of(self, quantity: str) -> float:
        """Deviation of one of `QUANTITIES` in its unit."""
        d = self.deviations
        return {
            "tip": d.tip_mm,
            "bending": float(np.degrees(d.bending_rad)),
            "orientation": float(np.degrees(d.orientation_rad)),
            "length": d.length_mm,
        }[quantity]


def survey(
    phantoms: Sequence[Arc],
    rig: Rig,
    tube: Tube,
    errors: Errors,
    margin_px: float,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> list[Pose]:
    """Predict the deviations of a rig at each pose."""
    found = []
    for k, phantom in enumerate(phantoms):
        told = {name: information(phantom, rig, name, tube, errors, margin_px) for name in rig.names}
        unseen = tuple(name for name, view in told.items() if not view.seen)
        bending, orientation = np.degrees([phantom.theta_rad, phantom.phi_rad]).tolist()
        found.append(Pose(bending, orientation, unseen, combine(phantom, told, rig, errors)))
        progress("workspace", k + 1, len(phantoms))
    return found


def summary(poses: Sequence[Pose]) -> dict[str, Any]:
    """Share of the poses that all cameras see, and mean, 95th percentile and largest deviation of each quantity."""
    made: dict[str, Any] = {"poses": len(poses), "seen": sum(not pose.unseen_by for pose in poses) / len(poses)}
    for name, unit in QUANTITIES.items():
        values = np.array([pose.of(name) for pose in poses])
        values = values[np.isfinite(values)]
        known = len(values) > 0
        made[f"{name}_sd_{unit}"] = {
            "mean": float(values.mean()) if known else float("nan"),
            "p95": float(np.percentile(values, 95)) if known else float("nan"),
            "max": float(values.max()) if known else float("nan"),
        }
    return made
