"""Which family of curves explains the edges: the simplest one, found with as few fits as tell.

A circle and an ellipse are enough for most tubes. Shapes of several bends are looked for level by level: a few steps of
a polynomial of curvature, which hardly depends on where it starts, tell where circular pieces begin. Splines come last,
from a polynomial that is near or from a curve that another method finds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from statistics import median
from typing import NamedTuple

import numpy as np

from tubesight.core import Array, Status, Unmeasurable
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.families import FAMILIES, INTERVALS, Family, bends_of_pieces, ellipse_like, turns_of
from tubesight.methods.fit import Fit, fit_family
from tubesight.methods.general import SIMPLEST_WITHIN, frame_along, general_fits, placed, turns_by
from tubesight.methods.rays import ROWS, Problem
from tubesight.methods.solve import ITERATIONS

# No family with a larger rms is an answer.
RMS_MAX_PX = 0.6
# A family that was right a moment ago stays until limits are passed by this factor, and another one comes only so far
# within them: from frame to frame the rms of one family changes by a tenth.
_STAYS = 1.15
# Rms under which families are not compared: shading and compression move edges by this much.
_RMS_FLOOR_PX = 0.06
# A family with a smaller rms than this may be right: on photographs the right one leaves 0.03 to 0.2 px, a wrong one
# mostly over 0.5 px.
_GOOD_PX = 0.25
# A good plane quadratic curve that leaves more than this many deviations of the edges is challenged by two bends, and
# kept unless they leave less than its rms divided by `_PLANE_WITHIN`. On 73 of 76 photographs the right family leaves
# 0.4 to 1.9 of them; two bends the same way that an ellipse fits to 0.2 px leave 2.7.
_NOISE_SD, _PLANE, _PLANE_WITHIN = 2.0, ("circle", "ellipse"), 2.0
# Up to this rms of a few steps of a plane polynomial an ellipse is fitted to its end: true ellipses left 1.2 to 2.1 px,
# S-shapes and robots of several segments mostly 2.3 px and more.
_PLANE_PX = 2.3
# A tube whose centreline bends more sharply than this share of its radius' inverse kinks.
_SHARPEST = 0.7
# A good circle is challenged only where a few steps of a polynomial lower its rms by this factor: `SIMPLEST_WITHIN` is
# farther away.
_WORTH, _FEW_STEPS = 1.15, 2
# Steps of a smooth curve that pieces start from: on 180 S-shapes and robots of two and three segments as many pieces
# were found after 3 steps as after 30.
_ROUGH_STEPS = 8
# A smooth curve that is farther off after those is not the answer, nor near it.
_PROMISING_PX = 1.0
# Median distance of the edges of a tip from its model, above which the curve ends elsewhere. On photographs: 0.5 px.
TIP_OFF_PX = 2.0


class _Level(NamedTuple):
    """Families of one degree: a smooth curve in space, as many arcs as it can tell, a curve in a plane."""

    smooth: str
    pieces: str
    plane: str


_BENDS = (_Level("spatial2", "arcs2", "polynomial2"), _Level("spatial4", "arcs3", "polynomial3"))

# Finds a curve whatever its shape, where there is one.
AnyShape = Callable[[], Curve3D | None]


def choose_family(problem: Problem, tip: Array, any_shape: AnyShape, family: str = "") -> tuple[Problem, Fit, str]:
    """Fit families of growing freedom and return the simplest that explains the edges.

    Parameters
    ----------
    any_shape
        Finds a curve to start splines from, where no other family explains the edges.
    family
        That of the curve a moment ago, if known: limits on the rms are then moved in its favour by `_STAYS`.

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
    circle = fit_family(problem, FAMILIES["circle"], _arc_to(problem, tip), RMS_MAX_PX)
    if not math.isfinite(circle.rms_px):
        raise Unmeasurable(Status.NEAR_DEGENERATE, detail="no curve can be fitted to the edges")
    eased = _eased("circle", family)
    good, noise = circle.rms_px <= _GOOD_PX, min(_GOOD_PX, _NOISE_SD * roughness_px(problem))
    if circle.rms_px <= eased * _RMS_FLOOR_PX:
        return problem, circle, ""
    # Shapes are nearly linear in the coefficients of a polynomial: a few steps tell what a better family could gain.
    bx, by = circle.parameters[:2]
    plane = np.concatenate([[np.arctan2(by, bx), np.hypot(bx, by), 0.0, 0.0], circle.parameters[2:]])
    challenged_px = circle.rms_px / (eased * _WORTH)
    better = fit_family(problem, FAMILIES["polynomial2"], plane, challenged_px if good else np.inf, _FEW_STEPS)
    if circle.rms_px <= noise and better.rms_px > challenged_px:
        return problem, circle, ""
    guess = np.append(ellipse_like(better.parameters[:5]), better.parameters[5:])
    worth = np.inf if better.rms_px <= _PLANE_PX else RMS_MAX_PX
    fits = {"circle": circle, "ellipse": fit_family(problem, FAMILIES["ellipse"], guess, worth)}
    best, plausible = _best_of(fits, problem)
    for level, enough in zip(_BENDS, (noise, _GOOD_PX), strict=True):
        if best <= enough:
            break
        better = _fit_level(problem, level, fits, better)
        best, plausible = _best_of(fits, problem)
    general, found = problem, dict[str, Fit]()
    if best > _GOOD_PX:
        general, found = _fit_splines(problem, better, any_shape)
        best, plausible = _best_of(fits | found, problem)
    chosen = next(fit for fit in sorted(plausible, key=lambda f: f.family.count) if _explains(fit, best, family))
    return general if chosen.family.name in found else problem, chosen, _why(chosen, fits)


