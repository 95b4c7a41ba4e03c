"""The silhouette fit: the curve whose tube has the edges that the pictures show.

No edge is paired with another and no view with another: each sub-pixel edge ray asks only that the tube touch it,
which is exact for a tube of constant radius. The family of the curve is the simplest one that explains the edges.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from tubesight.core import Array, Status, Tip, Tube, Unmeasurable, sealed
from tubesight.geometry.curve import Curve3D, NodeCurve
from tubesight.geometry.deviations import Deviations
from tubesight.geometry.families import BASE, FAMILIES, bends_of_pieces, ellipse_like
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.methods.agreement import base_of, flat_tip, triangulate_tip
from tubesight.methods.fit import Fit, fit_family
from tubesight.methods.general import general_fits, placed
from tubesight.methods.ray_kernels import meeting_point
from tubesight.methods.rays import ROWS, Problem, collect, optics, tip_axes
from tubesight.methods.taper import evened
from tubesight.methods.uncertainty import picture_covariance, rig_covariance
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
# A good circle is challenged only where a few steps of a polynomial lower its rms by this factor: `_SIMPLEST_WITHIN` is
# farther away.
_WORTH, _FEW_STEPS = 1.15, 2
# Axes of tips that miss each other by less than this meet, whatever the lens does to a pixel there.
_TIP_CERTAIN_PX = 2.0
# Median distance of the edges of a tip from its model, above which the curve ends elsewhere. On photographs: 0.5 px.
_TIP_OFF_PX = 2.0
# The way of a tube at its base is told from this part of its centreline, where the planes of the views meet at 6
# degrees or more (sqrt(2) times the sine of half of it).
_FIRST_SHARE, _PLANES_APART = 6, 0.07
# Scans that tell the radius at the base and at the tip.
_FIRST, _LAST = slice(None, 5), slice(-5, None)
# No family with a larger rms is an answer: pixels, or deviations of the rows where edges are rough (the right family
# of a thin robot before patterned things: 4.5 of them).
_RMS_MAX_PX, _RMS_MAX_SD = 0.6, 6.0

# Frame in which a clamped tube starts.
_CLAMP = Pose.identity()

Starter = Callable[[Mapping[str, View], Rig, Tube], Curve3D]
# Finds a curve whatever its shape, where there is one.
AnyShape = Callable[[], Curve3D | None]


@dataclass(frozen=True, slots=True)
class Silhouette:
    """Silhouette fit as a method.

    Attributes
    ----------
    starter
        Method that tells where a tube without a clamp starts, where its views do not.
    general
        Method that finds a curve of any shape, from which splines start where no short family explains the edges.
    """

    starter: Starter
    general: Starter

    def __call__(self, views: Mapping[str, View], rig: Rig, tube: Tube) -> Curve3D:
        """Fit all families that are needed and return the simplest that explains the edges.

        Raises
        ------
        Unmeasurable
            If the views contradict each other or no family explains them.
        """
        tip = _tip(views, rig)
        start = _CLAMP if tube.clamped else self._start(views, rig, tube)
        any_shape = cache(partial(self._any_shape, views, rig, tube))
        end_radius = _radius_guess(views, rig, tip, _LAST) if tube.tapered else None
        if tube.tapered:
            views, tube = _made_even(views, rig, tube, start, tip, any_shape)
        problem = _problem(views, rig, tube, start, tip)
        problem, chosen, why = choose_family(problem, tip, any_shape)
        if tube.tip.shape == "flat":
            end = chosen.nodes.points[-1], chosen.nodes.tangents[-1]
            tip = flat_tip(views, rig, *end, end_radius or problem.radius_mm)
            problem = problem._replace(end_mm=sealed(np.array(tip)))
            chosen = fit_family(problem, chosen.family, chosen.parameters)
        if not (chosen.rms_px <= _RMS_MAX_PX or chosen.rms_px <= _RMS_MAX_SD * _roughness_px(problem)):
            raise Unmeasurable(Status.RESIDUAL_TOO_LARGE, detail=f"rms {chosen.rms_px:.2f} px")
        if not chosen.tip_off_px < _TIP_OFF_PX:
            raise Unmeasurable(Status.RESIDUAL_TOO_LARGE, detail="no curve along the edges ends in the tip")
        return _with_deviations(problem, chosen, why, views, rig, tube)

    def _any_shape(self, views: Mapping[str, View], rig: Rig, tube: Tube) -> Curve3D | None:
        """Find a curve whatever its shape; None where even that fails."""
        try:
            return self.general(views, rig, tube)
        except Unmeasurable:
            return None

    def _start(self, views: Mapping[str, View], rig: Rig, tube: Tube) -> Pose:
        """Frame in which a tube without a clamp starts: where both views see its base, or else by the starter."""
        base, way = base_of(views, rig), _way_at_base(views, rig)
        if base is not None and way is not None:
            return _frame(base, way)
        curve = self.starter(views, rig, tube)
        return _frame(curve.at([0.0])[0], curve.tangent([0.0])[0])


def _tip(views: Mapping[str, View], rig: Rig) -> Array:
    """Tip (3,) from the axes of all views.

    Where they miss each other by much, the careful way decides.

    Raises
    ------
    Unmeasurable
        If the axes do not meet.
    """
    sight = optics(rig, tuple(views))
    point, miss_px = meeting_point(tip_axes(views, sight.rotation), sight.centre_mm, sight.focal_px)
    return point if miss_px < _TIP_CERTAIN_PX else triangulate_tip(views, rig)


def _problem(views: Mapping[str, View], rig: Rig, tube: Tube, start: Pose, tip: Array) -> Problem:
    ball = tube.tip.diameter_mm if tube.tip.shape == "ball" else None
    if tube.diameter_mm is None and tube.tip.rounded and ball is None:
        ball = 2 * _tip_radius(views, rig, tip)
    radius = tube.diameter_mm / 2 if tube.diameter_mm is not None else _radius_guess(views, rig, tip, _LAST)
    return collect(
        views,
        rig,
        tube,
        start,
        radius,
        None if ball is None else ball / 2,
        None if tube.tip.rounded else tip,
    )


def _made_even(
    views: Mapping[str, View], rig: Rig, tube: Tube, start: Pose, tip: Array, any_shape: AnyShape
) -> tuple[dict[str, View], Tube]:
    """Show a tapered tube as if it had the diameter of its base all along: views, and that tube."""
    radius = tube.diameter_mm / 2 if tube.diameter_mm else _radius_guess(views, rig, start.translation_mm, _FIRST)
    end = Tip("ball", 2 * _tip_radius(views, rig, tip)) if tube.tip.rounded else tube.tip
    even = replace(tube, diameter_mm=2 * radius, tip=end)
    # The ranges along the chord are a few percent off; those along the curve that they lead to are right.
    rough = evened(views, rig, np.stack([start.translation_mm, tip]), radius)
    _, chosen, _ = choose_family(_problem(rough, rig, even, start, tip), tip, any_shape)
    return evened(views, rig, chosen.nodes.points, radius), even


def _radius_guess(views: Mapping[str, View], rig: Rig, place: Array, scans: slice) -> float:
    """Radius from the angle between the edges of some scans and the range of a place (3,) near them."""
    guesses = []
    for name, view in views.items():
        cosine = np.clip((view.edge_rays[scans, 0] * view.edge_rays[scans, 1]).sum(1), -1, 1)
        guesses.append(np.linalg.norm(place - rig.centre_mm(name)) * np.sin(np.median(np.arccos(cosine)) / 2))
    return float(np.median(guesses))


def _tip_radius(views: Mapping[str, View], rig: Rig, tip: Array) -> float:
    """Radius of a ball or rounded end from the angle under which it is seen."""
    radii = [np.linalg.norm(tip - rig.centre_mm(name)) * np.sin(view.tip.angle_rad) for name, view in views.items()]
    return float(np.mean(radii))


def _way_at_base(views: Mapping[str, View], rig: Rig) -> Array | None:
    """Find the unit tangent (3,) at the base: where the planes of each view's first piece of centreline meet.

    None where these are nearly one plane.
    """
    normals, forwards = [], np.zeros(3)
    for name, view in views.items():
        first = rig.directions(name, view.rays[: max(len(view.rays) // _FIRST_SHARE, 3)])
        normals.append(np.linalg.svd(first, full_matrices=False)[2][-1])
        forwards += first[-1] - first[0]
    _, spread, axes = np.linalg.svd(np.stack(normals))
    if spread[1] < _PLANES_APART:
        return None
    return np.asarray(axes[-1] if axes[-1] @ forwards >= 0 else -axes[-1])


def _frame(start_mm: Array, z: Array) -> Pose:
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return Pose(np.stack([x, np.cross(z, x), z], 1), start_mm)


def choose_family(problem: Problem, tip: Array, any_shape: AnyShape) -> tuple[Problem, Fit, str]:
    """Fit families of growing freedom and return the simplest that explains the edges.

    Parameters
    ----------
    any_shape
        Finds a curve to start splines from, where no other family explains the edges.

    Returns
    -------
    problem, fit, why
        The problem with the start, and the places along the tube, that the fit began with; the fit; and for a shape of
        several bends the reason in words.

    Raises
    ------
    Unmeasurable
        If not even a circle can be fitted.
    """
    circle = fit_family(problem, FAMILIES["circle"], _arc_to(problem, tip), _RMS_MAX_PX)
    if not math.isfinite(circle.rms_px):
        raise Unmeasurable(Status.NEAR_DEGENERATE, detail="no curve can be fitted to the edges")
    good = circle.rms_px <= _GOOD_PX
    if circle.rms_px <= _RMS_FLOOR_PX:
        return problem, circle, ""
    # Shapes are nearly linear in the coefficients of a polynomial: a few steps tell what a better family could gain.
    bx, by = circle.parameters[:2]
    plane = np.concatenate([[np.arctan2(by, bx), np.hypot(bx, by), 0.0, 0.0], circle.parameters[2:]])
    better = fit_family(problem, FAMILIES["polynomial2"], plane, circle.rms_px / _WORTH if good else np.inf, _FEW_STEPS)
    if good and better.rms_px > circle.rms_px / _WORTH:
        return problem, circle, ""
    guess = np.append(ellipse_like(better.parameters[:5]), better.parameters[5:])
    fits = {"circle": circle, "ellipse": fit_family(problem, FAMILIES["ellipse"], guess, _RMS_MAX_PX)}
    for names in ((), ("spatial2", "polynomial2", "arcs2"), ("spatial4", "polynomial3", "arcs3")):
        for name in names:
            fits[name] = fit_family(problem, FAMILIES[name], _guess(name, fits))
        best, plausible = _best_of(fits, problem)
        if best <= _GOOD_PX:
            break
    if best > _GOOD_PX and (curve := any_shape()) is not None:
        start = problem.start if problem.clamped else _frame(curve.at([0.0])[0], curve.tangent([0.0])[0])
        general = placed(problem, curve, start)
        found = general_fits(general, curve, _GOOD_PX)
        best, plausible = _best_of(fits | found, problem)
    else:
        general, found = problem, {}
    limit = max(_SIMPLEST_WITHIN * best, _RMS_FLOOR_PX)
    chosen = next(fit for fit in sorted(plausible, key=lambda f: f.family.count) if fit.rms_px <= limit)
    return general if chosen.family.name in found else problem, chosen, _why(chosen, fits)


def _why(chosen: Fit, fits: Mapping[str, Fit]) -> str:
    """Say why a shape is none of those with one bend."""
    simple = [fits[name].rms_px for name in ("circle", "ellipse")]
    if chosen.family.name in ("circle", "ellipse"):
        return ""
    return (
        f"{chosen.family.name}: {chosen.rms_px:.2f} px off the edges, the best circle or ellipse {min(simple):.2f} px"
    )


def _best_of(fits: Mapping[str, Fit], problem: Problem) -> tuple[float, list[Fit]]:
    """Least rms of the fits that may be true, and those fits."""
    plausible = [fit for fit in fits.values() if _is_tube(fit, problem.radius_mm)] or list(fits.values())
    plausible = [fit for fit in plausible if fit.tip_off_px < _TIP_OFF_PX] or plausible
    return min(fit.rms_px for fit in plausible), plausible


def _arc_to(problem: Problem, tip: Array) -> Array:
    """Parameters (3,) of the circle that leaves the start along its axis and ends in the tip (`clamped_arc`)."""
    x, y, z = ((tip - problem.start_mm) @ problem.start_rotation).tolist()
    side, chord = math.hypot(x, y), math.hypot(x, y, z)
    half = math.atan2(side, z)
    bend = 2 * half / side if side > 0 else 0.0
    return np.array([bend * x, bend * y, chord * half / math.sin(half) if 0 < half < math.pi else chord])


def _is_tube(fit: Fit, radius_mm: float) -> bool:
    """Whether a tube of this radius can be bent like that without running into itself."""
    sharpest = float(np.sqrt((fit.nodes.curvature**2).sum(1).max()))
    return sharpest * radius_mm < _SHARPEST


def _roughness_px(problem: Problem) -> float:
    """Median deviation of the rows of the tube's edges, pixels."""
    sides = problem.row_sd_px.reshape(-1, ROWS)[:, : ROWS - 1]
    return float(np.median(sides))


