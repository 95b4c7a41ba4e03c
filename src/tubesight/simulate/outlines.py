"""The silhouette of a tube as edge points, exact and without a picture: what an ideal edge finder would return."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tubesight.core import Array, Tube
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.simulate.phantom import Phantom

# Edges of a side and of the contour of the tip that count: a photograph shows more, but neighbours err alike.
SCANS, CONTOUR = 24, 16
# Half of the part of the tip's outline that the tube does not cover.
_HALF_CONTOUR_RAD = 1.4


@dataclass(frozen=True, slots=True, eq=False)
class Stations:
    """Where a tube is looked at: points of its centreline, the last one its tip.

    Attributes
    ----------
    points_mm, tangents
        (..., `SCANS` + 1, 3) in the base frame.
    """

    points_mm: Array
    tangents: Array


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """Silhouette of a tube in one picture; NaN where there is none.

    Attributes
    ----------
    edges_px
        (..., `SCANS`, 2, 2) left and right edge (left of the way from base to tip, y down).
    contour_px
        (..., `CONTOUR`, 2) of the tip.
    tip_px, base_px
        (..., 2) projected ends of the centreline.
    """

    edges_px: Array
    contour_px: Array
    tip_px: Array
    base_px: Array


def stations(phantom: Phantom, tube: Tube) -> Stations:
    """Spread the scans evenly from base to where the tip's ball begins."""
    radius, ball = radii_mm(tube)
    covered = float(np.sqrt(max(ball**2 - radius**2, 0.0)))
    # The first scan lies clear of the clamp by half of a step.
    s = np.append((np.arange(SCANS) + 0.5) / SCANS * (phantom.length_mm - covered), phantom.length_mm)
    return Stations(phantom.at(s), phantom.tangent(s))


def radii_mm(tube: Tube) -> tuple[float, float]:
    """Radius of a tube and of its tip; a round end has the tube's own.

    Raises
    ------
    ValueError
        If the diameter is not known, or the end is flat: its outline is no circle.
    """
    if tube.diameter_mm is None or tube.tip.shape == "flat":
        raise ValueError(f"outlines need a known diameter and a ball or round tip, got {tube}")
    return tube.diameter_mm / 2, (tube.tip.diameter_mm or tube.diameter_mm) / 2


def outline(seen: Stations, camera: Camera, camera_from_base: Pose, tube: Tube) -> Outline:
    """Project the silhouette.

    A plane through the camera's centre C touches the tube at ``p + r n`` where ``n . (C - p) = r`` and n is normal to
    the tangent at p; a ball is touched along the circle under the half angle ``asin(r / distance)``.
    """
    radius, ball = radii_mm(tube)
    centre = camera_from_base.inverse().translation_mm
    points, tangents = seen.points_mm[..., :-1, :], seen.tangents[..., :-1, :]
    towards = centre - points
    towards = towards - (towards * tangents).sum(-1, keepdims=True) * tangents
    away = np.linalg.norm(towards, axis=-1, keepdims=True)
    # The camera looks along the tube from inside its prolongation: no edge.
    cosine = np.where(away > radius, radius / np.maximum(away, radius), np.nan)
    sideways = np.cross(tangents, towards / away) * np.sqrt(1 - cosine**2)
    contacts = [points + radius * (cosine * towards / away + sign * sideways) for sign in (1, -1)]
    ends = camera.project(camera_from_base.apply(seen.points_mm[..., [-1, 0], :]))
    tip, forward = (
        camera_from_base.apply(seen.points_mm[..., -1, :]),
        camera_from_base.rotate(seen.tangents[..., -1, :]),
    )
    contour = camera.project(_circle(tip, forward, ball))
    return Outline(
        camera.project(camera_from_base.apply(np.stack(contacts, -2))), contour, ends[..., 0, :], ends[..., 1, :]
    )


def _circle(tip_mm: Array, forward: Array, radius_mm: float) -> Array:
    """Rays (..., `CONTOUR`, 3) of the outline of a ball on the side that `forward` points to, camera frame."""
    distance = np.linalg.norm(tip_mm, axis=-1, keepdims=True)
    axis = tip_mm / distance
    side = np.cross(axis, forward)
    side = (side / np.linalg.norm(side, axis=-1, keepdims=True))[..., None, :]
    half = np.arcsin(radius_mm / distance)[..., None, :]
    angle = np.linspace(-_HALF_CONTOUR_RAD, _HALF_CONTOUR_RAD, CONTOUR)[:, None]
    around = np.cos(angle) * np.cross(side, axis[..., None, :]) + np.sin(angle) * side
    return np.asarray(np.cos(half) * axis[..., None, :] + np.sin(half) * around)