def _eased(name: str, family: str) -> float:
    """How far limits for a family are eased, as one that was right a moment ago, or tightened, as another one."""
    return 1.0 if not family else (_STAYS if name == family else 1 / _STAYS)


def _explains(fit: Fit, best_px: float, family: str) -> bool:
    """Whether a fit leaves no more than systematic errors of the edges may make of the best one."""
    good_plane = fit.family.name in _PLANE and fit.rms_px <= _GOOD_PX
    within = _PLANE_WITHIN if good_plane else SIMPLEST_WITHIN
    return fit.rms_px <= max(_eased(fit.family.name, family) * max(within * best_px, _RMS_FLOOR_PX), best_px)


def _fit_level(problem: Problem, level: _Level, fits: dict[str, Fit], rough: Fit) -> Fit:
    """Add the fits of one level: a smooth space curve, pieces read off it, and a plane curve where one may do.

    A few steps of the smooth curve are enough for the pieces to start from, where its start is known. It is fitted to
    its end where they do not explain the edges to the noise.

    Parameters
    ----------
    rough
        Polynomial, in a plane or in space, that the smooth curve starts from.

    Returns
    -------
    Fit
        The smooth curve.
    """
    smooth, pieces = FAMILIES[level.smooth], FAMILIES[level.pieces]
    some = (_GOOD_PX, _ROUGH_STEPS) if problem.clamped else (np.inf, ITERATIONS)
    fits[level.smooth] = fit_family(problem, smooth, _smooth_like(rough, smooth), *some)
    fits[level.pieces] = fit_family(problem, pieces, _pieces_like(fits[level.smooth], pieces))
    if problem.clamped and fits[level.pieces].rms_px > _RMS_FLOOR_PX and fits[level.smooth].rms_px <= _PROMISING_PX:
        fits[level.smooth] = fit_family(problem, smooth, fits[level.smooth].parameters)
    # The plane curve is a space curve of the same degree: it explains no more than that.
    if fits[level.smooth].rms_px <= _GOOD_PX:
        fits[level.plane] = fit_family(problem, FAMILIES[level.plane], _plane_like(fits[level.smooth]))
    return fits[level.smooth]


def _fit_splines(problem: Problem, smooth: Fit, any_shape: AnyShape) -> tuple[Problem, dict[str, Fit]]:
    """Fit splines and many pieces from the smooth curve, or else from one that is found whatever its shape.

    Returns the fits, and the problem with the start and the places along the tube that they began with.
    """
    found: dict[str, Fit] = {}
    if smooth.rms_px <= _PROMISING_PX:
        found = general_fits(problem, turns_by(smooth), smooth.nodes.s_mm[-1], _GOOD_PX)
        if _best_of(found, problem)[0] <= _GOOD_PX:
            return problem, found
    curve = any_shape()
    if curve is None:
        return problem, found
    tangents = curve.tangent(np.linspace(0.0, curve.length_mm, INTERVALS + 1))
    start = problem.start if problem.clamped else frame_along(curve.at([0.0])[0], tangents[0])
    general = placed(problem, curve, start)
    return general, general_fits(general, turns_of(tangents, start), curve.length_mm, _GOOD_PX, curve)


def _why(chosen: Fit, fits: Mapping[str, Fit]) -> str:
    """Say why a shape is none of those with one bend."""
    simple = [fits[name].rms_px for name in _PLANE]
    if chosen.family.name in _PLANE:
        return ""
    return (
        f"{chosen.family.name}: {chosen.rms_px:.2f} px off the edges, the best circle or ellipse {min(simple):.2f} px"
    )


def _best_of(fits: Mapping[str, Fit], problem: Problem) -> tuple[float, list[Fit]]:
    """Least rms of the fits that may be true, and those fits."""
    plausible = [fit for fit in fits.values() if _is_tube(fit, problem.radius_mm)] or list(fits.values())
    plausible = [fit for fit in plausible if fit.tip_off_px < TIP_OFF_PX] or plausible
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


def roughness_px(problem: Problem) -> float:
    """Median deviation of the rows of the tube's edges, pixels."""
    deviations: list[float] = problem.row_sd_px.tolist()
    return median(sd for row, sd in enumerate(deviations) if row % ROWS < ROWS - 1)


def _coefficients(fit: Fit) -> tuple[Array, float]:
    """Coefficients (K, 2) of the curvatures of a polynomial, in a plane or in space, and the length of its curve."""
    p = fit.parameters[: fit.family.count]
    if fit.family.name.startswith("spatial"):
        return p[:-1].reshape(-1, 2), float(p[-1])
    return np.outer(p[1:-1], [np.cos(p[0]), np.sin(p[0])]), float(p[-1])


def _smooth_like(rough: Fit, family: Family) -> Array:
    """First guess of a polynomial in space: another one with fewer coefficients."""
    coefficients, length = _coefficients(rough)
    guess = np.zeros(family.count)
    guess[: coefficients.size], guess[-1] = coefficients.ravel(), length
    return guess


def _pieces_like(smooth: Fit, family: Family) -> Array:
    """First guess of a chain of arcs: equal pieces that turn as much as those of a polynomial in space."""
    coefficients, length = _coefficients(smooth)
    count = family.count // 3
    return np.concatenate([bends_of_pieces(coefficients, count).ravel(), np.zeros(count - 1), [length]])


def _plane_like(smooth: Fit) -> Array:
    """First guess of a polynomial of a degree less or the same, in the plane that holds most of a curve's bending."""
    coefficients, length = _coefficients(smooth)
    way = np.linalg.svd(coefficients, full_matrices=False)[2][0]
    return np.concatenate([[np.arctan2(way[1], way[0])], (coefficients @ way)[:4], [length]])
