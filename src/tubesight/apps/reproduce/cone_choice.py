"""Which camera makes the cone, and which root is taken: the paper's rules against those of `cone_ray`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tubesight.apps.reproduce.mockup import LENGTH_MM
from tubesight.core import Array
from tubesight.geometry.cone import Cone, epipolar_crossing, nearest_depth, ordered_depths
from tubesight.geometry.polyline import place_along
from tubesight.geometry.rig import Rig
from tubesight.methods.cone_ray import simplest_conic
from tubesight.methods.dalvand import curvature
from tubesight.simulate import rig_around
from tubesight.simulate.phantom import Arc

# Points of the centreline in each picture, one every 3 mm.
_POINTS = 54
# How far off the observed arc a root may lie, as `cone_ray` has it: a quarter of a tube's width.
_TOLERANCE_PX = 11.0
# A reconstruction fails where more than a tenth of its points are off by more than this, or not there.
OFF_MM, _OFF_SHARE = 2.0, 0.1
RULES = tuple((camera, root) for camera in ("curvature", "crossing") for root in ("equation 10", "order"))


@dataclass(frozen=True, slots=True)
class Choices:
    """All orientations of a tube at one angle of the cameras; the task of `chosen`."""

    angle_deg: float
    bending_deg: float
    noise_px: float
    orientations_deg: tuple[float, ...]
    seed: int


def chosen(task: Choices) -> list[dict[str, Any]]:
    """Reconstruct by each pair of rules: a row each with failures and the distance most points keep."""
    rig, rng = rig_around(task.angle_deg), np.random.default_rng(task.seed)
    off: dict[tuple[str, str], list[float]] = {rule: [] for rule in RULES}
    for azimuth in task.orientations_deg:
        phantom = Arc(float(np.radians(task.bending_deg)), float(np.radians(azimuth)), LENGTH_MM)
        arcs = {name: _arc(rig, name, phantom, task.noise_px, rng) for name in rig.names}
        for rule in RULES:
            off[rule].append(_off_mm(_points(rig, arcs, *rule), phantom))
    about = {
        "angle_deg": task.angle_deg,
        "bending_deg": task.bending_deg,
        "noise_px": task.noise_px,
        "n": len(task.orientations_deg),
    }
    return [
        about
        | {
            "camera": camera,
            "root": root,
            "failures": sum(not mm <= OFF_MM for mm in far),
            "off_median_mm": float(np.median(far)),
        }
        for (camera, root), far in off.items()
    ]


def _arc(rig: Rig, name: str, phantom: Arc, noise_px: float, rng: np.random.Generator) -> Array:
    """Rays ``v = (x, y, 1)`` (N, 3) of noisy points of the centreline, from base to tip."""
    local = rig.camera_from_base[name].apply(phantom.at(np.linspace(0.0, phantom.length_mm, _POINTS)))
    rays = local / local[:, 2:]
    rays[:, :2] += rng.normal(size=(_POINTS, 2)) * noise_px / rig.cameras[name].focal_px
    return np.asarray(rays)


def _points(rig: Rig, arcs: dict[str, Array], camera: str, root: str) -> Array:
    """Points (N, 3) in the base frame where the rays of one camera meet the cone over the other's arc."""
    first, second = rig.names
    if camera == "curvature":
        value = {name: curvature(arc) for name, arc in arcs.items()}
    else:
        value = {
            a: epipolar_crossing(arcs[a][:, :2], rig.relative_pose(a, b).translation_mm)
            for a, b in ((first, second), (second, first))
        }
    cone, ray = (first, second) if value[first] >= value[second] else (second, first)
    pose, rays, focal = rig.relative_pose(cone, ray), arcs[ray], rig.cameras[cone].focal_px
    hits = Cone(simplest_conic(arcs[cone][:, :2], focal)).intersect(pose, rays)
    if root == "order":
        depths = ordered_depths(hits, pose, rays, arcs[cone][:, :2], _TOLERANCE_PX / focal)
    else:
        depths = nearest_depth(hits, float(rig.camera_from_base[ray].translation_mm[2]))
    return rig.camera_from_base[ray].inverse().apply(rays * depths[:, None])


def _off_mm(points: Array, phantom: Arc) -> float:
    """Distance from the true curve that all but a tenth of the points keep; infinite where that many are missing."""
    _, off = place_along(phantom.at(np.linspace(0.0, phantom.length_mm, 201)), points)
    return float(np.sort(np.nan_to_num(off, nan=np.inf))[int((1 - _OFF_SHARE) * len(off))])