def _guess(name: str, fits: dict[str, Fit]) -> Array:
    """First guess of a family's parameters from the families already fitted."""
    bx, by, length = fits["circle"].parameters[:3]
    if name == "spatial2":
        return np.array([bx, by, 0.0, 0.0, 0.0, 0.0, length])
    richer = fits["spatial2" if name in ("polynomial2", "arcs2", "spatial4") else "spatial4"].parameters
    if name == "spatial4":
        return np.concatenate([richer[:6], np.zeros(4), richer[6:7]])
    if name in ("arcs2", "arcs3"):
        count = int(name[-1])
        richer = richer[: FAMILIES["spatial2" if count == 2 else "spatial4"].count]
        bends = bends_of_pieces(richer[:-1].reshape(-1, 2), count)
        return np.concatenate([bends.ravel(), np.zeros(count - 1), [length]])
    if name == "polynomial2":
        return np.array([np.arctan2(by, bx), np.hypot(bx, by), 0.0, 0.0, length])
    return np.insert(fits["polynomial2"].parameters[:5], 4, 0.0)


def _with_deviations(
    problem: Problem, fit: Fit, why: str, views: Mapping[str, View], rig: Rig, tube: Tube
) -> NodeCurve:
    size = fit.family.count + BASE

    def from_rig() -> Array:
        return rig_covariance(problem, fit, views, rig, tube)[:size, :size]

    covariance = picture_covariance(problem, fit)[:size, :size]
    picture = Deviations(fit.family.name, fit.nodes, lambda: covariance)
    if not picture.bounded():
        raise Unmeasurable(Status.NEAR_DEGENERATE, detail="the pictures leave the length of the curve open")
    calibration = Deviations(fit.family.name, fit.nodes, from_rig) if rig.covariance is not None else ()
    return NodeCurve(fit.family.name, fit.nodes.s_mm, fit.nodes.points, fit.nodes.tangents, picture, calibration, why)
