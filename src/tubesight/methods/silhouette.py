"""The silhouette fit: the curve whose tube has the edges that the pictures show.

No edge is paired with another and no view with another: each sub-pixel edge ray asks only that the tube touch it,
which is exact for a tube of constant radius. The family of the curve is the simplest one that explains the edges.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from tubesight.core import Array, Status, Tube, Unmeasurable
from tubesight.geometry.arcs import clamped_arc
from tubesight.geometry.curve import Curve3D, NodeCurve
from tubesight.geometry.families import FAMILIES, bends_of_pieces
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.methods.agreement import flat_tip, triangulate_tip
from tubesight.methods.fit import Fit, Problem, collect, fit_family
from tubesight.methods.uncertainty import displaced, picture_covariance, rig_covariance
from tubesight.vision.view import View

# The simplest family whose rms is within this factor of the best one's is taken: residuals on photographs are
# systematic, so that a criterion for independent noise would take too rich a family.
_SIMPLEST_WITHIN = 1.35
# Rms under which families are not compared: shading and compression move edges by this much.
_RMS_FLOOR_PX = 0.06
# A plane quadratic curve with a smaller rms than this is not challenged by shapes of several bends: on photographs the
# right family leaves 0.03 to 0.2 px, a wrong one over 0.5 px.
_GOOD_PX = 0.25
# A tube whose centreline bends more sharply than this share of its radius' inverse kinks.
_SHARPEST = 0.7
# No family with a larger rms is an answer.
_RMS_MAX_PX = 0.6

Starter = Callable[[Mapping[str, View], Rig, Tube], Curve3D]


@dataclass(frozen=True, slots=True)
class Silhouette:
    """Silhouette fit as a method.

    Attributes
    ----------
    starter
        Method that gives the first curve of a tube without a clamp.
    """

    starter: Starter

    def __call__(self, views: Mapping[str, View], rig: Rig, tube: Tube) -> Curve3D:
        """Fit all families that are needed and return the simplest that explains the edges.

        Raises
        ------
        Unmeasurable
            If the views contradict each other or no family explains them.
        """
        tip = triangulate_tip(views, rig)
        start = Pose.identity() if tube.clamped else _frame_at_start(self.starter(views, rig, tube))
        problem = _problem(views, rig, tube, start, tip)
        chosen = choose_family(problem, tip)
        if tube.tip.shape == "flat":
            curve = _curve(chosen)
            tip = flat_tip(
                views, rig, curve.at([curve.length_mm])[0], curve.tangent([curve.length_mm])[0], problem.radius_mm
            )
            problem = replace(problem, end_mm=tip)
            chosen = fit_family(problem, chosen.family, chosen.parameters[: chosen.family.count])
        if chosen.rms_px > _RMS_MAX_PX:
            raise Unmeasurable(Status.RESIDUAL_TOO_LARGE, detail=f"rms {chosen.rms_px:.2f} px")
        return _with_deviations(problem, chosen, views, rig, tube)


def _problem(views: Mapping[str, View], rig: Rig, tube: Tube, start: Pose, tip: Array) -> Problem:
    ball = tube.tip.diameter_mm if tube.tip.shape == "ball" else None
    if tube.diameter_mm is None and ball is None and tube.tip.shape != "flat":
        ball = 2 * _tip_radius(views, rig, tip)
    radius = tube.diameter_mm / 2 if tube.diameter_mm is not None else _radius_guess(views, rig, tip)
    return Problem(
        rays=collect(views, rig, tube),
        start=start,
        radius_mm=radius,
        tip_radius_mm=None if ball is None else ball / 2,
        radius_known=tube.diameter_mm is not None,
        clamped=tube.clamped,
        views=len(views),
        end_mm=tip if tube.tip.shape == "flat" else None,
    )


def _radius_guess(views: Mapping[str, View], rig: Rig, tip: Array) -> float:
    """Radius from the angle between the last edges and the range of the tip."""
    guesses = []
    for name, view in views.items():
        cosine = np.clip((view.edge_rays[-5:, 0] * view.edge_rays[-5:, 1]).sum(1), -1, 1)
        guesses.append(np.linalg.norm(tip - rig.centre_mm(name)) * np.sin(np.median(np.arccos(cosine)) / 2))
    return float(np.median(guesses))


def _tip_radius(views: Mapping[str, View], rig: Rig, tip: Array) -> float:
    """Radius of a ball or rounded end from the angle under which it is seen."""
    radii = [np.linalg.norm(tip - rig.centre_mm(name)) * np.sin(view.tip.angle_rad) for name, view in views.items()]
    return float(np.mean(radii))


def _frame_at_start(curve: Curve3D) -> Pose:
    z = curve.tangent([0.0])[0]
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return Pose(np.stack([x, np.cross(z, x), z], 1), curve.at([0.0])[0])


def choose_family(problem: Problem, tip: Array) -> Fit:
    """Fit families of growing freedom and return the simplest that explains the edges."""
    arc = clamped_arc(problem.start.inverse().apply(tip))
    circle = fit_family(problem, FAMILIES["circle"], np.append(arc.curvature_per_mm * arc.length_mm, arc.length_mm))
    fits = [circle]
    for names in (("ellipse",), ("polynomial2", "spatial2", "arcs2"), ("polynomial3", "spatial4", "arcs3")):
        for name in names:
            guesses = _guesses(name, fits)
            fits.append(min((fit_family(problem, FAMILIES[name], g) for g in guesses), key=lambda f: f.rms_px))
        plausible = [fit for fit in fits if _is_tube(fit, problem.radius_mm)] or fits
        best = min(fit.rms_px for fit in plausible)
        if best <= _GOOD_PX:
            break
    limit = max(_SIMPLEST_WITHIN * best, _RMS_FLOOR_PX)
    return next(fit for fit in sorted(plausible, key=lambda f: f.family.count) if fit.rms_px <= limit)


def _is_tube(fit: Fit, radius_mm: float) -> bool:
    """Whether a tube of this radius can be bent like that without running into itself."""
    sharpest = float(np.linalg.norm(fit.nodes.curvature[0], axis=1).max())
    return sharpest * radius_mm < _SHARPEST


def _guesses(name: str, fits: list[Fit]) -> list[Array]:
    """First guesses of a family's parameters from the families already fitted."""
    done = {fit.family.name: fit.parameters for fit in fits}
    bx, by, length = done["circle"][:3]
    theta, azimuth = float(np.hypot(bx, by)), float(np.arctan2(by, bx))
    if name == "ellipse":
        return [np.array([azimuth, theta, np.pi / 4, 0.3, length])]
    if name == "polynomial2":
        return [np.array([azimuth, theta, 0.0, 0.0, length])]
    if name == "polynomial3":
        return [np.insert(done["polynomial2"][:5], 4, 0.0)]
    if name in ("arcs2", "arcs3"):
        count = int(name[-1])
        richer = done["spatial2" if count == 2 else "spatial4"]
        guess = FAMILIES["spatial2" if count == 2 else "spatial4"].count - 1
        bends = bends_of_pieces(richer[:guess].reshape(-1, 2), count)
        return [np.concatenate([bends.ravel(), np.zeros(count - 1), [length]])]
    if name == "spatial2":
        return [np.array([bx, by, 0.0, 0.0, 0.0, 0.0, length])]
    return [np.concatenate([done["spatial2"][:6], np.zeros(4), done["spatial2"][6:7]])]


def _curve(fit: Fit) -> NodeCurve:
    return NodeCurve(fit.family.name, fit.nodes.s_mm[0], fit.nodes.points[0], fit.nodes.tangents[0])


def _with_deviations(problem: Problem, fit: Fit, views: Mapping[str, View], rig: Rig, tube: Tube) -> NodeCurve:
    picture = displaced(problem, fit, picture_covariance(problem, fit))
    from_rig: tuple[NodeCurve, ...] = ()
    if rig.covariance is not None:
        steps = np.maximum(0.1 * np.sqrt(np.diag(rig.covariance.matrix)), 1e-9)
        moved = [collect(views, rig.perturbed(n, d), tube) for n, d in zip(rig.covariance.names, steps, strict=True)]
        from_rig = displaced(problem, fit, rig_covariance(problem, fit, moved, steps, rig.covariance.matrix))
    return replace(_curve(fit), from_picture=picture, from_rig=from_rig)
