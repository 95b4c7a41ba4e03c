"""Which family of curves explains the edges: the simplest one, found with as few fits as tell.

A circle and an ellipse are enough for most tubes. A few steps of a polynomial of curvature, which hardly depends on
where it starts, tell whether a tube bends once or several times, and where circular pieces begin. Of a family that does
not come near in a few steps no more are taken. Splines come last, from a polynomial that is near or from a curve that
another method finds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from statistics import median
from typing import NamedTuple

import numpy as np

from tubesight.core import Array, Status, Unmeasurable
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.families import FAMILIES, INTERVALS, Family, turns_of
from tubesight.methods.fit import Fit, fit_family
from tubesight.methods.general import SIMPLEST_WITHIN, frame_along, general_fits, placed, turns_by
from tubesight.methods.guesses import bends_once, like_ellipse, merged_pieces, pieces_like, plane_like, smooth_like
from tubesight.methods.rays import ROWS, Problem

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
_NOISE_SD, PLANE, _PLANE_WITHIN = 2.0, ("circle", "ellipse"), 2.0
# A tube whose centreline bends more sharply than this share of its radius' inverse kinks.
_SHARPEST = 0.7
# A circle is challenged only where a few steps of a polynomial lower its rms by this factor: `SIMPLEST_WITHIN` is
# farther away.
_WORTH, _FEW_STEPS = 1.15, 2
# Steps of a smooth curve in space that other families start from: the two right pieces came near from it on all of 79
# S-shapes and robots of two segments, as after twice as many steps; `bends_once` told most ellipses.
_ROUGH_STEPS = 4
# A family is fitted to its end where so many steps leave no more than this rms: right ones left 0 to 0.9 px on 156
# shapes of one to three bends (ellipses: 1.3 px), wrong ones 1.6 px and more on nine in ten.
_TRIED_STEPS, _TRIED_PX = 6, 1.5
# Pieces that leave up to this many deviations of the edges are not compared with smooth curves: on photographs right
# ones leave 0.4 to 1.3.
_ROUGH_AS_EDGES = 1.25
# A smooth curve that is farther off after its few steps is not the answer.
_PROMISING_PX = 1.0
# Median distance of the edges of a tip from its model, above which the curve ends elsewhere. On photographs: 0.5 px.
TIP_OFF_PX = 2.0


class _Level(NamedTuple):
    """Families of one degree: smooth in space, as many arcs as that can tell, one arc less, smooth in a plane."""

    smooth: str
    pieces: str
    fewer: str
    plane: str


_BENDS = (
    _Level("spatial2", "arcs2", "circle", "polynomial2"),
    _Level("spatial4", "arcs3", "arcs2", "polynomial3"),
)

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
    noise = min(_GOOD_PX, _NOISE_SD * roughness_px(problem))
    if circle.rms_px <= eased * _RMS_FLOOR_PX:
        return problem, circle, ""
    challenged_px = circle.rms_px / (eased * _WORTH)
    rough = _challenger(problem, circle, challenged_px)
    if rough.rms_px > challenged_px and circle.rms_px <= (noise if circle.rms_px <= _GOOD_PX else RMS_MAX_PX):
        return problem, circle, ""
    fits = {"circle": circle}
    _add_ellipse(problem, fits, rough)
    best, plausible = _best_of(fits, problem)
    for level, enough in zip(_BENDS, (noise, _GOOD_PX), strict=True):
        if best <= enough:
            break
        rough = _fit_level(problem, level, fits, rough)
        best, plausible = _best_of(fits, problem)
    general, found = problem, dict[str, Fit]()
    if best > _GOOD_PX:
        general, found = _fit_splines(problem, rough, any_shape)
        found = {name: fit for name, fit in found.items() if name not in fits or fit.rms_px < fits[name].rms_px}
        best, plausible = _best_of(fits | found, problem)
    chosen = next(fit for fit in sorted(plausible, key=lambda f: f.family.count) if _explains(fit, best, family))
    return general if chosen.family.name in found else problem, chosen, _why(chosen, fits)


def _challenger(problem: Problem, circle: Fit, challenged_px: float) -> Fit:
    """Take a few steps of a polynomial from a circle: in its plane where that is good, else in space.

    Shapes are nearly linear in the coefficients of a polynomial: a few steps tell what a better family could gain.
    """
    (bx, by), rest = circle.parameters[:2], circle.parameters[2:]
    if circle.rms_px <= _GOOD_PX:
        plane = np.concatenate([[np.arctan2(by, bx), np.hypot(bx, by), 0.0, 0.0], rest])
        return fit_family(problem, FAMILIES["polynomial2"], plane, challenged_px, _FEW_STEPS)
    space = np.concatenate([[bx, by, 0.0, 0.0, 0.0, 0.0], rest])
    return fit_family(problem, FAMILIES["spatial2"], space, steps=_ROUGH_STEPS)


def _tried(problem: Problem, family: Family, guess: Array, steps: int = _TRIED_STEPS) -> Fit:
    """Take a few steps of a family, and the others where it comes near."""
    fit = fit_family(problem, family, guess, steps=steps)
    return fit_family(problem, family, fit.parameters) if fit.rms_px <= _TRIED_PX else fit


def _add_ellipse(problem: Problem, fits: dict[str, Fit], rough: Fit) -> None:
    """Add the fit of an ellipse like another curve that bends once, where none is as good yet."""
    known_px = fits["ellipse"].rms_px if "ellipse" in fits else np.inf
    if known_px > SIMPLEST_WITHIN * rough.rms_px and bends_once(rough):
        fit = _tried(problem, FAMILIES["ellipse"], like_ellipse(rough))
        if fit.rms_px < known_px:
            fits["ellipse"] = fit


def _eased(name: str, family: str) -> float:
    """How far limits for a family are eased, as one that was right a moment ago, or tightened, as another one."""
    return 1.0 if not family else (_STAYS if name == family else 1 / _STAYS)


def _explains(fit: Fit, best_px: float, family: str) -> bool:
    """Whether a fit leaves no more than systematic errors of the edges may make of the best one."""
    good_plane = fit.family.name in PLANE and fit.rms_px <= _GOOD_PX
    within = _PLANE_WITHIN if good_plane else SIMPLEST_WITHIN
    return fit.rms_px <= max(_eased(fit.family.name, family) * max(within * best_px, _RMS_FLOOR_PX), best_px)


def _fit_level(problem: Problem, level: _Level, fits: dict[str, Fit], rough: Fit) -> Fit:
    """Add the fits of one level: pieces read off a smooth curve, and smooth curves where pieces leave more than noise.

    Parameters
    ----------
    rough
        Polynomial, in a plane or in space, after a few steps.

    Returns
    -------
    Fit
        The smooth curve of this level, or `rough` where pieces made it needless.
    """
    smooth, pieces = FAMILIES[level.smooth], FAMILIES[level.pieces]
    fits[level.pieces] = _tried(problem, pieces, pieces_like(rough, pieces))
    near = fits[level.pieces].rms_px <= _TRIED_PX
    if near:
        _add_ellipse(problem, fits, fits[level.pieces])
    merged = merged_pieces(fits[level.pieces]) if near and fits[level.fewer].rms_px > _TRIED_PX else None
    if merged is not None:
        fits[level.fewer] = fit_family(problem, FAMILIES[level.fewer], merged, _TRIED_PX)
    if fits[level.pieces].rms_px <= min(_ROUGH_AS_EDGES * roughness_px(problem), SIMPLEST_WITHIN * rough.rms_px):
        return rough
    worth_px = fits[level.pieces].rms_px / SIMPLEST_WITHIN if near else np.inf
    if rough.family is not smooth:
        rough = fit_family(problem, smooth, smooth_like(rough, smooth), worth_px, 2 * _ROUGH_STEPS)
        if not near:
            fits[level.pieces] = _tried(problem, pieces, pieces_like(rough, pieces), 2 * _TRIED_STEPS)
    elif not near:
        rough = fit_family(problem, smooth, rough.parameters, _GOOD_PX, 2 * _ROUGH_STEPS)
        _add_ellipse(problem, fits, rough)
    if rough.rms_px <= _PROMISING_PX:
        rough = fits[level.smooth] = fit_family(problem, smooth, rough.parameters, worth_px)
    # The plane curves are space curves of the same degree: they explain no more than that.
    if rough.rms_px <= _GOOD_PX:
        fits[level.plane] = fit_family(problem, FAMILIES[level.plane], plane_like(rough))
        _add_ellipse(problem, fits, rough)
    return rough


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
    simple = [fits[name].rms_px for name in PLANE if name in fits]
    if chosen.family.name in PLANE:
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
