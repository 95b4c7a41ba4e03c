"""What the views say together: the tip, the base, and how well a curve agrees with all of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from tubesight.core import Array, Status, Unmeasurable
from tubesight.core.kernels import COMPILED
from tubesight.geometry.camera import Camera
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.polyline import place_along
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.methods import agreement_kernels
from tubesight.methods.rays import lens, optics
from tubesight.vision.view import View

# Largest distance of the tip rays from each other; a quarter of a tube's width more where the base is only an edge of
# the picture of a holder.
_TIP_GAP_MAX_PX = 4.0
_BASE_GAP_WIDTHS = 0.5
# Contours of flat ends are off by this share of the pictures' blur: on 160 drawn ones with a blur of 0.6 to 2.2 px by
# 0.18 to 0.68 px (rms); and by no less than the first. Their images' movement is told by a step of the end. The last
# is what views tell that the end faces exactly: a metre.
_FLAT_OFF_PX, _FLAT_OFF_BLURS, _END_STEP_MM, _FLAT_LEAST = 0.05, 0.3, 0.1, 1e-6
# Places of a curve that are reprojected: its image strays from their polyline by less than 0.01 px.
_SHARES = np.linspace(0.0, 1.0, 100)


def best_pair(views: Mapping[str, View], rig: Rig) -> tuple[str, str]:
    """Names of the two views whose cameras look at the largest angle.

    Raises
    ------
    Unmeasurable
        If there are fewer than two views.
    """
    return _best_pair(tuple(views), rig)


@lru_cache(maxsize=8)
def _best_pair(names: tuple[str, ...], rig: Rig) -> tuple[str, str]:
    if len(names) < 2:
        raise Unmeasurable(Status.TOO_FEW_POINTS, detail="two views are needed")
    axes = {n: rig.camera_from_base[n].rotation[2] for n in names}
    pairs = [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]
    return max(pairs, key=lambda p: float(np.linalg.norm(np.cross(axes[p[0]], axes[p[1]]))))


def triangulate_tip(views: Mapping[str, View], rig: Rig) -> Array:
    """Tip (3,) from the axes of the tips in all views.

    Raises
    ------
    Unmeasurable
        If the axes do not meet.
    """
    tip = triangulated({name: view.tip.axis / view.tip.axis[2] for name, view in views.items()}, rig)
    for name, view in views.items():
        off = math.dist(projected(rig, name, tip).tolist(), view.tip.px.tolist())
        if not off <= _TIP_GAP_MAX_PX:
            raise Unmeasurable(
                Status.VIEWS_DISAGREE, detail=f"the tip's rays miss each other by {off:.1f} px in {name}"
            )
    return tip


def triangulated(rays: Mapping[str, Array], rig: Rig) -> Array:
    """Point (3,) nearest to one ray (3,) ``v = (x, y, 1)`` of each camera (`Rig.triangulate`)."""
    if not COMPILED:
        return np.asarray(rig.triangulate({name: ray[None] for name, ray in rays.items()})[0])
    sight = optics(rig, tuple(rays))
    return agreement_kernels.triangulated(
        np.stack(list(rays.values())), sight.rotation, sight.translation_mm, sight.focal_px
    )


def projected(rig: Rig, name: str, point_mm: Array) -> Array:
    """Pixel (2,) of a point (3,) of the base frame (`Rig.project`); NaN where it is not in front of the camera."""
    known = lens(rig.cameras[name]) if COMPILED else None
    if known is None:
        return rig.project(name, point_mm)
    pose, px = rig.camera_from_base[name], np.empty(2)
    seen = agreement_kernels.projected(point_mm, pose.rotation, pose.translation_mm, *known, px)
    return px if seen else np.full(2, np.nan)


def base_of(views: Mapping[str, View], rig: Rig) -> Array | None:
    """Triangulate the base (3,) of a free tube from where its start is seen; None where the rays do not meet."""
    base = triangulated({name: view.base for name, view in views.items()}, rig)
    for name, view in views.items():
        off = float(np.linalg.norm(projected(rig, name, base) - rig.cameras[name].project(view.base)))
        if not off <= _BASE_GAP_WIDTHS * float(np.median(view.widths_px)):
            return None
    return base


def reprojection_rms_px(curve: Curve3D, views: Mapping[str, View], rig: Rig) -> float:
    """Root mean square distance of the views' centrelines and tips from the reprojected curve, all views, pixels."""
    points = curve.at(_SHARES * curve.length_mm)
    squares, count = 0.0, 0
    for name, view in views.items():
        camera, pose = rig.cameras[name], rig.camera_from_base[name]
        known = lens(camera) if COMPILED else None
        if known is None:
            squares += off_squares(points, pose, camera, view)
        else:
            squares += agreement_kernels.off_squares(
                points, pose.rotation, pose.translation_mm, *known, view.centreline_px, view.tip.px
            )
        count += len(view.centreline_px) + 1
    return math.sqrt(squares / count)


