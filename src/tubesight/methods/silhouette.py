"""The silhouette fit: the curve whose tube has the edges that the pictures show.

No edge is paired with another and no view with another: each sub-pixel edge ray asks only that the tube touch it,
which is exact for a tube of constant radius. The family of the curve is the simplest one that explains the edges.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from tubesight.core import Array, Status, Tip, Tube, Unmeasurable, sealed
from tubesight.geometry.curve import Curve3D, NodeCurve
from tubesight.geometry.deviations import Deviations
from tubesight.geometry.families import BASE
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.methods.agreement import base_of, flat_tip, flat_tip_sd_mm, triangulate_tip
from tubesight.methods.choice import RMS_MAX_PX, TIP_OFF_PX, AnyShape, choose_family, roughness_px
from tubesight.methods.fit import Fit, fit_family
from tubesight.methods.general import frame_along
from tubesight.methods.ray_kernels import meeting_point
from tubesight.methods.rays import Problem, collect, optics, tip_axes
from tubesight.methods.taper import evened
from tubesight.methods.uncertainty import picture_covariance, rig_covariance
from tubesight.vision.view import View

# Axes of tips that miss each other by less than this meet, whatever the lens does to a pixel there.
_TIP_CERTAIN_PX = 2.0
# The way of a tube at its base is told from this part of its centreline, where the planes of the views meet at 6
# degrees or more (sqrt(2) times the sine of half of it).
_FIRST_SHARE, _PLANES_APART = 6, 0.07
# Scans that tell the radius at the base and at the tip.
_FIRST, _LAST = slice(None, 5), slice(-5, None)
# Where edges are rough, so many of their deviations may be left (the right family of a thin robot before patterned
# things: 4.5), up to half of where edges stop counting.
_RMS_MAX_SD, _RMS_MOST_PX = 6.0, 1.5
# Families of more parameters than these bend to whatever edges there are: on photographs of 24 helices those that were
# right to 0.15 mm left 0.04 to 0.25 px, one that was off by 0.4 mm left 0.41 px, one that was off by 1.2 mm 0.50 px.
_SIMPLE, _BENT_MAX_PX = 6, 0.45
# They are no answer where a part of them may be so far off (one standard deviation): on 60 rendered loops and helices
# most curves right to 0.3 mm had up to 0.45 mm at their worst place, those off by 1 mm and more 1.0 to 40 mm.
_OPEN_MM = 0.75

# Frame in which a clamped tube starts.
_CLAMP = Pose.identity()


Starter = Callable[[Mapping[str, View], Rig, Tube], Curve3D]


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

    def __call__(self, views: Mapping[str, View], rig: Rig, tube: Tube, family: str = "") -> Curve3D:
        """Fit all families that are needed and return the simplest that explains the edges.

        Parameters
        ----------
        family
            That of the curve a moment ago, where that is known: it is kept where the edges leave the choice open.

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
        problem, chosen, why = choose_family(problem, tip, any_shape, family)
        if tube.tip.shape == "flat":
            end = chosen.nodes.points[-1], chosen.nodes.tangents[-1]
            tip = flat_tip(views, rig, *end, end_radius or problem.radius_mm)
            sd_mm = flat_tip_sd_mm(views, rig, *end)
            problem = problem._replace(end_mm=sealed(np.array(tip)), end_sd_mm=sd_mm)
            chosen = fit_family(problem, chosen.family, chosen.parameters)
        if not chosen.rms_px <= _most_px(chosen, problem):
            raise Unmeasurable(Status.RESIDUAL_TOO_LARGE, detail=f"rms {chosen.rms_px:.2f} px")
        if not chosen.tip_off_px < TIP_OFF_PX:
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
            return frame_along(base, way)
        curve = self.starter(views, rig, tube)
        return frame_along(curve.at([0.0])[0], curve.tangent([0.0])[0])


def _most_px(fit: Fit, problem: Problem) -> float:
    """Largest rms with which a fit of this family is an answer."""
    if fit.family.count > _SIMPLE:
        return _BENT_MAX_PX
    if fit.rms_px <= RMS_MAX_PX:
        return RMS_MAX_PX
    return float(np.clip(_RMS_MAX_SD * roughness_px(problem), RMS_MAX_PX, _RMS_MOST_PX))


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
    if fit.family.count > _SIMPLE and not float(picture.across_mm().max()) < _OPEN_MM:
        raise Unmeasurable(Status.NEAR_DEGENERATE, detail="what is hidden leaves a part of the curve open")
    calibration = Deviations(fit.family.name, fit.nodes, from_rig) if rig.covariance is not None else ()
    return NodeCurve(fit.family.name, fit.nodes.s_mm, fit.nodes.points, fit.nodes.tangents, picture, calibration, why)
