"""Where cameras of known lenses are, from points known in a frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from tubesight.calibration.scene import Observation, Scene
from tubesight.core import Array
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose, register_rigid
from tubesight.geometry.rig import Rig

# Errors count up to this many pixels: a pose that puts one board right and another far off must not lose to one that
# puts both moderately wrong.
_CAP_PX = 50.0
# Ratio of the extents of a point set below which it counts as a line.
FLAT = 1e-3
# The same for a plane: a board's corners are one up to rounding, and the solver for planes insists on it.
_PLANE = 1e-6


def extents(points_mm: Array) -> Array:
    """Singular values (3,) of a point set about its mean: its extents along three axes, largest first."""
    values = np.linalg.svd(points_mm - points_mm.mean(0), compute_uv=False)
    return np.concatenate([values, np.zeros(3)])[:3]


def camera_poses(camera: Camera, points_mm: Array, px: Array) -> list[Pose]:
    """All poses ``camera_from_frame`` a camera may have to see known points (N, 3) at pixels (N, 2).

    A plane has two (Collins & Bartoli 2014), of which noise may prefer the wrong one; three points in space have up to
    four (Gao et al. 2003), six or more have one (Terzakis & Lourakis 2020).
    """
    rays = camera.unproject(px)[:, :2]
    seen = np.isfinite(rays).all(1)
    if seen.sum() < 4:
        return []
    points, rays = points_mm[seen], rays[seen]
    size = extents(points)
    if size[1] <= FLAT * size[0]:
        return []
    if size[2] <= _PLANE * size[0]:
        method = cv2.SOLVEPNP_IPPE
    elif len(points) >= 6:
        method = cv2.SOLVEPNP_SQPNP
    else:
        method, points, rays = cv2.SOLVEPNP_AP3P, points[:4], rays[:4]
    _, turns, shifts, _ = cv2.solvePnPGeneric(points, np.ascontiguousarray(rays), np.eye(3), None, flags=method)
    poses = [Pose.from_rotvec(r, t) for r, t in zip(turns, shifts, strict=True) if np.isfinite([r, t]).all()]
    return [p for p in poses if (p.apply(points)[:, 2] > 0).all()]


def resect(
    cameras: Mapping[str, Camera],
    camera_from_rig: Mapping[str, Pose],
    sights: Sequence[Sequence[Observation]],
) -> tuple[Pose, list[Observation]] | None:
    """Pose of a frame that all cameras of a rig see parts of.

    Every observation proposes poses of its own, cameras that share points propose one from triangulation; the
    proposal with the smallest error over all observations wins.

    Parameters
    ----------
    sights
        Per picture the ways it may be read (a board that looks alike when turned has several), points in the frame.

    Returns
    -------
    tuple or None
        ``rig_from_frame`` and the reading chosen per picture; None where no picture proposes a pose.
    """
    proposals = []
    for readings in sights:
        for o in readings:
            rig_from_camera = camera_from_rig[o.camera].inverse()
            proposals += [rig_from_camera @ p for p in camera_poses(cameras[o.camera], o.points_mm, o.px)]
    proposals += _by_triangulation(Rig(cameras, camera_from_rig), sights)
    best: tuple[float, Pose, list[Observation]] | None = None
    for pose in proposals:
        scene = Scene(cameras, camera_from_rig, dict.fromkeys({o.view for s in sights for o in s}, pose))
        errors = [[_error_px(scene, o) for o in readings] for readings in sights]
        chosen = [int(np.argmin(e)) for e in errors]
        total = sum(min(e) * len(s[0].px) for e, s in zip(errors, sights, strict=True))
        # Equal up to rounding: the first proposal, which takes boards as they were found, stays.
        if best is None or total < best[0] * (1 - 1e-9) - 1e-9:
            best = total, pose, [s[i] for s, i in zip(sights, chosen, strict=True)]
    return None if best is None else best[1:]


def _error_px(scene: Scene, o: Observation) -> float:
    distance = np.linalg.norm(scene.project(o) - o.px, axis=1)
    return float(np.minimum(np.nan_to_num(distance, nan=_CAP_PX), _CAP_PX).mean())


def _by_triangulation(rig: Rig, sights: Sequence[Sequence[Observation]]) -> list[Pose]:
    """Rigid registration of the points two cameras share, each picture read in the first way."""
    points = np.concatenate([s[0].points_mm for s in sights])
    unique, index = np.unique(points, axis=0, return_inverse=True)
    rays = {s[0].camera: np.full((len(unique), 3), np.nan) for s in sights}
    start = 0
    for s in sights:
        o = s[0]
        rays[o.camera][index.ravel()[start : start + len(o.px)]] = rig.cameras[o.camera].unproject(o.px)
        start += len(o.px)
    if len(rays) < 2:
        return []
    found = rig.triangulate(rays)
    known = np.isfinite(found).all(1)
    if known.sum() < 3 or (size := extents(unique[known]))[1] <= FLAT * size[0]:
        return []
    return [register_rigid(found[known], unique[known])]