def off_squares(points_mm: Array, camera_from_base: Pose, camera: Camera, view: View) -> float:
    """Sum of squared distances of a view's centreline and tip from a reprojected polyline (N, 3), pixels.

    Infinite where it is not all in front of the camera.
    """
    px = camera.project(camera_from_base.apply(points_mm))
    if not np.isfinite(px).all():
        return math.inf
    _, off = place_along(px, np.vstack([view.centreline_px, view.tip.px]))
    return float(off @ off)


def flat_tip_sd_mm(views: Mapping[str, View], rig: Rig, tip_mm: Array, tangent: Array) -> float:
    """Deviation along the tube of a flat end (3,): a view tells as much as its image moves when the end moves so.

    A view that the end faces tells nothing.
    """
    information = 0.0
    for name, view in views.items():
        here, there = rig.project(name, np.stack([tip_mm, tip_mm + _END_STEP_MM * tangent]))
        moves = float(np.linalg.norm(there - here)) / _END_STEP_MM
        information += (moves / math.hypot(_FLAT_OFF_PX, _FLAT_OFF_BLURS * view.blur_px)) ** 2
    return 1 / math.sqrt(max(information, _FLAT_LEAST))


def _facing(view: View) -> Array:
    """Way (2,) in the picture that a flat end's contour faces: normal to its longest extent, away from the tube."""
    contour = view.tip.contour_px
    normal = np.linalg.svd(contour - contour.mean(0), full_matrices=False)[2][-1]
    return np.asarray(normal if normal @ (view.tip.px - view.centreline_px[-1]) >= 0 else -normal)


def flat_tip(views: Mapping[str, View], rig: Rig, tip_mm: Array, tangent: Array, radius_mm: float) -> Array:
    """Middle (3,) of a flat end face, with the rim that the tangent predicts laid on each view's contour.

    Where the face is seen obliquely, its contour is half of the rim's image. The first guess of the tip is moved in
    each picture, in the way that the contour faces, by the median distance of the contour from the predicted rim.

    Parameters
    ----------
    tip_mm, tangent
        (3,) first guess of the tip, and the unit tangent there.
    """
    side = np.cross(tangent, [1.0, 0.0, 0.0] if abs(tangent[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    angle = np.linspace(0, 2 * np.pi, 144, endpoint=False)[:, None]
    rim = tip_mm + radius_mm * (np.cos(angle) * side + np.sin(angle) * np.cross(tangent, side))
    rays = {}
    for name, view in views.items():
        px = rig.project(name, tip_mm)
        heading = _facing(view)
        left = np.array([heading[1], -heading[0]])
        ring, contour = rig.project(name, rim) - px, view.tip.contour_px - px
        across, ahead = contour @ left, contour @ heading
        front = ring[np.argsort(ring @ left)]
        front = front[front @ heading >= 0]
        inner = np.abs(across) < 0.85 * np.abs(front @ left).max()
        if not inner.any():
            raise Unmeasurable(Status.VIEWS_DISAGREE, detail=f"the end face in {name} lies beside the curve's end")
        shift = float(np.median(ahead[inner] - np.interp(across[inner], front @ left, front @ heading)))
        rays[name] = rig.cameras[name].unproject(px + shift * heading)[None]
    return np.asarray(rig.triangulate(rays)[0])
